"""A path as a spline: C4 in position and quaternion, so that what an IMU would feel is exact.

The spline is the truth, not an approximation of one. Quintic (piecewise degree 5), through dense knots
of position and of the sign-continuous quaternion, which is normalised after interpolation:

    R = R(s / |s|),   omega = 2 Im(s* s') / |s|^2,   f = R^T (p'' + g e_z)

The derivative of |s| only adds to the real part of s* s', so omega needs no other term.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from share.geometry import se3
from share.lab.emulate.types import GRAVITY
from share.types import F64, I64, ImuBatch

SPLINE_DEGREE = 5
_NO_GAPS = np.zeros((0, 2), np.int64)


@dataclass(frozen=True, eq=False)
class SplinePath:
    """A `MotionPath`. position and quaternion (xyzw): scipy BSplines of seconds since start_ns, with values
    (N, 3) m in the world and (N, 4) of any length."""

    start_ns: int
    end_ns: int
    position: Any
    quaternion: Any
    gaps: I64 = field(default_factory=lambda: _NO_GAPS)
    recorded: ImuBatch | None = None

    def poses(self, stamps_ns: I64) -> F64:
        """Return T_world_body (N, 4, 4). Raises ValueError outside the span."""
        t = self._seconds(stamps_ns)
        return se3.from_quat(self.position(t), self.quaternion(t))

    def inertial(self, stamps_ns: I64) -> tuple[F64, F64]:
        """Return angular rate (N, 3) rad/s and specific force (N, 3) m/s^2 in the body frame."""
        t = self._seconds(stamps_ns)
        s, ds = self.quaternion(t), self.quaternion(t, 1)
        force = self.position(t, 2) + np.array([0.0, 0.0, GRAVITY])
        R = se3.matrix_from_quat(s)
        return body_rates(s, ds), np.einsum("nji,nj->ni", R, force)

    def velocity(self, stamps_ns: I64) -> F64:
        """Return the body's velocity in the world (N, 3) m/s."""
        v: F64 = self.position(self._seconds(stamps_ns), 1)
        return v

    def transformed(self, T_world_old: F64) -> SplinePath:
        """Return the same motion turned about the vertical and shifted by T_world_old (4, 4). Exact: both act
        on the coefficients alone. Raises ValueError if it would tilt gravity."""
        R, shift = T_world_old[:3, :3], T_world_old[:3, 3]
        if not np.allclose(R[2], (0, 0, 1), atol=1e-9):
            raise ValueError("T_world_old: turns about more than the vertical")
        turn = se3.quat_from_matrix(R)
        return replace(
            self,
            position=_with_coefficients(self.position, self.position.c @ R.T + shift),
            quaternion=_with_coefficients(self.quaternion, quaternion_product(turn, self.quaternion.c)),
        )

    def with_axes(self, R_body_new: F64) -> SplinePath:
        """Return the motion of a body at the same place with axes turned by R_body_new (3, 3). Exact."""
        turn = se3.quat_from_matrix(R_body_new)
        return replace(
            self, quaternion=_with_coefficients(self.quaternion, quaternion_product(self.quaternion.c, turn))
        )

    def cut(self, start_ns: int, end_ns: int) -> SplinePath:
        """Return the motion between two stamps of the same clock. Raises ValueError outside the span."""
        if not self.start_ns <= start_ns < end_ns <= self.end_ns:
            raise ValueError(f"{start_ns} .. {end_ns} ns: is not within {self.start_ns} .. {self.end_ns} ns")
        shift = (start_ns - self.start_ns) / 1e9
        moved = [_with_coefficients(s, s.c, s.t - shift) for s in (self.position, self.quaternion)]
        keep = (self.gaps[:, 1] > start_ns) & (self.gaps[:, 0] < end_ns)
        return replace(
            self,
            start_ns=start_ns,
            end_ns=end_ns,
            position=moved[0],
            quaternion=moved[1],
            gaps=self.gaps[keep].clip(start_ns, end_ns),
            recorded=_samples_between(self.recorded, start_ns, end_ns),
        )

    def _seconds(self, stamps_ns: I64) -> F64:
        stamps = np.asarray(stamps_ns, np.int64)
        if len(stamps) and not self.start_ns <= stamps.min() <= stamps.max() <= self.end_ns:
            raise ValueError(
                f"stamps {stamps.min()} .. {stamps.max()} ns: "
                f"the path spans {self.start_ns} .. {self.end_ns} ns"
            )
        return (stamps - self.start_ns) / 1e9


def spline_through(
    start_ns: int, seconds: F64, p: F64, q: F64, gaps: ArrayLike = (), recorded: ImuBatch | None = None
) -> SplinePath:
    """Return the spline through positions p (N, 3) m and quaternions q (N, 4) xyzw, of any signs, at
    `seconds` (N,), rising from 0. Raises ValueError for fewer than 6 knots."""
    from scipy.interpolate import make_interp_spline

    if len(seconds) <= SPLINE_DEGREE:
        raise ValueError(f"seconds: {len(seconds)} knots, at least {SPLINE_DEGREE + 1} are needed")
    return SplinePath(
        start_ns=start_ns,
        end_ns=start_ns + int(np.floor(seconds[-1] * 1e9)),
        position=make_interp_spline(seconds, p, k=SPLINE_DEGREE),
        quaternion=make_interp_spline(seconds, continuous_quaternions(q), k=SPLINE_DEGREE),
        gaps=np.asarray(gaps, np.int64).reshape(-1, 2),
        recorded=recorded,
    )


def continuous_quaternions(q: F64) -> F64:
    """Return unit quaternions (N, 4) with signs such that neighbours are near each other."""
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    flips = np.where(np.einsum("ni,ni->n", q[1:], q[:-1]) < 0, -1.0, 1.0)
    out: F64 = q * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
    return out


def body_rates(s: F64, ds: F64) -> F64:
    """Return the angular rate (N, 3) rad/s in the body frame, for quaternions s (N, 4) of any length and
    their derivatives."""
    conjugate = s * (-1.0, -1.0, -1.0, 1.0)
    out: F64 = 2 * quaternion_product(conjugate, ds)[..., :3] / np.sum(s * s, axis=-1, keepdims=True)
    return out


def quaternion_product(a: F64, b: F64) -> F64:
    """Return the Hamilton product of quaternions (..., 4) xyzw."""
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = aw * bv + bw * av + np.cross(av, bv)
    return np.concatenate([vector, aw * bw - np.sum(av * bv, axis=-1, keepdims=True)], axis=-1)


def _with_coefficients(spline: Any, c: F64, t: F64 | None = None) -> Any:
    return type(spline)(spline.t if t is None else t, c, spline.k)


def _samples_between(imu: ImuBatch | None, start_ns: int, end_ns: int) -> ImuBatch | None:
    if imu is None:
        return None
    keep = (imu.stamps_ns >= start_ns) & (imu.stamps_ns <= end_ns)
    return imu.take(keep)
