"""How much Allan variances of one recording scatter, and how alike.

A running sum of samples with white noise, flicker noise and a random walk has stationary second differences,
whose covariances follow from one function of the lag (a generalised covariance: Matheron 1973)

    G(h) = -N^2 |h| / 2  +  B^2 h^2 ln|h| / (2 pi)  +  K^2 |h|^3 / 12

and a mean of squares of normal values has the covariance 2 sum R(k)^2 / n^2 (Isserlis). That gives the
equivalent degrees of freedom of NIST SP 1065, 5.4, for any mixture of the three, and the covariance between
averaging times, which fits usually leave out: neighbours are nearly copies.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from share.types import F64, I64

_FULL, _NEAR = 65, 33  # lags over all of a sum, and about each of its nine corners
_SECOND = np.array([1.0, -2.0, 1.0])


def _white(h: F64) -> F64:
    return -h / 2


def _flicker(h: F64) -> F64:
    return np.asarray(h * h * np.log(np.maximum(h, 1e-300)) / (2 * np.pi), np.float64)


def _walk(h: F64) -> F64:
    return h**3 / 12


_PARTS: tuple[Callable[[F64], F64], ...] = (_white, _flicker, _walk)


def scatter(sizes: I64, lengths: I64, rate_hz: float) -> F64:
    """(3, 3, T, T): with squares p = (N^2, B^2, K^2) of one axis, sum_ab p_a p_b out[a, b] is the covariance
    of its Allan variances at T sizes, from stretches of `lengths` (S,) samples."""
    out = np.zeros((3, 3, len(sizes), len(sizes)))
    for i, m in enumerate(sizes):
        for j, n in enumerate(sizes[: i + 1]):
            out[:, :, i, j] = out[:, :, j, i] = _pair(int(m), int(n), lengths, 1 / rate_hz)
    return out


def _pair(m: int, n: int, lengths: I64, dt: float) -> F64:
    """(3, 3) of the variances at m and n samples."""
    corners = np.arange(3)[:, None] * m - np.arange(3) * n
    k, weight = _lags(corners, m, n)
    h = np.abs(k[:, None, None] - corners) * dt
    R = np.stack([np.einsum("kab,a,b->k", part(h), _SECOND, _SECOND) for part in _PARTS])
    count, pairs = _pairs(k, lengths, m, n)
    return np.asarray(
        2 * (R * (weight * count)) @ R.T / pairs / (4 * (m * dt) ** 2 * (n * dt) ** 2), np.float64
    )


def _lags(corners: I64, m: int, n: int) -> tuple[I64, F64]:
    """Whole lags, close where the covariance has corners, and how many each stands for."""
    reach, near = 2 * (m + n), 2 * min(m, n)
    around = corners.reshape(-1, 1) + np.linspace(-near, near, _NEAR)
    everywhere = m - n + np.linspace(-reach, reach, _FULL)
    k = np.unique(np.rint(np.concatenate([around.ravel(), everywhere])).astype(np.int64))
    gaps = np.diff(k, prepend=k[0] - 1, append=k[-1] + 1)
    return k, (gaps[1:] + gaps[:-1]) / 2


def _pairs(k: I64, lengths: I64, m: int, n: int) -> tuple[F64, float]:
    """At how many places each lag is found, over all stretches; the product of the numbers of differences."""
    of_m, of_n = np.maximum(lengths + 1 - 2 * m, 0), np.maximum(lengths + 1 - 2 * n, 0)
    lag = k[:, None]
    count = np.clip(np.minimum(of_m, of_n - lag) - np.maximum(0, -lag), 0, None).sum(axis=1)
    return count.astype(np.float64), float(of_m.sum()) * float(of_n.sum())
