"""An agent's tracking over the last seconds: motion, its uncertainty, and the outcome of each frame."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from share.geometry.se3 import compose_cov, position_sigma, rotation_angle
from share.metrics.local_error import WINDOW_S
from share.types import F64, OdometryKeyframe, TrackState


class FrameOutcome(NamedTuple):
    """How a frame was tracked: with IMU samples or not, its state, features found and inliers, and the
    median NIS (`TrackResult`)."""

    stamp_ns: int
    has_imu: bool
    state: TrackState
    found_count: int
    inlier_count: int
    median_nis: float


class RecentMotion(NamedTuple):
    """Motion since the window began or, if later, the segment.

    frames: all, the last being the keyframe's. path_m, rotation_rad: sums over the motions between keyframes.
    sigmas_cm: at each keyframe, the last one now, the position sigma of the motion in the window before it.
    """

    frames: tuple[FrameOutcome, ...]
    path_m: float
    rotation_rad: float
    sigmas_cm: tuple[float, ...]

    @property
    def sigma_cm(self) -> float:
        """The sigma at the last keyframe."""
        return self.sigmas_cm[-1]


class MotionHistory:
    """The history of one agent, frame by frame. window_s: the window of the tracking error that the error
    model estimates."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * 1e9)
        self._frames: deque[FrameOutcome] = deque()
        self._motions: deque[tuple[int, F64, F64]] = deque()  # stamp_ns, T_previous_this, its covariance
        self._sigmas: deque[tuple[int, float]] = deque()  # stamp_ns, cm

    def add_frame(self, outcome: FrameOutcome) -> None:
        """Add a frame, with a pose or without."""
        self._frames.append(outcome)
        # Two windows, because a keyframe may be published some frames later.
        while self._frames[0].stamp_ns <= outcome.stamp_ns - 2 * self._window_ns:
            self._frames.popleft()

    def add_keyframe(self, stamp_ns: int, keyframe: OdometryKeyframe) -> RecentMotion:
        """Add the keyframe with this stamp, that of the last frame or of one shortly before. Return the
        motion up to it."""
        start_ns = stamp_ns - self._window_ns + 1
        if keyframe.new_segment or not self._sigmas:  # no keyframe yet to continue from
            self._motions.clear()
            self._sigmas.clear()
            start_ns = stamp_ns
        else:
            self._motions.append((stamp_ns, keyframe.T_previous_body, keyframe.cov))
        while self._frames and self._frames[0].stamp_ns < start_ns:
            self._frames.popleft()
        for entries in (self._motions, self._sigmas):
            while entries and entries[0][0] <= stamp_ns - self._window_ns:
                entries.popleft()
        path_m = rotation_rad = 0.0
        cov = np.zeros((6, 6))
        for _, T, step_cov in self._motions:
            path_m += float(np.linalg.norm(T[:3, 3]))
            rotation_rad += float(rotation_angle(T[:3, :3]))
            cov = compose_cov(T, cov, step_cov)
        self._sigmas.append((stamp_ns, 100 * position_sigma(cov)))
        frames = tuple(outcome for outcome in self._frames if outcome.stamp_ns <= stamp_ns)
        return RecentMotion(frames, path_m, rotation_rad, tuple(sigma for _, sigma in self._sigmas))
