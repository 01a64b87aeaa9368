"""Is the body at rest? IMU and images must agree.

An IMU measures the same at constant velocity as at rest; images do not look the same. What counts is the
speed that static features show since a moment ago, apart from rotation. It does not depend on the filter's
velocity, which a zero-velocity update would itself keep at zero. Only where the images show too little, the
filter's velocity has to be known and near zero.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import rays
from share.odometry.initial_depth import current_rho
from share.odometry.state import VELOCITY, FilterState
from share.types import F64, I64

_MIN_AGE_NS = 250_000_000  # of the view compared with: 0.1 m/s at 5 m shows as 2 px
_MAX_SPEED_M_S = 0.02  # by the images
_MIN_FEATURES = 12  # with fewer in view the images say nothing
_NOISE_RAD = 1e-3  # of a displacement, beyond which a feature weighs less: 0.4 px
_ITERATIONS = 2
_PRIOR = 1e-9  # keeps the fit solvable where all features are at infinity
_MAX_DARK_M_S, _MAX_DARK_SIGMA_M_S = 0.04, 0.03  # velocity and its sigma where they say nothing


class _StaticFeatures(NamedTuple):
    """Static features in an image: ids (N,), normalised positions uv (N, 2). R_odom_cam (3, 3)."""

    stamp_ns: int
    feature_ids: I64
    uv: F64
    R_odom_cam: F64


class RestDetector:
    """Keeps the views of the last moment."""

    def __init__(self) -> None:
        self._views: deque[_StaticFeatures] = deque()

    def is_at_rest(self, s: FilterState, uv: F64, is_static: NDArray[np.bool_], imu_is_still: bool) -> bool:
        """Return whether the body was at rest until the state's time. uv (N, 2), is_static (N,): normalised
        positions of the state's features in the image of that time. Call it for every frame."""
        R_odom_cam = s.T[:3, :3] @ s.T_body_cam[:3, :3]
        view = _StaticFeatures(s.stamp_ns, s.feature_ids[is_static], uv[is_static], R_odom_cam)
        while len(self._views) > 1 and view.stamp_ns - self._views[1].stamp_ns >= _MIN_AGE_NS:
            self._views.popleft()  # the first is the newest that is old enough
        self._views.append(view)
        if not imu_is_still:
            return False
        if len(view.uv) < _MIN_FEATURES:
            return _is_slow(s)
        return _image_speed(self._views[0], view, current_rho(s)[is_static]) < _MAX_SPEED_M_S


def _image_speed(earlier: _StaticFeatures, view: _StaticFeatures, rho: F64) -> float:
    """Return the camera's mean speed, m/s, between an earlier view and this one, with inverse depths rho (N,)
    in this one; inf where the earlier is too near, or shows too few of the same features.

    A robust fit of one displacement t: for small ones, d uv = rho (uv t_z - t_xy).
    """
    interval_ns = view.stamp_ns - earlier.stamp_ns
    _, before, now = np.intersect1d(
        earlier.feature_ids, view.feature_ids, assume_unique=True, return_indices=True
    )
    if interval_ns < _MIN_AGE_NS or len(now) < _MIN_FEATURES:
        return np.inf
    uv, ray = view.uv[now], rays(earlier.uv[before]) @ earlier.R_odom_cam.T @ view.R_odom_cam
    moved = uv - ray[:, :2] / ray[:, 2:]
    J = np.zeros((len(now), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = -rho[now]
    J[:, :, 2] = rho[now, None] * uv
    t = np.zeros(3)
    for _ in range(_ITERATIONS):
        weight = 1 / (1 + ((moved - J @ t) ** 2).sum(axis=1) / _NOISE_RAD**2)
        weighted = (weight[:, None, None] * J).reshape(-1, 3).T
        normal = weighted @ J.reshape(-1, 3) + _PRIOR * np.eye(3)
        t = np.linalg.solve(normal, weighted @ moved.ravel())
    return float(np.linalg.norm(t)) / (interval_ns * 1e-9)


def _is_slow(s: FilterState) -> bool:
    """Return whether the velocity is near zero, and known so well."""
    sigma = np.sqrt(s.cov.diagonal()[VELOCITY].max())
    return bool(np.linalg.norm(s.v) < _MAX_DARK_M_S and sigma < _MAX_DARK_SIGMA_M_S)
