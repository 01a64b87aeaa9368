"""Dynamic scenes: how far odometry drifts while another agent is in its picture, and while none is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import Rig
from share.geometry.interpolation import Trajectory, associate, interpolate
from share.geometry.se3 import inverse
from share.types import F64, I64

_NEAR_M, _FAR_M = 0.3, 6.0  # of others that are in view; walls are not known
_SPAN_NS, _TOLERANCE_NS = 1_000_000_000, 20_000_000


@dataclass(frozen=True)
class DriftBesideOthers:
    """Drift of odometry over 1 s, cm rms, of spans of time with another agent in view most of the time, and
    of spans without any. n_with, n_without: their numbers. Add those of several agents."""

    square_with: float = 0.0
    n_with: int = 0
    square_without: float = 0.0
    n_without: int = 0

    @property
    def with_cm(self) -> float:
        return _rms_cm(self.square_with, self.n_with)

    @property
    def without_cm(self) -> float:
        return _rms_cm(self.square_without, self.n_without)

    @property
    def share_with(self) -> float:
        """Share of the spans with another agent in view, of those that count; NaN without any."""
        total = self.n_with + self.n_without
        return self.n_with / total if total else math.nan

    def __add__(self, other: DriftBesideOthers) -> DriftBesideOthers:
        return DriftBesideOthers(
            self.square_with + other.square_with,
            self.n_with + other.n_with,
            self.square_without + other.square_without,
            self.n_without + other.n_without,
        )


def _rms_cm(square: float, n: int) -> float:
    return 100 * math.sqrt(square / n) if n else math.nan


def drift_beside_others(
    rig: Rig, estimate: Trajectory, truth: Trajectory, others: Sequence[Trajectory]
) -> DriftBesideOthers:
    """Return the drift of one agent's odometry. others: true poses of the other bodies, by its clock."""
    stamps_ns, T_estimate, T_truth = associate(estimate, truth)
    if not len(stamps_ns):
        return DriftBesideOthers()
    seen = np.any([_in_view(rig, stamps_ns, T_truth, other) for other in others], axis=0)
    seen = np.broadcast_to(seen, stamps_ns.shape)
    j = np.searchsorted(stamps_ns, stamps_ns + _SPAN_NS - _TOLERANCE_NS).clip(0, len(stamps_ns) - 1)
    i = np.flatnonzero(np.abs(stamps_ns[j] - stamps_ns - _SPAN_NS) <= _TOLERANCE_NS)
    j = j[i]
    moved = inverse(inverse(T_truth[i]) @ T_truth[j]) @ inverse(T_estimate[i]) @ T_estimate[j]
    square: F64 = (moved[:, :3, 3] ** 2).sum(1)
    count = np.concatenate([[0], np.cumsum(seen)])
    part = (count[j + 1] - count[i]) / (j + 1 - i)
    with_other, without = part > 0.5, part == 0
    return DriftBesideOthers(
        float(square[with_other].sum()),
        int(with_other.sum()),
        float(square[without].sum()),
        int(without.sum()),
    )


def _in_view(rig: Rig, stamps_ns: I64, T_world_body: F64, other: Trajectory) -> NDArray[np.bool_]:
    """Return (N,) whether the other body is in the picture of cam0."""
    known, T_world_other = interpolate(*other, stamps_ns)
    T_cam_world = inverse(T_world_body[known] @ rig.T_body_cam0)
    at = (T_cam_world @ T_world_other[:, :, 3:])[:, :3, 0]
    across, upright = (math.tan(angle / 2) for angle in rig.cam0.field_of_view_rad)
    z = at[:, 2]
    inside = (z > _NEAR_M) & (z < _FAR_M)
    inside &= (np.abs(at[:, 0]) < across * z) & (np.abs(at[:, 1]) < upright * z)
    out = np.zeros(len(stamps_ns), bool)
    out[known] = inside
    return out
