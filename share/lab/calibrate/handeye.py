"""How two bodies that move as one sit on each other: A X = X B.

A are motions of one body, B the same motions of the other, each in its own frame; no common world is needed.
Start: rotation, then translation (Park and Martin, *Robot sensor calibration: solving AX = XB on the
Euclidean group*, IEEE TRA 10(5), 1994); then both at once. All with Cauchy weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.errors import DataError
from share.geometry import se3
from share.geometry.se3 import rotation
from share.types import F64, I64

LEAST_TURN = np.radians(5.0)  # rms about the second axis; below, one direction is guessed
_LEAST_MOTIONS = 10
_ROUNDS = 10
_CAUCHY = 2.5  # robust sigmas at which a motion begins to be doubted


@dataclass(frozen=True, eq=False)
class HandEye:
    """T_a_b (4, 4) takes coordinates of body b to body a; cov (6, 6) of it, perturbed at the right (rotation
    rad, translation m), taking motions for independent. turning (3,): rms rotation rad of the motions about
    their principal axes, largest first. rotation_rms rad, position_rms m: of what is left, weighted."""

    T_a_b: F64
    cov: F64
    turning: F64
    rotation_rms: float
    position_rms: float
    motions: int


def hand_eye(A: F64, B: F64) -> HandEye:
    """Of motions A, B (N, 4, 4): T_a(i)_a(j) and T_b(i)_b(j).

    Raises DataError for fewer than 10, and where the bodies turned about one axis only, or not at all.
    """
    if A.shape != B.shape or len(A) < _LEAST_MOTIONS:
        raise DataError(
            f"hand-eye: {min(len(A), len(B))} motions, at least {_LEAST_MOTIONS} are needed; record longer"
        )
    alpha, beta = se3.so3_log(A[:, :3, :3]), se3.so3_log(B[:, :3, :3])
    turning = np.linalg.svd(alpha, compute_uv=False) / np.sqrt(len(alpha))
    if turning[1] < LEAST_TURN:
        most, next_most, least = np.degrees([*turning[:2], LEAST_TURN])
        raise DataError(
            f"hand-eye: the bodies turned by {most:.1f} deg rms about one axis and by {next_most:.1f} deg "
            f"about the next, {least:.0f} are needed; turn the device about two axes or more: nod, roll, "
            "look around"
        )
    R = _rotation(alpha, beta)
    return _refined(A, B, se3.compose(R, _translation(A, B, R)), turning)


def _rotation(alpha: F64, beta: F64) -> F64:
    """(3, 3) that takes beta to alpha, both (N, 3)."""
    weight = np.ones(len(alpha))
    for _ in range(_ROUNDS):
        R = rotation((alpha * weight[:, None]).T @ beta)
        weight = _weights(np.linalg.norm(alpha - beta @ R.T, axis=1))
    return R


def _translation(A: F64, B: F64, R: F64) -> F64:
    """(3,) with (R_A - I) t = R t_B - t_A."""
    J, y = A[:, :3, :3] - np.eye(3), B[:, :3, 3] @ R.T - A[:, :3, 3]
    weight = np.ones(len(A))
    for _ in range(_ROUNDS):
        JW = J * weight[:, None, None]
        t = np.linalg.solve(np.einsum("nij,nik->jk", JW, J), np.einsum("nij,ni->j", JW, y))
        weight = _weights(np.linalg.norm(J @ t - y, axis=1))
    return np.asarray(t, np.float64)


def _weights(size: F64) -> F64:
    """Cauchy's (N,), by residuals' sizes; their scale from the median."""
    scale = max(float(np.median(size)), 1e-12)
    return np.asarray(1 / (1 + (size / (_CAUCHY * scale)) ** 2), np.float64)


def _refined(A: F64, B: F64, X: F64, turning: F64) -> HandEye:
    """Both at once, by Gauss-Newton from X: turns and ways weighed by what is left of each, since far ways
    tell the rotation too. Exp(xi) at the right of X moves Log(B^-1 X^-1 A X) by xi - Ad(B^-1) xi."""
    J = np.eye(6) - se3.adjoint(se3.inverse(B))
    weight = np.ones(len(A))
    for _ in range(_ROUNDS):
        left = se3.log(se3.inverse(B) @ se3.inverse(X) @ A @ X)
        rms = [float(np.sqrt(np.average((part**2).sum(1), weights=weight))) for part in np.split(left, 2, 1)]
        sigma = np.repeat(np.maximum(rms, 1e-12), 3) / np.sqrt(3)
        weight = _weights(np.linalg.norm(left / sigma, axis=1))
        JW = J / sigma[:, None] ** 2 * weight[:, None, None]
        cov = np.linalg.inv(np.einsum("nij,nik->jk", JW, J))
        X = X @ se3.exp(-cov @ np.einsum("nij,ni->j", JW, left))
    return HandEye(X, cov, turning, rms[0], rms[1], len(A))


# ---- A mounting found otherwise, checked by hand-eye from the paths of both bodies.

_SPAN_NS = 1_000_000_000  # of a motion: long enough to turn, short enough not to drift
_APART = 4.0  # standard errors by which two ways may differ


@dataclass(frozen=True, eq=False)
class Check:
    """turned rad, shifted m: how far `found` is from what was to be checked; sigmas: that in standard errors
    of hand-eye (Mahalanobis over the square root of six)."""

    found: HandEye
    turned: float
    shifted: float
    sigmas: float

    @property
    def agrees(self) -> bool:
        return self.sigmas < _APART


def check(T_a_b: F64, stamps_ns: I64, T_a: F64, T_b: F64) -> Check:
    """T_a_b (4, 4) by paths T_a, T_b (N, 4, 4) of both bodies at stamps (N,), each in its own world.

    Raises DataError where they are too short, or turn about one axis only.
    """
    first, last = _motions(stamps_ns)
    if not len(first):
        raise DataError("hand-eye: the two paths do not overlap by a second; are they of one recording?")
    found = hand_eye(_between(T_a, first, last), _between(T_b, first, last))
    error = se3.log(se3.inverse(found.T_a_b) @ T_a_b)
    shared = max(1.0, _SPAN_NS / float(np.median(np.diff(stamps_ns))))  # motions that overlap tell the same
    sigmas = np.sqrt(error @ np.linalg.solve(found.cov * shared, error) / len(error))
    turned, shifted = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
    return Check(found, float(turned), float(shifted), float(sigmas))


def _motions(stamps_ns: I64) -> tuple[I64, I64]:
    """Places (M,) where motions of about a second begin and end; none over a gap."""
    last = np.searchsorted(stamps_ns, stamps_ns + _SPAN_NS)
    first = np.flatnonzero(last < len(stamps_ns))
    near = stamps_ns[last[first]] - stamps_ns[first] < 1.5 * _SPAN_NS
    return first[near], last[first[near]]


def _between(T: F64, first: I64, last: I64) -> F64:
    return np.asarray(se3.inverse(T[first]) @ T[last], np.float64)
