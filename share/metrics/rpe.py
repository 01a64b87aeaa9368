"""Relative pose error (RPE): drift over one frame, or over a span of time.

Source: Sturm et al., IROS 2012, eq. 1-2: E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) for truth Q, estimate P.
Needs no alignment. Protocol: docs/do/evaluate.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.errors import DataError
from share.geometry.interpolation import Trajectory, associate
from share.geometry.se3 import inverse, rotation_angle
from share.metrics.ate import ErrorStatistics, error_statistics
from share.types import F64, I64

_MAX_STEP_NS, _DELTA_NS, _TOLERANCE_NS = 200_000_000, 1_000_000_000, 20_000_000


@dataclass(frozen=True)
class Rpe:
    """translation in m, rotation in rad, over the same pairs of poses."""

    translation: ErrorStatistics
    rotation: ErrorStatistics


def rpe_frames(estimate: Trajectory, truth: Trajectory) -> Rpe:
    """Return the RPE from each frame to the next. Steps over 0.2 s (lost, no truth) are left out.

    Raises DataError if no pair is left.
    """
    stamps, T_est, T_truth = associate(estimate, truth)
    i = np.flatnonzero(np.diff(stamps) <= _MAX_STEP_NS)
    return _rpe(T_est, T_truth, i, i + 1, "between frames")


def rpe_time(estimate: Trajectory, truth: Trajectory) -> Rpe:
    """Return the RPE from each frame to the frame nearest to 1 s later, within 20 ms.

    Raises DataError if no pair is left.
    """
    stamps, T_est, T_truth = associate(estimate, truth)
    if len(stamps) == 0:
        raise DataError("RPE: no estimated pose has a truth at its time")
    j = _nearest(stamps, stamps + _DELTA_NS)
    i = np.flatnonzero(np.abs(stamps[j] - stamps - _DELTA_NS) <= _TOLERANCE_NS)
    return _rpe(T_est, T_truth, i, j[i], "over 1 s")


def _nearest(stamps: I64, queries_ns: I64) -> I64:
    right = np.searchsorted(stamps, queries_ns).clip(0, len(stamps) - 1)
    left = (right - 1).clip(0)
    out: I64 = np.where(np.abs(stamps[left] - queries_ns) <= np.abs(stamps[right] - queries_ns), left, right)
    return out


def _rpe(T_est: F64, T_truth: F64, i: I64, j: I64, label: str) -> Rpe:
    if len(i) == 0:
        raise DataError(f"RPE {label}: no pair of estimated poses has a truth at both times")
    moved_est = inverse(T_est[i]) @ T_est[j]
    moved_truth = inverse(T_truth[i]) @ T_truth[j]
    E = inverse(moved_truth) @ moved_est
    return Rpe(error_statistics(np.linalg.norm(E[:, :3, 3], axis=1)), error_statistics(rotation_angle(E)))
