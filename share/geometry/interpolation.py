"""Interpolate poses (ground truth at the stamps of an estimate) and the peak of a sampled curve.

A trajectory is (stamps_ns (N,) int64 rising, T (N, 4, 4)).
"""

from __future__ import annotations

import numpy as np

from share.errors import DataError
from share.geometry.se3 import from_rt, so3_exp, so3_log
from share.types import F64, I64

Trajectory = tuple[I64, F64]

MAX_GAP_NS = 100_000_000  # truth is not interpolated across more; motion capture has >= 20 Hz


def associate(estimate: Trajectory, truth: Trajectory, max_gap_ns: int = MAX_GAP_NS) -> tuple[I64, F64, F64]:
    """Return (stamps_ns, T_estimate, T_truth) at every stamp of the estimate where the truth is known.

    It is known at a sample, or between two that are at most `max_gap_ns` apart. Raises ValueError for a wrong
    shape or stamps that do not rise.
    """
    stamps, T_estimate = _checked("estimate", estimate)
    truth_ns, T_truth = _checked("truth", truth)
    known, T = interpolate(truth_ns, T_truth, stamps, max_gap_ns)
    return stamps[known], T_estimate[known], T


def interpolate(stamps_ns: I64, T: F64, at_ns: I64, max_gap_ns: int = MAX_GAP_NS) -> tuple[np.ndarray, F64]:
    """Return (known (M,) bool, poses (K, 4, 4) at the K known of the M stamps `at_ns`).

    Positions are interpolated linearly, rotations by slerp.
    """
    if len(stamps_ns) == 0:
        return np.zeros(len(at_ns), bool), np.zeros((0, 4, 4))
    right = np.searchsorted(stamps_ns, at_ns, side="left").clip(0, len(stamps_ns) - 1)
    exact = stamps_ns[right] == at_ns
    left = np.where(exact, right, right - 1).clip(0)
    inside = (stamps_ns[left] <= at_ns) & (at_ns <= stamps_ns[right])
    known = inside & (stamps_ns[right] - stamps_ns[left] <= max_gap_ns)
    a, b, at_ns = left[known], right[known], at_ns[known]
    step = np.maximum(stamps_ns[b] - stamps_ns[a], 1)
    u = ((at_ns - stamps_ns[a]) / step)[:, None]
    Ra, Rb, ta, tb = T[a, :3, :3], T[b, :3, :3], T[a, :3, 3], T[b, :3, 3]
    phi = so3_log(np.swapaxes(Ra, -1, -2) @ Rb)
    return known, from_rt(Ra @ so3_exp(u * phi), (1 - u) * ta + u * tb)


def require_poses(n: int, minimum: int, metric: str) -> None:
    """Raise DataError if fewer than `minimum` of the poses are associated."""
    if n < minimum:
        raise DataError(
            f"{metric}: {n} poses of the estimate have a ground truth, at least {minimum} are needed; "
            "check that both use the same clock"
        )


def subsample_peak(score: F64, i: int) -> float:
    """Return the peak of the parabola through score[i - 1 : i + 2], in steps from i, at most half a step;
    0 at an end of the curve and where it is not concave."""
    if not 0 < i < len(score) - 1:
        return 0.0
    left, middle, right = score[i - 1 : i + 2]
    bend = left - 2 * middle + right
    return float(np.clip((left - right) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0


def _checked(name: str, trajectory: Trajectory) -> Trajectory:
    stamps, T = np.asarray(trajectory[0], np.int64), np.asarray(trajectory[1], np.float64)
    if stamps.ndim != 1 or T.shape != (len(stamps), 4, 4):
        raise ValueError(f"{name}: stamps {stamps.shape} and poses {T.shape}, expected (N,) and (N, 4, 4)")
    if (np.diff(stamps) <= 0).any():
        raise ValueError(f"{name}: stamps do not rise")
    return stamps, T
