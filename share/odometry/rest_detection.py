"""Is the body at rest? IMU and images must agree.

An IMU measures the same at constant velocity as at rest; images do not look the same. What counts is where
static features were a moment ago in the image: a body at rest neither moves nor turns, so nothing here is
compensated, and nothing depends on the filter's velocity, which a zero-velocity update would itself keep at
zero. Only where the images show too little, the filter's velocity has to be known and near zero.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.odometry.state import VELOCITY, FilterState
from share.odometry.track_result import median
from share.types import F32, I64

_MIN_AGE_NS = 250_000_000  # of the view compared with: 0.1 m/s at 5 m moves a feature by 2 px in the time
_MAX_MOTION_PX = 0.2  # median over the features: 1 cm/s at 5 m; 0.05 at rest
_MIN_FEATURES = 12  # with fewer in view the images say nothing
_MAX_DARK_M_S, _MAX_DARK_SIGMA_M_S = 0.04, 0.03  # velocity and its sigma where they say nothing


class _View(NamedTuple):
    """Ids (N,) of static features and their px (N, 2)."""

    stamp_ns: int
    feature_ids: I64
    px: F32


class RestDetector:
    """Keeps the views of the last moment."""

    def __init__(self) -> None:
        self._views: deque[_View] = deque()

    def is_at_rest(self, s: FilterState, px: F32, is_static: NDArray[np.bool_], imu_is_still: bool) -> bool:
        """Return whether the body was at rest until the state's time. px (N, 2), is_static (N,): of the
        state's features in the image of that time. Call it for every frame."""
        view = _View(s.stamp_ns, s.feature_ids[is_static], px[is_static])
        while len(self._views) > 1 and view.stamp_ns - self._views[1].stamp_ns >= _MIN_AGE_NS:
            self._views.popleft()  # the first is the newest that is old enough
        self._views.append(view)
        if not imu_is_still:
            return False
        return _is_slow(s) if len(view.px) < _MIN_FEATURES else _shows_no_motion(self._views[0], view)


def _shows_no_motion(earlier: _View, view: _View) -> bool:
    """Return whether a view and an earlier one show enough of the same features, and most of them in the
    same place."""
    if view.stamp_ns - earlier.stamp_ns < _MIN_AGE_NS:
        return False
    _, before, now = np.intersect1d(earlier.feature_ids, view.feature_ids, return_indices=True)
    if len(now) < _MIN_FEATURES:
        return False
    return median(np.hypot(*(view.px[now] - earlier.px[before]).T)) < _MAX_MOTION_PX


def _is_slow(s: FilterState) -> bool:
    """Return whether the velocity is near zero, and known so well."""
    sigma = np.sqrt(s.cov.diagonal()[VELOCITY].max())
    return bool(np.linalg.norm(s.v) < _MAX_DARK_M_S and sigma < _MAX_DARK_SIGMA_M_S)
