"""Update the filter with the matches of a frame: linearise, gate, and update.

The covariance is inflated first where the images agree with each other but not with the propagated state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.geometry.camera import Camera
from share.odometry import filter, outliers, state_augmentation
from share.odometry.feature_matching import FeatureMatches
from share.odometry.landmarks import LandmarkMap
from share.odometry.state import FilterState
from share.odometry.track_result import median
from share.types import F64

_RELINEARISE_PX = 1.0  # median residual above which the update is iterated
# If the gate accepts fewer than these shares of the matches, after a gap or with suspect IMU samples, and
# more than the second share agree on a pose, the covariance is inflated.
_MIN_ACCEPTED_SHARE = 0.3
_MIN_CONSENSUS_SHARE = 0.7
_GAP_INFLATION = 0.02, 0.1, 0.3  # rad, m, m/s


class _Gated(NamedTuple):
    """Measurements (M,), which of them pass the gate, their NIS, and their innovation covariance."""

    rows: filter.FeatureMeasurements
    accepted: NDArray[np.bool_]
    nis: F64
    HP: filter.FloatArray
    S: filter.FloatArray


class VisualUpdate:
    """common_cov (6, 6): of a pose error that all measurements of an image share."""

    def __init__(self, camera: Camera, config: InertialConfig) -> None:
        self._camera, self._config = camera, config
        self.common_cov = np.diag(np.repeat([config.common_rad**2, config.common_m**2], 3))

    def apply(
        self, landmarks: LandmarkMap, matches: FeatureMatches, rate: F64, is_after_gap: bool, is_suspect: bool
    ) -> tuple[NDArray[np.bool_], F64]:
        """Update the state. Return the inliers (N,) and the NIS of the measurements.

        rate (3,): rad/s of the body. is_after_gap, is_suspect: the propagation may be wrong, because it was
        long or some IMU samples are suspect.
        """
        s = landmarks.state

        def make_rows() -> filter.FeatureMeasurements:
            return landmarks.frame_measurements(matches, rate)

        inliers = matches.is_found & ~matches.is_dynamic
        rows = make_rows()
        if len(rows.feature) == 0:
            return inliers, np.zeros(0)
        gated = self._gate(s, rows, make_rows)
        share = gated.accepted.mean()
        is_contradicted = (is_after_gap and share < _MIN_ACCEPTED_SHARE) or (
            is_suspect and share < _MIN_CONSENSUS_SHARE
        )
        if is_contradicted and self._images_agree(s, matches):
            filter.inflate(s, *_GAP_INFLATION)
            gated = self._gate(s, gated.rows, make_rows)
        rows, accepted, nis, HP, S = gated
        if accepted.all():
            filter.update(s, rows, HP, S)
        elif accepted.any():
            row_pairs = np.flatnonzero(np.repeat(accepted, 2))
            S = state_augmentation.submatrix(S, row_pairs)
            filter.update(s, rows.take(accepted), HP.take(row_pairs, axis=0), S)
        inliers[rows.feature[~accepted]] = False
        return inliers, nis

    def _gate(
        self,
        s: FilterState,
        rows: filter.FeatureMeasurements,
        make_rows: Callable[[], filter.FeatureMeasurements],
    ) -> _Gated:
        """Gate the measurements at the best linearisation. A feature must pass in both cameras."""
        if median(np.abs(rows.residual).ravel()) * self._camera.focal > _RELINEARISE_PX:
            rows = filter.relinearised_rows(s, make_rows, self.common_cov)
        HP, S = filter.innovation_covariance(s, rows, self.common_cov)
        nis = filter.nis(rows, S)
        accepted = np.ones(len(s.feature_ids), bool)
        accepted[rows.feature[nis >= self._config.gate]] = False
        return _Gated(rows, accepted[rows.feature], nis, HP, S)

    def _images_agree(self, s: FilterState, matches: FeatureMatches) -> bool:
        """Return whether nearly all matches in cam0 agree on a pose."""
        indices = np.flatnonzero(matches.is_found & ~matches.is_dynamic)
        if len(indices) < self._config.weak:
            return False
        inliers = outliers.consensus_inliers(s, indices, matches.px[indices], self._camera)
        return bool(inliers.mean() > _MIN_CONSENSUS_SHARE)
