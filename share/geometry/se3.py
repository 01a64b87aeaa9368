"""SO(3) and SE(3) as plain matrices, vectorised over leading axes.

Tangent vectors are xi = (phi, rho): rotation [rad] first, then translation [m]. Perturbations are
on the right: T = T_mean Exp(xi), so a covariance lives in the frame on the right (the body of
`T_odom_body`). Source: Barfoot, *State Estimation for Robotics* (2017), ch. 7; Sola et al., *A
micro Lie theory* (2018).
"""

from __future__ import annotations

import numpy as np

from share.types import F64

_EYE: F64 = np.eye(3)
_SMALL = 1e-6  # rad; below, Taylor series replace sin(x)/x and the like


def hat(v: F64) -> F64:
    """Cross-product matrix: (..., 3) -> (..., 3, 3) with hat(v) w = v x w."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    out[..., 0, 1], out[..., 0, 2] = -z, y
    out[..., 1, 0], out[..., 1, 2] = z, -x
    out[..., 2, 0], out[..., 2, 1] = -y, x
    return out


def _coefficients(phi: F64) -> tuple[F64, F64, F64]:
    """sin(a)/a, (1 - cos a)/a^2, (a - sin a)/a^3 for a = |phi|, each (..., 1, 1)."""
    a = np.sqrt((phi * phi).sum(axis=-1))[..., None, None]
    small = a < _SMALL
    if not small.any():
        sine = np.sin(a)
        return sine / a, (1 - np.cos(a)) / a**2, (a - sine) / a**3
    s = np.where(small, 1.0, a)
    return (
        np.where(small, 1 - a**2 / 6, np.sin(s) / s),
        np.where(small, 0.5 - a**2 / 24, (1 - np.cos(s)) / s**2),
        np.where(small, 1 / 6 - a**2 / 120, (s - np.sin(s)) / s**3),
    )


def so3_exp(phi: F64) -> F64:
    """Rodrigues' formula: (..., 3) rad -> (..., 3, 3)."""
    A, B, _ = _coefficients(phi)
    K = hat(phi)
    return _EYE + A * K + B * (K @ K)


def so3_log(R: F64) -> F64:
    """Inverse of `so3_exp`, angle in [0, pi]: (..., 3, 3) -> (..., 3). By the quaternion, so that it is
    accurate near pi."""
    q = quat_from_matrix(R)
    q = np.where(q[..., 3:] < 0, -q, q)
    n = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    scale = np.where(n < 1e-9, 2.0, 2 * np.arctan2(n, q[..., 3:]) / np.maximum(n, 1e-300))
    return scale * q[..., :3]


def so3_right_jacobian(phi: F64) -> F64:
    """Jr with Exp(phi + d) = Exp(phi) Exp(Jr d) to first order: (..., 3) -> (..., 3, 3)."""
    _, B, C = _coefficients(phi)
    K = hat(phi)
    return _EYE - B * K + C * (K @ K)


def quat_from_matrix(R: F64) -> F64:
    """Unit quaternions (..., 4), order x y z w, of rotations (..., 3, 3).

    The eigenvector form of Bar-Itzhack (2000): no branch on the trace, well-conditioned everywhere.
    """
    m = R
    K = np.empty((*R.shape[:-2], 4, 4))
    K[..., 0, 0] = m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2]
    K[..., 1, 1] = m[..., 1, 1] - m[..., 0, 0] - m[..., 2, 2]
    K[..., 2, 2] = m[..., 2, 2] - m[..., 0, 0] - m[..., 1, 1]
    K[..., 3, 3] = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    K[..., 0, 1] = K[..., 1, 0] = m[..., 0, 1] + m[..., 1, 0]
    K[..., 0, 2] = K[..., 2, 0] = m[..., 0, 2] + m[..., 2, 0]
    K[..., 1, 2] = K[..., 2, 1] = m[..., 1, 2] + m[..., 2, 1]
    K[..., 0, 3] = K[..., 3, 0] = m[..., 2, 1] - m[..., 1, 2]
    K[..., 1, 3] = K[..., 3, 1] = m[..., 0, 2] - m[..., 2, 0]
    K[..., 2, 3] = K[..., 3, 2] = m[..., 1, 0] - m[..., 0, 1]
    q: F64 = np.linalg.eigh(K)[1][..., :, -1]
    return np.where(q[..., 3:] < 0, -q, q)


def matrix_from_quat(q: F64) -> F64:
    """Rotations (..., 3, 3) of quaternions (..., 4), x y z w, which need not be normalised."""
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    K = hat(q[..., :3])
    return _EYE + 2 * (q[..., 3, None, None] * K + K @ K)


