"""Hand-eye calibration of two rigidly joined bodies: A X = X B.

A are motions of one body, B the same motions of the other, each in its own frame; no common world is needed.
Initial values: rotation, then translation (Park and Martin, *Robot sensor calibration: solving AX = XB on the
Euclidean group*, IEEE TRA 10(5), 1994); then both together. All with Cauchy weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.errors import DataError
from share.geometry import se3
from share.geometry.se3 import best_rotation
from share.types import F64, I64

MIN_ROTATION_RAD = np.radians(5.0)  # rms about the second axis; below, one direction is unobservable
_MIN_MOTIONS = 10
_ITERATIONS = 10
CAUCHY_SIGMAS = 2.5  # scale of Cauchy's weights, robust sigmas


@dataclass(frozen=True, eq=False)
class HandEye:
    """T_a_b (4, 4) with cov (6, 6), perturbed on the right (rotation rad, translation m), for independent
    motions.

    rotation_rms_by_axis (3,): rms rotation, rad, of the motions about their principal axes, largest first.
    rotation_rms rad: weighted residuals.
    """

    T_a_b: F64
    cov: F64
    rotation_rms_by_axis: F64
    rotation_rms: float
    motions: int


def hand_eye(A: F64, B: F64) -> HandEye:
    """Solve for T_a_b from motions A, B (N, 4, 4): T_a(i)_a(j) and T_b(i)_b(j).

    Raises DataError for fewer than 10 motions, and where the bodies turned about one axis only, or not at
    all.
    """
    if A.shape != B.shape or len(A) < _MIN_MOTIONS:
        raise DataError(
            f"hand-eye: {min(len(A), len(B))} motions, at least {_MIN_MOTIONS} are needed; record longer"
        )
    alpha, beta = se3.so3_log(A[:, :3, :3]), se3.so3_log(B[:, :3, :3])
    rotation_rms_by_axis = np.linalg.svd(alpha, compute_uv=False) / np.sqrt(len(alpha))
    if rotation_rms_by_axis[1] < MIN_ROTATION_RAD:
        largest, second, needed = np.degrees([*rotation_rms_by_axis[:2], MIN_ROTATION_RAD])
        raise DataError(
            f"hand-eye: the bodies turned by {largest:.1f} deg rms about one axis and by {second:.1f} deg "
            f"about the next, {needed:.0f} are needed; turn the device about two axes or more: nod, roll, "
            "look around"
        )
    R = _initial_rotation(alpha, beta)
    return _refine(A, B, se3.from_rt(R, _initial_translation(A, B, R)), rotation_rms_by_axis)


def _initial_rotation(alpha: F64, beta: F64) -> F64:
    """Return R (3, 3) that takes beta to alpha, both (N, 3)."""
    weight = np.ones(len(alpha))
    for _ in range(_ITERATIONS):
        R = best_rotation((alpha * weight[:, None]).T @ beta)
        weight = _cauchy_weights(np.linalg.norm(alpha - beta @ R.T, axis=1))
    return R


def _initial_translation(A: F64, B: F64, R: F64) -> F64:
    """Return t (3,) with (R_A - I) t = R t_B - t_A."""
    J, y = A[:, :3, :3] - np.eye(3), B[:, :3, 3] @ R.T - A[:, :3, 3]
    weight = np.ones(len(A))
    for _ in range(_ITERATIONS):
        JW = J * weight[:, None, None]
        t = np.linalg.solve(np.einsum("nij,nik->jk", JW, J), np.einsum("nij,ni->j", JW, y))
        weight = _cauchy_weights(np.linalg.norm(J @ t - y, axis=1))
    return np.asarray(t, np.float64)


def _cauchy_weights(size: F64) -> F64:
    """Return Cauchy weights (N,) of residual norms, scaled by their median."""
    scale = max(float(np.median(size)), 1e-12)
    return np.asarray(1 / (1 + (size / (CAUCHY_SIGMAS * scale)) ** 2), np.float64)


def _refine(A: F64, B: F64, X: F64, rotation_rms_by_axis: F64) -> HandEye:
    """Refine rotation and translation together by Gauss-Newton from X, each weighted by its residuals."""
    J = motion_jacobian(B)
    for _ in range(_ITERATIONS):
        step, cov, rms = robust_step(motion_residuals(A, B, X), J)
        X = X @ se3.exp(step)
    return HandEye(X, cov, rotation_rms_by_axis, rms[0], len(A))


def motion_residuals(A: F64, B: F64, X: F64) -> F64:
    """Return Log(B^-1 X^-1 A X) (N, 6): rotation rad, translation m."""
    return se3.log(se3.inverse(B) @ se3.inverse(X) @ A @ X)


def motion_jacobian(B: F64) -> F64:
    """Return the derivative (N, 6, 6) of `motion_residuals` by xi of X Exp(xi): xi - Ad(B^-1) xi."""
    return np.asarray(np.eye(6) - se3.adjoint(se3.inverse(B)), np.float64)


def robust_step(residuals: F64, J: F64) -> tuple[F64, F64, tuple[float, float]]:
    """Return the Gauss-Newton step (P,) of residuals (N, 6) with derivatives J (N, 6, P), its covariance
    (P, P) for independent motions, and the weighted rms of rotation, rad, and translation, m.

    Rotation and translation are weighted by their rms, motions by Cauchy. Raises np.linalg.LinAlgError where
    the motions do not determine all.
    """
    weight, rms = np.ones(len(residuals)), (0.0, 0.0)
    for _ in range(2):  # the rms without the outliers that it finds
        rotation, translation = (
            float(np.sqrt(np.average((part**2).sum(1), weights=weight)))
            for part in np.split(residuals, 2, axis=1)
        )
        rms = rotation, translation
        sigma = np.repeat(np.maximum(rms, 1e-12), 3) / np.sqrt(3)
        weight = _cauchy_weights(np.linalg.norm(residuals / sigma, axis=1))
    JW = J / sigma[:, None] ** 2 * weight[:, None, None]
    cov = np.linalg.inv(np.einsum("nij,nik->jk", JW, J))
    return -cov @ np.einsum("nij,ni->j", JW, residuals), cov, rms


# Check of a mounting from another source by hand-eye.

_MOTION_NS = 1_000_000_000  # duration of a motion: long enough to turn, short enough not to drift
_MAX_SIGMAS = 4.0  # of the difference


@dataclass(frozen=True, eq=False)
class HandEyeCheck:
    """Difference of a mounting from the hand-eye estimate, rad and m; sigmas: in standard errors of
    hand-eye (Mahalanobis distance over the square root of six)."""

    hand_eye: HandEye
    rotation_error_rad: float
    translation_error_m: float
    sigmas: float

    @property
    def agrees(self) -> bool:
        return self.sigmas < _MAX_SIGMAS


def check_mounting(T_a_b: F64, stamps_ns: I64, T_a: F64, T_b: F64) -> HandEyeCheck:
    """Check T_a_b (4, 4) by paths T_a, T_b (N, 4, 4) of both bodies at stamps (N,), each in its own world.

    Raises DataError where the paths are too short, or turn about one axis only.
    """
    first, last = motion_ends(stamps_ns)
    if not len(first):
        raise DataError("hand-eye: the two paths overlap by less than a second; are they of one recording?")
    estimate = hand_eye(relative_motions(T_a, first, last), relative_motions(T_b, first, last))
    error = se3.log(se3.inverse(estimate.T_a_b) @ T_a_b)
    sigmas = np.sqrt(error @ np.linalg.solve(estimate.cov * overlap_factor(stamps_ns), error) / len(error))
    rotation_error, translation_error = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
    return HandEyeCheck(estimate, float(rotation_error), float(translation_error), float(sigmas))


def overlap_factor(stamps_ns: I64) -> float:
    """Return how many motions of `motion_ends` overlap: they are not independent."""
    return max(1.0, _MOTION_NS / float(np.median(np.diff(stamps_ns))))


def motion_ends(stamps_ns: I64) -> tuple[I64, I64]:
    """Return the indices (M,) where motions of about a second begin and end; none spans a gap."""
    last = np.searchsorted(stamps_ns, stamps_ns + _MOTION_NS)
    first = np.flatnonzero(last < len(stamps_ns))
    near = stamps_ns[last[first]] - stamps_ns[first] < 1.5 * _MOTION_NS
    return first[near], last[first[near]]


def relative_motions(T: F64, first: I64, last: I64) -> F64:
    """Return T[first]^-1 T[last]."""
    return np.asarray(se3.inverse(T[first]) @ T[last], np.float64)
