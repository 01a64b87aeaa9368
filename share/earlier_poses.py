"""Poses of a keyframe relative to earlier ones: odometry over several keyframes, as an agent sends it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.checks import MAX_ODOM_M, check_covs, check_poses, checked_array

MAX_EARLIER = 32  # keyframes to which a tracker gives a candidate's pose
MAX_SPANS = 8  # of them, in a keyframe that is sent; agents send three


@dataclass(frozen=True, eq=False)
class EarlierPoses:
    """Poses of a keyframe's body relative to M earlier keyframes, as the tracker knows them.

    ids (M,) int64: of the keyframes; their stamps, ns, as long as they are candidates. T_earlier_body (M, 4,
    4) and covariances cov (M, 6, 6), float32.
    """

    ids: NDArray[np.int64]
    T_earlier_body: NDArray[np.float32]
    cov: NDArray[np.float32]

    def __post_init__(self) -> None:
        n = len(self.ids)
        if n > MAX_EARLIER:
            raise ValueError(f"earlier: {n} keyframes, at most {MAX_EARLIER}")
        checked = {
            "ids": checked_array("ids", self.ids, (n,), np.int64),
            "T_earlier_body": checked_array("T_earlier_body", self.T_earlier_body, (n, 4, 4), np.float32),
            "cov": checked_array("earlier.cov", self.cov, (n, 6, 6), np.float32),
        }
        if len(np.unique(checked["ids"])) < n:
            raise ValueError("earlier: a keyframe occurs twice")
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        check_poses("T_earlier_body", self.T_earlier_body, MAX_ODOM_M)
        check_covs("earlier.cov", self.cov.astype(np.float64))

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, rows: Sequence[int], ids: Sequence[int]) -> EarlierPoses:
        """Return these rows with other ids."""
        chosen = np.array(rows, np.int64)
        return EarlierPoses(np.array(ids, np.int64), self.T_earlier_body[chosen], self.cov[chosen])

    @staticmethod
    def empty() -> EarlierPoses:
        return EarlierPoses(
            np.zeros(0, np.int64), np.zeros((0, 4, 4), np.float32), np.zeros((0, 6, 6), np.float32)
        )
