"""An agent's steps put together, with which its poses relative to earlier keyframes have to agree.

Agents are compared by their steps; poses relative to earlier keyframes that say something else, or are much
surer, would bend the map unseen. Measured on 19 emulated paths (`docs/lab/attack-figures.md`): 99 % of the
squared differences of correct agents are below 2.3 of the steps' variance; with lengths 3 % off they are 14
to 72 in the mean. And of n steps no pose has less than some 1/n of their variance, since the error of a
keyframe occurs once in it and n times in the steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from share.earlier_poses import EarlierPoses
from share.geometry import se3
from share.mapping.agents.covariance_scales import inflate_span
from share.types import F64, I64

_REACH = 64  # keyframes; SHARE's agents reach 13 back
_MAX_CHI2 = 9.0  # of translation and rotation, 2 expected at most; beyond, the robust kernel discounts it too
_LEAST_SHARE = 0.5  # of the mean variance of the steps in between


@dataclass(frozen=True, eq=False)
class StepChain:
    """The newest keyframes of a segment: ids (M,); T_first_body (M, 4, 4), composed of their steps; and
    variance (M, 2), of rotation and of translation, summed over the steps."""

    ids: I64
    T_first_body: F64
    variance: F64

    @classmethod
    def start(cls, keyframe_id: int) -> StepChain:
        return cls(np.array([keyframe_id], np.int64), np.eye(4)[None], np.zeros((1, 2)))

    def extended(self, keyframe_id: int, T_last_body: F64, cov: F64) -> StepChain:
        """Return the chain with one more keyframe, a step T_last_body (4, 4), cov (6, 6), after the last."""
        T = se3.orthonormal(self.T_first_body[-1] @ T_last_body)
        poses = np.concatenate([self.T_first_body, T[None]])[-_REACH:]
        variance = np.concatenate([self.variance, self.variance[-1:] + _variance(cov[None])])[-_REACH:]
        return StepChain(np.append(self.ids, keyframe_id)[-_REACH:], poses, variance - variance[0])

    def agreeing(self, earlier: EarlierPoses) -> tuple[EarlierPoses, str | None]:
        """Return the last keyframe's poses relative to earlier ones that agree with its steps since then, no
        surer than these allow, and what is wrong with the others; None if nothing.

        Poses relative to keyframes that the chain no longer has cannot be checked, and are left out."""
        rows = np.array([self._row(one) for one in earlier.ids.tolist()], np.int64)
        claimed = earlier.T_earlier_body.astype(np.float64)
        T = se3.inverse(claimed) @ se3.inverse(self.T_first_body[rows]) @ self.T_first_body[-1]
        distance_m, angle_rad = np.linalg.norm(T[:, :3, 3], axis=1), se3.rotation_angle(T)
        variance = self._variance_since(rows, claimed)
        chi2 = angle_rad**2 / variance[:, 0] + distance_m**2 / variance[:, 1]
        is_false = (rows >= 0) & ~(chi2 <= _MAX_CHI2)
        is_agreed = (rows >= 0) & ~is_false
        agreed = self._bounded(_kept(earlier, is_agreed), rows[is_agreed])
        if not is_false.any():
            return agreed, None
        worst = int(np.where(is_false, distance_m, -1.0).argmax())
        away = f"{distance_m[worst]:.2g} m and {np.degrees(angle_rad[worst]):.2g} degrees"
        what = f"its pose relative to keyframe {earlier.ids[worst]}"
        return agreed, f"{what} is {away} off its steps: without it"

    def _variance_since(self, rows: I64, T_earlier_body: F64) -> F64:
        """Variance (N, 2), of rotation and of translation, of poses (N, 4, 4) composed of the steps since
        these rows, with the floor that the graph adds to steps."""
        count = len(self.ids) - 1 - rows
        floors = [inflate_span(T, np.zeros((6, 6)), n) for T, n in zip(T_earlier_body, count, strict=True)]
        variance = self.variance[-1] - self.variance[rows] + _variance(np.array(floors).reshape(-1, 6, 6))
        length_m = np.linalg.norm(T_earlier_body[:, :3, 3], axis=1)
        variance[:, 1] += length_m**2 * variance[:, 0] / 3  # by the rotations on the way
        return np.asarray(variance)

    def _bounded(self, earlier: EarlierPoses, rows: I64) -> EarlierPoses:
        """Return poses relative to keyframes in these rows, with the least variance that the steps allow."""
        count = len(self.ids) - 1 - rows
        least = _LEAST_SHARE * (self.variance[-1] - self.variance[rows]) / count[:, None]
        missing = np.maximum(0.0, least - _variance(earlier.cov))
        if not missing.any():
            return earlier
        added = np.repeat(missing / 3, 3, axis=1)[:, :, None] * np.eye(6)
        return replace(earlier, cov=(earlier.cov + added).astype(np.float32))

    def _row(self, keyframe_id: int) -> int:
        """Row of a keyframe before the last; -1 if the chain does not have it."""
        row = int(np.searchsorted(self.ids, keyframe_id))
        return row if row < len(self.ids) - 1 and self.ids[row] == keyframe_id else -1


def _variance(covs: NDArray[np.floating]) -> F64:
    """Sums (N, 2) of the variances of rotation and of translation in covariances (N, 6, 6)."""
    diagonal = covs.diagonal(axis1=1, axis2=2).astype(np.float64)
    return np.asarray(diagonal.reshape(-1, 2, 3).sum(axis=2))


def _kept(earlier: EarlierPoses, is_kept: NDArray[np.bool_]) -> EarlierPoses:
    rows = np.flatnonzero(is_kept).tolist()
    return earlier if len(rows) == len(earlier) else earlier.take(rows, earlier.ids[rows].tolist())