def from_rt(R: F64, t: F64) -> F64:
    """(..., 3, 3) and (..., 3) -> (..., 4, 4)."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def from_quat(t: F64, q: F64) -> F64:
    """Positions (..., 3) and quaternions (..., 4, xyzw) -> (..., 4, 4)."""
    return from_rt(matrix_from_quat(q), t)


def inverse(T: F64) -> F64:
    """T_b_a of T_a_b: (..., 4, 4)."""
    Rt = T[..., :3, :3].swapaxes(-1, -2)
    return from_rt(Rt, -(Rt @ T[..., :3, 3, None])[..., 0])


def exp(xi: F64) -> F64:
    """(..., 6) -> (..., 4, 4)."""
    phi, rho = xi[..., :3], xi[..., 3:]
    A, B, C = _coefficients(phi)
    K = hat(phi)
    KK = K @ K
    V = _EYE + B * K + C * KK
    return from_rt(_EYE + A * K + B * KK, (V @ rho[..., None])[..., 0])


def log(T: F64) -> F64:
    """(..., 4, 4) -> (..., 6)."""
    phi = so3_log(T[..., :3, :3])
    _, B, C = _coefficients(phi)
    K = hat(phi)
    V = _EYE + B * K + C * (K @ K)
    rho = np.linalg.solve(V, T[..., :3, 3, None])[..., 0]
    return np.concatenate([phi, rho], axis=-1)


def adjoint(T: F64) -> F64:
    """Ad with T Exp(xi) = Exp(Ad xi) T: (..., 4, 4) -> (..., 6, 6)."""
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = hat(T[..., :3, 3]) @ R
    return out


def compose_cov(T_b_c: F64, cov_a_b: F64, cov_b_c: F64) -> F64:
    """Covariance of T_a_b T_b_c with independent errors (Barfoot eq. 7.286, right form)."""
    Ad = adjoint(inverse(T_b_c))
    return Ad @ cov_a_b @ np.swapaxes(Ad, -1, -2) + cov_b_c


def inverse_cov(T_a_b: F64, cov: F64) -> F64:
    """Covariance of T_b_a given that of T_a_b."""
    Ad = adjoint(T_a_b)
    return Ad @ cov @ np.swapaxes(Ad, -1, -2)


def position_sigma(cov: F64) -> float:
    """Return the position sigma, m: the root of the trace of the translation block of cov (6, 6).

    Negative rounding errors give 0; NaN gives NaN.
    """
    return float(np.sqrt(np.maximum(cov[3:, 3:].trace(), 0.0)))


def rotation_sigma(cov: F64) -> float:
    """Return the rotation sigma, rad: as `position_sigma`, of the rotation block."""
    return float(np.sqrt(np.maximum(cov[:3, :3].trace(), 0.0)))


def transform(T: F64, points: F64) -> F64:
    """Points (..., 3) in frame b -> frame a by T_a_b (4, 4)."""
    return points @ T[:3, :3].T + T[:3, 3]


def rotation_angle(R: F64) -> F64:
    """Rotation angle [rad], 0 .. pi, of (..., 3, 3) or (..., 4, 4), by R - R' and the trace."""
    skew = R[..., [2, 0, 1], [1, 2, 0]] - R[..., [1, 2, 0], [2, 0, 1]]
    cosine2 = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1
    out: F64 = np.arctan2(np.sqrt((skew**2).sum(-1)), cosine2)
    return out


def pairwise_distances(T: F64, others: F64) -> tuple[F64, F64]:
    """Return the distances of poses (N, 4, 4) from others (M, 4, 4), m and rad, (N, M) each.

    Fast for many poses. Values below some 1e-8 of the distance from the origin, or 1e-8 rad, are rounding
    errors.
    """
    p, q = T[:, :3, 3], others[:, :3, 3]
    square = (p**2).sum(axis=1)[:, None] + (q**2).sum(axis=1) - 2 * p @ q.T
    cosine2 = T[:, :3, :3].reshape(-1, 9) @ others[:, :3, :3].reshape(-1, 9).T - 1
    return np.sqrt(np.maximum(square, 0.0)), np.arccos(np.clip(cosine2 / 2, -1, 1))


def orthonormal(T: F64) -> F64:
    """The rigid transform nearest to T (..., 4, 4): removes drift of repeated products."""
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    return from_rt(U @ Vt, T[..., :3, 3])


def umeyama(source: F64, target: F64) -> F64:
    """T (4, 4) that minimises sum |target - T source|^2 over rigid transforms (no scale).

    source, target: (N, 3) m, N >= 1 (rotation is determined from three points not on a line).
    Source: Umeyama, PAMI 13(4), 1991, eq. 40-43 with c = 1.
    """
    if source.shape != target.shape or len(source) == 0:
        raise ValueError(f"umeyama: shapes {source.shape} and {target.shape} must agree and not be empty")
    ms, mt = source.mean(0), target.mean(0)
    R = best_rotation((target - mt).T @ (source - ms))
    return from_rt(R, mt - R @ ms)


def best_rotation(M: F64) -> F64:
    """Return the rotation R (3, 3) that maximises trace(R' M); for M = sum target source', the best
    alignment.

    Source: Umeyama, eq. 40 and 43.
    """
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt)


def point_jacobian(D: F64, q: F64, rho: F64) -> F64:
    """Return D [-hat(q) | rho I] (N, K, 6): the derivative of q (N, 3) by xi of Exp(xi), times D (N, K, 3) or
    (K, 3)."""
    out = np.empty((len(q), D.shape[-2], 6))
    x, y, z = q[:, 0, None], q[:, 1, None], q[:, 2, None]
    a, b, c = D[..., 0], D[..., 1], D[..., 2]
    out[:, :, 0], out[:, :, 1], out[:, :, 2] = y * c - z * b, z * a - x * c, x * b - y * a
    np.multiply(D, rho[:, None, None], out=out[:, :, 3:])
    return out
