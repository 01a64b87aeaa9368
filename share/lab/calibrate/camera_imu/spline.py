"""A body's trajectory as uniform B-splines of order six: cumulative on SO(3), ordinary in position.

Rotation, angular rate and their derivatives by the knots follow the recursions of Sommer et al., *Efficient
derivative computation for cumulative B-splines on Lie groups* (CVPR 2020); a separate spline of position
keeps accelerations linear in the knots (Haarbach et al., 3DV 2018).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import comb, factorial

import numpy as np

from share.geometry import se3
from share.types import F64, I64

ORDER = 6
EXTRA_KNOTS = ORDER - 1  # knots more than there are segments


@cache
def _blending_matrix() -> F64:
    """Return (6, 6): powers of u in each cumulative blending function (Qin, *General matrix
    representations for B-splines*, 2000)."""
    k = ORDER

    def entry(s: int, n: int) -> float:
        signed = (
            (-1) ** (left - s) * comb(k, left - s) * (k - 1 - left) ** (k - 1 - n) for left in range(s, k)
        )
        return float(comb(k - 1, n) / factorial(k - 1) * sum(signed))

    plain = np.array([[entry(s, n) for n in range(k)] for s in range(k)], np.float64)
    return np.asarray(np.cumsum(plain[::-1], axis=0)[::-1], np.float64)


def blending(u: F64, derivative: int) -> F64:
    """Return cumulative weights (N, 6) at u (N,) in 0 .. 1, or their derivative by u."""
    powers = np.arange(ORDER)
    fall = np.array([factorial(n) / factorial(n - derivative) if n >= derivative else 0.0 for n in powers])
    return np.asarray(
        (fall * u[:, None] ** np.maximum(powers - derivative, 0)) @ _blending_matrix().T, np.float64
    )


@dataclass(frozen=True, eq=False)
class KnotSpan:
    """Positions on a curve: segment (N,), with the knots segment .. segment + 5, and u (N,) in it."""

    segment: I64
    u: F64


@dataclass(frozen=True, eq=False)
class RotationSample:
    """R (N, 3, 3) and angular rate (N, 3) rad/s in the body frame.

    by_knots (N, 6, 3, 3): derivative of phi in R Exp(phi) by each knot's; rate_by_knots (N, 6, 3, 3): of the
    rate.
    """

    R: F64
    rate: F64
    by_knots: F64
    rate_by_knots: F64


@dataclass(frozen=True, eq=False)
class Curve:
    """Knots R (K, 3, 3), p (K, 3) m every step_s from start_ns on; K - 5 segments."""

    start_ns: int
    step_s: float
    R: F64
    p: F64

    @property
    def segments(self) -> int:
        return len(self.p) - EXTRA_KNOTS

    @property
    def end_s(self) -> float:
        """Duration, s."""
        return self.segments * self.step_s

    def locate(self, stamps_ns: I64, shift_s: float = 0.0) -> KnotSpan:
        """Locate stamps (N,) + shift_s on the curve; those outside are clamped to its ends."""
        t = ((stamps_ns - self.start_ns) * 1e-9 + shift_s) / self.step_s
        segment = np.clip(np.floor(t).astype(np.int64), 0, self.segments - 1)
        return KnotSpan(segment, np.clip(t - segment, 0.0, 1.0))

    def position(self, spans: KnotSpan, derivative: int = 0) -> tuple[F64, F64]:
        """Return p (N, 3) in the world, or its derivative by time, and the weight (N, 6) of each knot in
        it."""
        cumulative = blending(spans.u, derivative) / self.step_s**derivative
        weight = cumulative - np.concatenate([cumulative[:, 1:], np.zeros((len(spans.u), 1))], axis=1)
        knots = self.p[spans.segment[:, None] + np.arange(ORDER)]
        return np.einsum("nk,nki->ni", weight, knots), weight

    def rotation(self, spans: KnotSpan) -> RotationSample:
        """Return rotation and angular rate with their derivatives."""
        increments = se3.so3_log(self.R[:-1].swapaxes(1, 2) @ self.R[1:])
        inverse_jacobians = np.linalg.inv(se3.so3_right_jacobian(increments))
        pairs = spans.segment[:, None] + np.arange(EXTRA_KNOTS)
        share = blending(spans.u, 0)[:, 1:, None]
        share_rate = blending(spans.u, 1)[:, 1:, None, None] / self.step_s
        step = increments[pairs]
        A = se3.so3_exp(share * step)
        jacobians = se3.so3_right_jacobian(share * step) * share[..., None]
        rate, rate_by = _rates(A, jacobians, share_rate, step)
        suffix_products = _suffix_products(A)  # the rotations after each
        by, rate_by = suffix_products[:, 1:] @ jacobians, suffix_products[:, 1:] @ rate_by
        R = self.R[spans.segment] @ suffix_products[:, 0].swapaxes(1, 2)
        out = RotationSample(
            R, rate, _by_knots(by, inverse_jacobians[pairs]), _by_knots(rate_by, inverse_jacobians[pairs])
        )
        out.by_knots[:, 0] += suffix_products[:, 0]
        return out


def _rates(A: F64, jacobians: F64, share_rate: F64, step: F64) -> tuple[F64, F64]:
    """Return the angular rate (N, 3), and the derivatives (N, 5, 3, 3) of each increment's rate by its
    step."""
    rate, by = np.zeros((len(A), 3)), np.empty_like(A)
    for j in range(EXTRA_KNOTS):
        rotated_rate = (A[:, j].swapaxes(1, 2) @ rate[..., None])[..., 0]
        by[:, j] = se3.hat(rotated_rate) @ jacobians[:, j] + share_rate[:, j] * np.eye(3)
        rate = rotated_rate + share_rate[:, j, 0] * step[:, j]
    return rate, by


def _suffix_products(A: F64) -> F64:
    """Return (N, 6, 3, 3): transposed products of A[j:] for j = 0 .. 5."""
    out = np.empty((len(A), ORDER, 3, 3))
    out[:, EXTRA_KNOTS] = np.eye(3)
    for j in reversed(range(EXTRA_KNOTS)):
        out[:, j] = out[:, j + 1] @ A[:, j].swapaxes(1, 2)
    return out


def _by_knots(by_steps: F64, back: F64) -> F64:
    """Return derivatives (N, 6, 3, 3) by knots from those by the five increments between them."""
    out = np.zeros((len(back), ORDER, 3, 3))
    out[:, 1:] = by_steps @ back
    out[:, :-1] -= by_steps @ back.swapaxes(-1, -2)  # the left Jacobian is the right one's transpose
    return out
