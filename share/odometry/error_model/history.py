"""What a tracker went through in its last seconds, by what it says: how far, how sure, how surprised."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from share.geometry.se3 import angle, compose_cov, position_sigma
from share.metrics.local_error import WINDOW_S
from share.types import F64, Candidate, TrackState

MOST_AGO = 8  # frames, of a keyframe that is told of: those that are kept to know its own


class Fared(NamedTuple):
    """How a tracker fared with a frame: whether an IMU was heard, its state, how many features it found and
    how many it believed, and how surprised it was (`estimator.result`)."""

    stamp_ns: int
    heard: bool
    state: TrackState
    found: int
    believed: int
    surprise: float


class Lately(NamedTuple):
    """Since the window or, if later, the stretch began. frames: all, the last one being the keyframe.
    way_m, turn_rad: from keyframe to keyframe. sigmas_cm: by each keyframe, the last one now, one sigma of
    the position after the motion of the window before it."""

    frames: tuple[Fared, ...]
    way_m: float
    turn_rad: float
    sigmas_cm: tuple[float, ...]

    @property
    def sigma_cm(self) -> float:
        """Now."""
        return self.sigmas_cm[-1]


class Odometer:
    """Of one agent, frame by frame; window_s as that of the error that is to be told."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * 1e9)
        self._frames: deque[Fared] = deque()
        self._motions: deque[tuple[int, F64, F64]] = deque()  # when, T_last_this, its covariance
        self._sigmas: deque[tuple[int, float]] = deque()  # when, cm

    def frame(self, fared: Fared) -> None:
        """Another one, with a pose or without."""
        self._frames.append(fared)
        while self._frames[0].stamp_ns <= fared.stamp_ns - 2 * self._window_ns:  # a keyframe may be told late
            self._frames.popleft()

    def keyframe(self, stamp_ns: int, candidate: Candidate) -> Lately:
        """The frame with this stamp, the last one or one shortly before, has become one."""
        begun_ns = stamp_ns - self._window_ns + 1
        if candidate.new_stretch or not self._sigmas:  # no keyframe yet to go on from
            self._motions.clear()
            self._sigmas.clear()
            begun_ns = stamp_ns
        else:
            self._motions.append((stamp_ns, candidate.T_last_body, candidate.cov))
        while self._frames and self._frames[0].stamp_ns < begun_ns:
            self._frames.popleft()
        for past in (self._motions, self._sigmas):
            while past and past[0][0] <= stamp_ns - self._window_ns:
                past.popleft()
        way = turn = 0.0
        cov = np.zeros((6, 6))
        for _, T, more in self._motions:
            way += float(np.linalg.norm(T[:3, 3]))
            turn += float(angle(T[:3, :3]))
            cov = compose_cov(T, cov, more)
        self._sigmas.append((stamp_ns, 100 * position_sigma(cov)))
        frames = tuple(fared for fared in self._frames if fared.stamp_ns <= stamp_ns)
        return Lately(frames, way, turn, tuple(sigma for _, sigma in self._sigmas))
