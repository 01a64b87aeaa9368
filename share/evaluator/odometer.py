"""What a tracker says itself of its last seconds: how far it went, and how far off it may be by now."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from share.geometry.se3 import angle, compose_cov
from share.metrics.local_error import WINDOW_S
from share.types import F64, Candidate


@dataclass(frozen=True)
class Lately:
    """Since since_ns, when the window or, if later, the stretch began: metres of way and radians of turn from
    keyframe to keyframe; sigma_cm, one sigma of the position after that motion."""

    since_ns: int
    way_m: float
    turn_rad: float
    sigma_cm: float


class Odometer:
    """Of one agent, keyframe by keyframe; window_s as that of the error that is to be told."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * 1e9)
        self._began_ns: int | None = None  # the stretch
        self._motions: deque[tuple[int, F64, F64]] = deque()  # when, T_last_this, its covariance

    def after(self, stamp_ns: int, candidate: Candidate) -> Lately:
        if candidate.new_stretch or self._began_ns is None:
            self._motions.clear()
            self._began_ns = stamp_ns
        else:
            self._motions.append((stamp_ns, candidate.T_last_body, candidate.cov))
        while self._motions and self._motions[0][0] <= stamp_ns - self._window_ns:
            self._motions.popleft()
        way = turn = 0.0
        cov = np.zeros((6, 6))
        for _, T, more in self._motions:
            way += float(np.linalg.norm(T[:3, 3]))
            turn += float(angle(T[:3, :3]))
            cov = compose_cov(T, cov, more)
        sigma_cm = 100 * math.sqrt(max(0.0, float(np.trace(cov[3:, 3:]))))
        return Lately(max(stamp_ns - self._window_ns, self._began_ns), way, turn, sigma_cm)
