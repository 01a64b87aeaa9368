"""Solve an arrowhead system: knots coupled to their neighbours only, and a border coupled to all knots.

Banded Cholesky factorisation; the border by the Schur complement (Triggs et al., *Bundle adjustment: a modern
synthesis*, 2000, 6.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.lab.calibrate.camera_imu.normal_equations import SegmentNormals
from share.lab.calibrate.camera_imu.spline import ORDER
from share.lab.calibrate.camera_imu.state import KNOTS, LOCAL_COLUMNS, SHARED, CameraImuState
from share.types import F64

_BAND_ROWS = 6 * ORDER  # diagonals of the upper half, with the main one
_UNDERFLOW = 1e-150


@dataclass(frozen=True, eq=False)
class ArrowSystem:
    """band (36, 6 K): LAPACK's upper form of the knots' block; edge (6 K, B); corner (B, B); gradients of
    both."""

    band: F64
    edge: F64
    corner: F64
    g_knots: F64
    g_border: F64


def arrow_system(segments: SegmentNormals, state: CameraImuState) -> ArrowSystem:
    """Assemble all segments; B = SHARED + 6 M."""
    S, K = state.curve.segments, len(state.curve.p)
    border = SHARED + state.biases.size
    blocks, edge = np.zeros((K, ORDER, 6, 6)), np.zeros((K, 6, border))
    corner = np.zeros((border, border))
    spans = _bias_intervals(state)
    for a in range(ORDER):
        rows = slice(6 * a, 6 * a + 6)
        for b in range(a, ORDER):
            blocks[a : a + S, b - a] += segments.H[:, rows, 6 * b : 6 * b + 6]
        for part, columns in spans:
            edge[a : a + S][part][:, :, columns] += segments.H[part, rows, KNOTS:LOCAL_COLUMNS]
    for part, columns in spans:
        corner[np.ix_(columns, columns)] += segments.H[part, KNOTS:, KNOTS:].sum(axis=0)
    return ArrowSystem(
        _banded(blocks), edge.reshape(6 * K, border), corner, *gather_gradient(segments.g, state)
    )


def gather_gradient(g: F64, state: CameraImuState) -> tuple[F64, F64]:
    """Sum gradients by local columns, (S, LOCAL_COLUMNS, ...), into those of the knots (6 K, ...) and of
    the border (B, ...)."""
    S, K, more = state.curve.segments, len(state.curve.p), g.shape[2:]
    knots, border = np.zeros((K, 6, *more)), np.zeros((SHARED + state.biases.size, *more))
    for a in range(ORDER):
        knots[a : a + S] += g[:, 6 * a : 6 * a + 6]
    for part, columns in _bias_intervals(state):
        border[columns] += g[part, KNOTS:].sum(axis=0)
    return knots.reshape(6 * K, *more), border


def _bias_intervals(state: CameraImuState) -> list[tuple[slice, np.ndarray]]:
    """Return the segments of each bias interval, and the border's columns that they involve."""
    per, shared = state.per_node, np.arange(SHARED)
    starts = range(0, state.curve.segments, per)
    ends = [min(start + per, state.curve.segments) for start in starts]
    own = [SHARED + 6 * k + np.arange(12) for k in range(len(starts))]
    return [
        (slice(start, end), np.concatenate([shared, columns]))
        for start, end, columns in zip(starts, ends, own, strict=True)
    ]


def _banded(blocks: F64) -> F64:
    """Return blocks (K, 6, 6, 6), from each knot to itself and the five after it, as LAPACK's upper band."""
    K = len(blocks)
    out = np.zeros((_BAND_ROWS, 6 * K))
    for ahead in range(ORDER):
        for i in range(6):
            for j in range(6):
                off = 6 * ahead + j - i  # the diagonal
                if off >= 0 and ahead < K:
                    out[_BAND_ROWS - 1 - off, 6 * ahead + j :: 6][: K - ahead] = blocks[
                        : K - ahead, ahead, i, j
                    ]
    return out


def solve_arrow(system: ArrowSystem, damping: float) -> tuple[F64, F64, F64]:
    """Return the step of the knots (K, 6) and of the border (B,), and the border's covariance (B, B), with
    diagonals raised by the factor 1 + damping.

    Raises np.linalg.LinAlgError where an unknown is not observable.
    """
    from scipy.linalg import cho_solve_banded, cholesky_banded

    band = system.band.copy()
    band[-1] *= 1 + damping
    factor = (cholesky_banded(band), False)
    eliminated = cho_solve_banded(factor, np.column_stack([system.edge, system.g_knots]))
    eliminated[np.abs(eliminated) < _UNDERFLOW] = 0  # far from a bias node; denormal numbers are slow
    corner = system.corner + damping * np.diag(np.diag(system.corner))
    covariance = np.linalg.inv(corner - system.edge.T @ eliminated[:, :-1])
    step = covariance @ (system.g_border - system.edge.T @ eliminated[:, -1])
    return (
        (eliminated[:, -1] - eliminated[:, :-1] @ step).reshape(-1, 6),
        step,
        (covariance + covariance.T) / 2,
    )


def border_steps(system: ArrowSystem, knots: F64, border: F64) -> F64:
    """Return the border's steps (B, G) for G other gradients, of the knots (6 K, G) and of the border (B,
    G)."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    eliminated = cho_solve_banded(
        (cholesky_banded(system.band), False), np.column_stack([system.edge, knots])
    )
    size = system.edge.shape[1]
    reduced = system.corner - system.edge.T @ eliminated[:, :size]
    out: F64 = np.linalg.solve(reduced, border - system.edge.T @ eliminated[:, size:])
    return out
