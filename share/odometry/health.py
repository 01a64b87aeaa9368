"""Health of the filter: do images and IMU agree, has it diverged, is its state plausible?"""

from __future__ import annotations

import numpy as np

from share.odometry import filter
from share.odometry.state import FilterState
from share.odometry.track_result import median
from share.types import F64, TrackState

MIN_OK_FEATURES = 25  # in use; with fewer the state is WEAK
MIN_POSE_FEATURES = 6  # in use; with fewer it is INERTIAL_ONLY
_MAX_DRIFT_M = 0.5  # position sigma since the newest keyframe with features at which the state is LOST
_SETTLING_S = 1.0  # after its start, in which a filter converges
_MIN_DURATION_S = 1.0  # of frames after that, before an inconsistency is reported
_AVERAGING_S = 5.0  # of the exponential mean
_MIN_MEASUREMENTS = 25  # features in a frame; with fewer it is ignored
_MAX_MEDIAN_NIS = 0.8  # 0.05 to 0.6 where the calibration is right
_MAX_EMPTY_FRAMES = 3  # frames in which almost no feature is found where it should be
_MAX_REJECTED_S = 1.0  # time in which almost every feature is rejected, less that in which some are not
_MAX_INTERVAL_S = 0.2  # the most that one frame adds to it


class ImageImuConsistency:
    """Detects a camera that is rotated or shifted against its calibration, or whose clock is off, by the mean
    of the median NIS.

    Such a camera is tracked all the same: all features lie a little beside their prediction, frame after
    frame, and none is rejected. With 5 degrees and 5 cm the median rises to 1.2 to 3
    (docs/understand/odometry.md).
    """

    def __init__(self) -> None:
        self._mean, self._seconds = 0.0, 0.0

    def add(self, nis: F64, interval_s: float) -> None:
        """Add `filter.nis` (M,) of a frame's features, `interval_s` after the frame before."""
        if len(nis) < _MIN_MEASUREMENTS:
            return
        self._seconds += interval_s
        measured_s = self._seconds - _SETTLING_S
        if measured_s <= 0:
            return
        gain = min(interval_s / min(measured_s, _AVERAGING_S), 1.0)
        self._mean += gain * (median(nis) - self._mean)

    @property
    def is_consistent(self) -> bool:
        """False where images and IMU contradict each other."""
        return self._seconds < _SETTLING_S + _MIN_DURATION_S or self._mean < _MAX_MEDIAN_NIS


class DivergenceMonitor:
    """Detects a diverged filter: textured images show almost none of the features that should be in view, or
    for long none that the filter accepts.

    Features that have left the view do not count. A frame with fewer than `MIN_OK_FEATURES` in view says
    little; fewer than `MIN_POSE_FEATURES` found or accepted count as none. New features agree with a wrong
    IMU for a frame or two, so a frame in which some are accepted takes off no more than its own time.

    blind_drift_m: position sigma, m, from the newest keyframe with accepted features to the newest of all.
    """

    def __init__(self) -> None:
        self._empty_frames, self._rejected_s = 0, 0.0
        self.blind_drift_m = 0.0

    def add_keyframe(self, drift_m: float, inlier_count: int) -> None:
        """Add a keyframe at a frame with `inlier_count` accepted features, `drift_m` from the one before.

        Without any the keyframe is known no better than the body. A sum of sigmas bounds that of the sum.
        """
        self.blind_drift_m = self.blind_drift_m + drift_m if inlier_count < MIN_POSE_FEATURES else 0.0

    def add(
        self, textured: bool, in_view: int, found_count: int, inlier_count: int, interval_s: float
    ) -> None:
        """Add a frame, `interval_s` after the one before.

        textured: the image shows something. `in_view` features should be in view, `found_count` were found,
        `inlier_count` were accepted as well.
        """
        if not textured:
            return
        if in_view >= MIN_OK_FEATURES:
            self._empty_frames = self._empty_frames + 1 if found_count < MIN_POSE_FEATURES else 0
        if in_view >= MIN_POSE_FEATURES:  # else all were rejected in the frame before, and are gone
            step_s = min(interval_s, _MAX_INTERVAL_S)
            is_rejected = inlier_count < MIN_POSE_FEATURES
            self._rejected_s = max(self._rejected_s + (step_s if is_rejected else -step_s), 0.0)

    @property
    def is_suspected(self) -> bool:
        """True from the first such frame on."""
        return self._empty_frames > 0 or self._rejected_s > 0

    @property
    def has_diverged(self) -> bool:
        """True after too many such frames."""
        return self._empty_frames >= _MAX_EMPTY_FRAMES or self._rejected_s > _MAX_REJECTED_S


def is_plausible(s: FilterState, max_speed_m_s: float, blind_drift_m: float) -> bool:
    """Return whether the state is finite, not too fast, and its drift since the newest keyframe with features
    small. blind_drift_m: from there to the newest keyframe."""
    finite = np.isfinite(s.T).all() and np.isfinite(s.v).all() and np.isfinite(s.cov).all()
    return bool(
        finite and np.linalg.norm(s.v) < max_speed_m_s and blind_drift_m + filter.drift_m(s) < _MAX_DRIFT_M
    )


def pose_state(count: int, has_imu: bool) -> TrackState:
    """Return the state of a frame whose pose is based on `count` features and, with `has_imu`, on the IMU."""
    if count < MIN_POSE_FEATURES:
        return TrackState.INERTIAL_ONLY if has_imu else TrackState.LOST
    if not has_imu:
        return TrackState.VISION_ONLY
    return TrackState.OK if count >= MIN_OK_FEATURES else TrackState.WEAK
