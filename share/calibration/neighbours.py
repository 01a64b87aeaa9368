"""Where corners of a flat board lie by what was found around them: a homography each, of its nearest others.

Some of the others may have been found wrongly, so each homography is the least median of squares over
homographies of four (Rousseeuw 1984), then least squares over those that it explains. All corners at once: a
board has more than a hundred of them, in every picture.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from share.types import F64, I64

MOST, LEAST = 12, 6  # neighbours
_FOURS = 64  # where two fifths were found wrongly, one of them is without these, 99 of 100 times
_TRUSTED = 2.5 * 1.4826  # of the median distance, as Rousseeuw and Leroy have it
_STEPS = 2
_HELD = 1e-10
_FLOOR_PX = 0.05  # what no corner is better known than


def by_neighbours(board: F64, px: F64) -> F64:
    """Where each corner (N, 2) m is, by others of px (N, 2), NaN not found; NaN if these are too few."""
    near = _nearest(board, np.asarray(np.isfinite(px).all(axis=1)))
    if near.shape[1] < LEAST:
        return np.full(px.shape, np.nan)
    there = board[near] - board[:, None]  # each corner is the origin of its own
    there /= np.abs(there).max(axis=(1, 2), keepdims=True)
    middle = px[near].mean(axis=1)
    seen = px[near] - middle[:, None]
    with np.errstate(all="ignore"):  # three of four on one line; tags that lie anywhere
        H = _fitted(_least_median(there, seen), there, seen)
        out: F64 = H[:, :2, 2] / H[:, 2:, 2] + middle
    return out


def _nearest(board: F64, found: np.ndarray) -> I64:
    """Of each corner the nearest others that were found, (N, up to MOST)."""
    squares = ((board[:, None] - board) ** 2).sum(axis=2)
    squares[:, ~found] = np.inf
    np.fill_diagonal(squares, np.inf)
    count = min(MOST, int(found.sum()) - 1)
    return np.argsort(squares, axis=1, kind="stable")[:, : max(count, 0)]


@cache
def _fours(count: int) -> I64:
    """Which four of `count`, (_FOURS, 4), always the same."""
    return np.random.default_rng(0).random((_FOURS, count)).argsort(axis=1)[:, :4]


def _least_median(there: F64, seen: F64) -> F64:
    """(N, 3, 3) from (N, M, 2) to (N, M, 2): of all fours the one that half of the others agree with best."""
    fours = _fours(there.shape[1])
    H = _basis(seen[:, fours]) @ _adjugate(_basis(there[:, fours]))
    H = H / np.abs(H).max(axis=(2, 3), keepdims=True)
    off = np.linalg.norm(_mapped(H, there[:, None]) - seen[:, None], axis=3)
    median = np.median(np.where(np.isfinite(off), off, np.inf), axis=2)
    out: F64 = np.take_along_axis(H, median.argmin(axis=1)[:, None, None, None], axis=1)[:, 0]
    return out


def _basis(points: F64) -> F64:
    """(..., 3, 3) that takes the unit vectors and their sum to four points (..., 4, 2), to scale (Semple and
    Kneebone, *Algebraic projective geometry*)."""
    columns = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1).swapaxes(-1, -2)
    three, last = columns[..., :3], columns[..., 3:]
    out: F64 = three * (_adjugate(three) @ last).swapaxes(-1, -2)
    return out


def _adjugate(A: F64) -> F64:
    """(..., 3, 3): the inverse times the determinant."""
    a, b, c = A[..., 0], A[..., 1], A[..., 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)


def _mapped(H: F64, points: F64) -> F64:
    """(..., M, 2) of points (..., M, 2)."""
    at = points @ H[..., :2].swapaxes(-1, -2) + H[..., None, :, 2]
    out: F64 = at[..., :2] / at[..., 2:]
    return out


def _fitted(H: F64, there: F64, seen: F64) -> F64:
    """Gauss-Newton on the pixels of those that H (N, 3, 3) explains."""
    off = np.linalg.norm(_mapped(H, there) - seen, axis=2)
    limit = _TRUSTED * (1 + 5 / max(there.shape[1] - 4, 1)) * np.median(off, axis=1, keepdims=True)
    trusted = (off <= np.maximum(limit, _FLOOR_PX)).astype(np.float64)
    H = H / H[:, 2:, 2:]
    for _ in range(_STEPS):
        J, r = _linear(H, there, seen)
        weighted = (J * trusted[..., None, None]).reshape(len(H), -1, 8)
        A = weighted.swapaxes(1, 2) @ J.reshape(len(H), -1, 8)
        b = (weighted * r.reshape(len(H), -1, 1)).sum(axis=1)
        step = np.linalg.solve(_regular(A), b[..., None])[..., 0]
        H = H + np.concatenate([step, np.zeros((len(H), 1))], axis=1).reshape(-1, 3, 3)
    return H


def _regular(A: F64) -> F64:
    """(N, 8, 8) with which something can be solved, also where a board is none and nothing fits."""
    size = np.trace(A, axis1=1, axis2=2)[:, None, None]
    out: F64 = np.where(np.isfinite(size) & (size > 0), A + _HELD * size * np.eye(8), np.eye(8))
    return out


def _linear(H: F64, there: F64, seen: F64) -> tuple[F64, F64]:
    """Derivatives (N, M, 2, 8) of what H, whose last number is 1, predicts, and what is left (N, M, 2)."""
    points = np.concatenate([there, np.ones((*there.shape[:2], 1))], axis=2)
    at = points @ H.swapaxes(1, 2)
    px, scaled = at[..., :2] / at[..., 2:], points / at[..., 2:]
    J = np.zeros((*there.shape, 8))
    J[:, :, 0, :3] = J[:, :, 1, 3:6] = scaled
    J[:, :, :, 6:] = -px[..., None] * scaled[:, :, None, :2]
    return J, seen - px
