"""What a tracker went through in its last seconds, by what it says: how far, how sure, how surprised."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from share.geometry.se3 import compose_cov, position_sigma, rotation_angle
from share.metrics.local_error import WINDOW_S
from share.types import F64, KeyframeCandidate, TrackState

MOST_AGO = 8  # frames, of a keyframe that is told of: those that are kept to know its own


class FrameOutcome(NamedTuple):
    """How a tracker fared with a frame: whether an IMU was heard, its state, how many features it found and
    how many it believed, and how surprised it was (`estimator.result`)."""

    stamp_ns: int
    has_imu: bool
    state: TrackState
    found_count: int
    inlier_count: int
    median_nis: float


class RecentMotion(NamedTuple):
    """Since the window or, if later, the stretch began. frames: all, the last one being the keyframe.
    way_m, turn_rad: from keyframe to keyframe. sigmas_cm: by each keyframe, the last one now, one sigma of
    the position after the motion of the window before it."""

    frames: tuple[FrameOutcome, ...]
    path_m: float
    rotation_rad: float
    sigmas_cm: tuple[float, ...]

    @property
    def sigma_cm(self) -> float:
        """Now."""
        return self.sigmas_cm[-1]


class MotionHistory:
    """Of one agent, frame by frame; window_s as that of the error that is to be told."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * 1e9)
        self._frames: deque[FrameOutcome] = deque()
        self._motions: deque[tuple[int, F64, F64]] = deque()  # when, T_last_this, its covariance
        self._sigmas: deque[tuple[int, float]] = deque()  # when, cm

    def add_frame(self, outcome: FrameOutcome) -> None:
        """Another one, with a pose or without."""
        self._frames.append(outcome)
        while (
            self._frames[0].stamp_ns <= outcome.stamp_ns - 2 * self._window_ns
        ):  # a keyframe may be told late
            self._frames.popleft()

    def add_keyframe(self, stamp_ns: int, candidate: KeyframeCandidate) -> RecentMotion:
        """The frame with this stamp, the last one or one shortly before, has become one."""
        begun_ns = stamp_ns - self._window_ns + 1
        if candidate.new_segment or not self._sigmas:  # no keyframe yet to go on from
            self._motions.clear()
            self._sigmas.clear()
            begun_ns = stamp_ns
        else:
            self._motions.append((stamp_ns, candidate.T_previous_body, candidate.cov))
        while self._frames and self._frames[0].stamp_ns < begun_ns:
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
        frames = tuple(fared for fared in self._frames if fared.stamp_ns <= stamp_ns)
        return RecentMotion(frames, path_m, rotation_rad, tuple(sigma for _, sigma in self._sigmas))
