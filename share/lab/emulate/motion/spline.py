"""A path as a spline: C4 in position and quaternion, so that what an IMU would feel is exact.

The spline is the truth, not an approximation of one. Quintic (piecewise degree 5), through dense knots
of position and of the sign-continuous quaternion, which is normalised after interpolation:

    R = R(s / |s|),   omega = 2 Im(s* s') / |s|^2,   f = R^T (p'' + g e_z)

The derivative of |s| only adds to the real part of s* s', so omega needs no other term.

`tum:FILE` is a path through the poses of a file. A spline is fitted by least squares; the knot spacing
minimises the generalised cross-validation, n RSS / (n - p)^2 (Craven & Wahba, Numer. Math. 31, 1979): fine
where the poses are good, coarse where they are noisy. Gaps are bridged smoothly, so that the IMU stays
plausible; there is no ground truth in them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from share.errors import DataError, UsageError
from share.geometry import se3
from share.lab.emulate.types import GRAVITY, stamps_within
from share.recordings.trajectory import Trajectory, read_tum
from share.types import F64, I64

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
    recorded: ClassVar[None] = None  # its IMU is simulated

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

    def _seconds(self, stamps_ns: I64) -> F64:
        return (stamps_within(stamps_ns, self.start_ns, self.end_ns) - self.start_ns) / 1e9


def spline_through(start_ns: int, seconds: F64, p: F64, q: F64) -> SplinePath:
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


def _with_coefficients(spline: Any, c: F64) -> Any:
    return type(spline)(spline.t, c, spline.k)


# `tum:FILE`, the path through the poses of a file.

_GAP_FACTOR = 4.0  # times the usual step
_MIN_GAP_S = 0.1
_MAX_GAP_S = 5.0
_MIN_DURATION_S, _MIN_POSES = 1.0, 20
_MAX_STEP_S = 0.2  # a longer usual step does not resolve accelerations
_POSES_PER_KNOT = (1.5, 2, 3, 4, 6, 8, 12, 16, 24)  # candidates
_STILL_M, _STILL_RAD = 1e-3, 1e-3


def read_tum_path(path: Path, start: float = 0.0, seconds: float | None = None) -> SplinePath:
    """Return the motion in `path` from `start` s after its beginning, for `seconds`. Raises UsageError for a
    missing file, DataError for poses that are not a body's motion."""
    if not path.is_file():
        raise UsageError(f"{path}: no such file")
    stamps, T = _cut(path, read_tum(path), start, seconds)
    _check_motion(path, stamps, T)
    return fit_spline(stamps, T)


def fit_spline(stamps_ns: I64, T: F64) -> SplinePath:
    """Return the smoothing spline through poses T (N, 4, 4) at rising stamps (N,), with the gaps that are
    found in them."""
    t = (stamps_ns - stamps_ns[0]) / 1e9
    usual_step = float(np.median(np.diff(t)))
    holes = np.flatnonzero(np.diff(t) > max(_GAP_FACTOR * usual_step, _MIN_GAP_S))
    p, q = T[:, :3, 3], continuous_quaternions(se3.quat_from_matrix(T[:, :3, :3]))
    filled = _fill_gaps(t, np.hstack([p, q]), holes, usual_step)
    return SplinePath(
        start_ns=int(stamps_ns[0]),
        end_ns=int(stamps_ns[-1]),
        position=_smoothing_spline(filled[0], filled[1][:, :3]),
        quaternion=_smoothing_spline(filled[0], filled[1][:, 3:]),
        gaps=np.stack([stamps_ns[holes], stamps_ns[holes + 1]], axis=1),
    )


def _smoothing_spline(t: F64, values: F64) -> Any:
    """Return the BSpline of least generalised cross-validation through values (N, D) at t (N,)."""
    from scipy.interpolate import make_lsq_spline

    best, best_score = None, np.inf
    for per_knot in _POSES_PER_KNOT:
        pieces = max(1, int(len(t) / per_knot))
        inner = np.interp(np.linspace(0, len(t) - 1, pieces + 1), np.arange(len(t)), t)[1:-1]
        knots = np.concatenate([np.full(SPLINE_DEGREE + 1, t[0]), inner, np.full(SPLINE_DEGREE + 1, t[-1])])
        unknowns = len(knots) - SPLINE_DEGREE - 1
        if unknowns >= len(t):
            continue
        spline = make_lsq_spline(t, values, knots, k=SPLINE_DEGREE)
        score = len(t) * float(((spline(t) - values) ** 2).sum()) / (len(t) - unknowns) ** 2
        if score < best_score:
            best, best_score = spline, score
    return best


def _fill_gaps(t: F64, values: F64, holes: Any, usual: float) -> tuple[F64, F64]:
    """Fill each gap with a cubic that continues the body's speed at both ends (quaternions component by
    component: they are normalised later). Return times and values."""
    from scipy.interpolate import CubicHermiteSpline

    times, rows = [t], [values]
    for i in holes:
        ends = [slice(max(0, i - 5), i + 1), slice(i + 1, i + 7)]
        slopes = [
            np.polyfit(t[e] - t[e].mean(), values[e], 1)[0] if e.stop - e.start > 1 else 0 * values[0]
            for e in ends
        ]
        cubic = CubicHermiteSpline(t[i : i + 2], values[i : i + 2], np.stack(slopes))
        inside = np.arange(t[i] + usual, t[i + 1] - usual / 2, usual)
        times.append(inside)
        rows.append(cubic(inside))
    order = np.argsort(np.concatenate(times), kind="stable")
    return np.concatenate(times)[order], np.concatenate(rows)[order]


def _cut(path: Path, whole: Trajectory, start: float, seconds: float | None) -> Trajectory:
    stamps, T = whole
    first = int(stamps[0]) + round(start * 1e9)
    last = int(stamps[-1]) if seconds is None else first + round(seconds * 1e9)
    keep = (stamps >= first) & (stamps <= last)
    if not keep.any():
        lasts = (stamps[-1] - stamps[0]) / 1e9
        raise DataError(f"{path}: lasts {lasts:.1f} s, nothing is left from start={start:g}")
    return Trajectory(stamps[keep], T[keep])


def _check_motion(path: Path, stamps: I64, T: F64) -> None:
    lasts = float(stamps[-1] - stamps[0]) / 1e9
    if len(stamps) < _MIN_POSES or lasts < _MIN_DURATION_S:
        raise DataError(
            f"{path}: {len(stamps)} poses in {lasts:.2f} s are too few; "
            f"at least {_MIN_POSES} in {_MIN_DURATION_S:g} s are needed"
        )
    steps = np.diff(stamps) / 1e9
    usual = float(np.median(steps))
    if usual > _MAX_STEP_S:
        raise DataError(
            f"{path}: a pose every {usual:.2f} s says nothing of accelerations; "
            f"give one every {_MAX_STEP_S:g} s or more often"
        )
    worst = int(np.argmax(steps))
    if steps[worst] > _MAX_GAP_S:
        at = (stamps[worst] - stamps[0]) / 1e9
        raise DataError(
            f"{path}: no pose for {steps[worst]:.1f} s, {at:.1f} s after its start; "
            f"gaps up to {_MAX_GAP_S:g} s are bridged, take a part with start= and seconds="
        )
    moved = np.ptp(T[:, :3, 3], axis=0).max()
    if moved < _STILL_M and se3.rotation_angle(se3.inverse(T[:1]) @ T).max() < _STILL_RAD:
        raise DataError(f"{path}: does not move: all poses are the same")
