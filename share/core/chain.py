"""From candidates to keyframes: numbers, relative poses, and the covariance of what is left out."""

from __future__ import annotations

import numpy as np

from share.geometry.se3 import compose_cov, orthonormal
from share.types import F64, Candidate, Keyframe


class Chain:
    """Every keyframe is relative to the one before it, across the candidates that were not sent."""

    _T_keyframe_candidate: F64
    _cov: F64  # of it

    def __init__(self) -> None:
        self.next_id = 0
        self.first_of_stretch = 0  # lowest id that the present stretch of odometry has or will have
        self._begun = False  # else the next keyframe begins a stretch
        self._forget_motion()

    def break_off(self) -> None:
        """Odometry broke: what comes now is of another stretch."""
        self.first_of_stretch = self.next_id
        self._begun = False
        self._forget_motion()

    def extend(self, candidate: Candidate) -> None:
        """Takes note of a candidate's motion, whether or not it will be sent."""
        if candidate.new_stretch:
            self.break_off()
        T = candidate.T_last_body
        self._T_keyframe_candidate = orthonormal(self._T_keyframe_candidate @ T)
        self._cov = compose_cov(T, self._cov, candidate.cov)

    def keyframe(self, candidate: Candidate, stamp_ns: int) -> Keyframe:
        """The last extended candidate as the next keyframe."""
        keyframe = Keyframe(
            id=self.next_id,
            reference=self.next_id - 1 if self._begun else -1,
            stamp_ns=stamp_ns,
            T_ref_body=self._T_keyframe_candidate if self._begun else candidate.T_odom_body,
            cov=self._cov,
            T_odom_body=candidate.T_odom_body,
            up=candidate.up,
            up_sigma=candidate.up_sigma,
            view=candidate.view,
            follows=self.next_id - 1,
        )
        self.next_id += 1
        self._begun = True
        self._forget_motion()
        return keyframe

    def _forget_motion(self) -> None:
        """What is summed up from here on is since the last keyframe, or since the stretch began."""
        self._T_keyframe_candidate, self._cov = np.eye(4), np.zeros((6, 6))
