"""From candidates to keyframes: numbers, relative poses, and the covariance of what is left out."""

from __future__ import annotations

import numpy as np

from share.geometry.se3 import compose_cov, inverse
from share.types import F64, Candidate, Keyframe


class Chain:
    """Every keyframe is relative to the one before it, across the candidates that were not sent."""

    def __init__(self) -> None:
        self.next_id = 0
        self.first_of_stretch = 0  # lowest id that the present stretch of odometry has or will have
        self._T_odom_keyframe: F64 | None = None  # None: the next keyframe begins a stretch
        self._T_odom_candidate: F64 | None = None
        self._cov: F64 = np.zeros((6, 6))  # of the motion since the last keyframe

    def break_off(self) -> None:
        """Odometry broke: what comes now is of another stretch."""
        self.first_of_stretch = self.next_id
        self._T_odom_keyframe = self._T_odom_candidate = None

    def extend(self, candidate: Candidate) -> None:
        """Takes note of a candidate's motion, whether or not it will be sent."""
        if candidate.new_stretch:
            self.break_off()
        if self._T_odom_candidate is None:
            self._cov = candidate.cov
        else:
            T_step = inverse(self._T_odom_candidate) @ candidate.T_odom_body
            self._cov = compose_cov(T_step, self._cov, candidate.cov)
        self._T_odom_candidate = candidate.T_odom_body

    def keyframe(self, candidate: Candidate, stamp_ns: int) -> Keyframe:
        """The last extended candidate as the next keyframe."""
        T_odom_body, T_odom_ref = candidate.T_odom_body, self._T_odom_keyframe
        keyframe = Keyframe(
            id=self.next_id,
            reference=-1 if T_odom_ref is None else self.next_id - 1,
            stamp_ns=stamp_ns,
            T_ref_body=T_odom_body if T_odom_ref is None else inverse(T_odom_ref) @ T_odom_body,
            cov=self._cov,
            up=candidate.up,
            view=candidate.view,
            follows=self.next_id - 1,
        )
        self.next_id += 1
        self._T_odom_keyframe = T_odom_body
        self._cov = np.zeros((6, 6))
        return keyframe
