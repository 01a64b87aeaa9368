"""The filter's steps: propagate, update, and states that come and go. Each changes the state in place.

Source: the EKF with right-invariant errors, see `state`; cloning of poses with an unknown time offset: Li &
Mourikis (2014).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from share.columns import Columns
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.odometry.imu_propagation import integrate
from share.odometry.measurement import Prediction
from share.odometry.state import ACCEL_BIAS, CORE, EXTRINSIC, GYRO_BIAS, OFFSET, POSE, VELOCITY, State
from share.types import F64, I64, ImuBatch

KNOWN = slice(EXTRINSIC.start, CORE)  # what rows see of the core beside poses
_UNSURE = np.array([0, 1, 6, 7, 8])  # tilt and velocity,
_LOOSE = np.array([3e-4, 3e-4, 1e-2, 1e-2, 1e-2])  # rad^2, (m/s)^2: where single precision is too little
_MOVING = 15  # columns that propagation changes
_LEAST_COV = 1e-10  # what differences of covariances lose
AS_ONE = 16.0  # sights of an error that lasts; chosen by NEES
Gain = NDArray[np.floating[Any]]  # in double or in single precision
Float = TypeVar("Float", bound=np.floating[Any])
_SETTLED = 1e-4  # rad, m, 1/m: a correction that changes no derivative


@dataclass(frozen=True, eq=False)
class Sight(Columns):
    """Rows of an update: residual (M, 2) measured - predicted, and how it depends on the state: core
    (M, 2, 22), the pose (M, 2, 6) of keyframe number host (M,), inverse depth (M, 2) of feature number
    which (M,). Of one coordinate, as the residual: sigma (M,), anew in every image; lasting (M,), the same
    in both cameras' and much the same in the next ones."""

    which: I64
    host: I64
    residual: F64
    core: F64
    by_host: F64
    by_rho: F64
    sigma: F64
    lasting: F64


def propagate(state: State, imu: ImuBatch, to_ns: int, noise: ImuNoise, gravity: float) -> F64:
    """To `to_ns`, IMU time. The body's rate (3,) rad/s then, free of bias. Raises ValueError without
    samples."""
    motion = integrate(state.T, state.v, state.bg, state.ba, imu, state.stamp_ns, to_ns, noise, gravity)
    F, P = motion.transition, state.cov
    own = F @ P[:_MOVING, :_MOVING] @ F.T + motion.noise
    P[:_MOVING, :_MOVING] = (own + own.T) / 2
    P[:_MOVING, _MOVING:] = F @ P[:_MOVING, _MOVING:]
    P[_MOVING:, :_MOVING] = P[:_MOVING, _MOVING:].T
    state.T, state.v, state.stamp_ns = motion.T, motion.v, to_ns
    return motion.rate


def twist(state: State, rate: F64) -> F64:
    """How the body's pose moves with time, (6,): T(t + dt) = Exp(twist dt) T(t). rate (3,): rad/s, body."""
    turning = state.T[:3, :3] @ rate
    (a, b, c), (x, y, z) = turning.tolist(), state.T[:3, 3].tolist()
    return np.concatenate([turning, state.v - (b * z - c * y, c * x - a * z, a * y - b * x)])


def sight(state: State, which: I64, seen: Prediction, uv: F64, sigma: F64, lasting: F64, rate: F64) -> Sight:
    """What was seen at uv (M, 2), sigma and lasting (M,), of features number `which` (M,), where `seen` was
    predicted."""
    core = np.zeros((len(which), 2, CORE))
    core[:, :, POSE], core[:, :, EXTRINSIC] = seen.by_pose, seen.by_extrinsic
    core[:, :, OFFSET] = seen.by_pose @ twist(state, rate)
    return Sight(which, state.host[which], uv - seen.uv, core, -seen.by_pose, seen.by_rho, sigma, lasting)


def gains(state: State, rows: Sight, common: F64 | None = None, exactly: bool = False) -> tuple[Gain, Gain]:
    """H cov (2 M, n) and H cov H' + R (2 M, 2 M) of rows sorted by host. H is not formed: a row has 29
    entries. common (6, 6): covariance of an error that all rows share, as one of the pose, on its right.

    Rows know of a keyframe's pose only less the body's. With that difference taken first, what both are
    unsure of together is gone, and single precision is enough; but where all is vague, or `exactly`.
    """
    M, n = len(rows.which), state.size
    kind: type[np.floating[Any]] = np.float64 if exactly or _is_vague(state) else np.float32
    P = _less_body(state).astype(kind, copy=False)
    known = rows.core[:, :, KNOWN].reshape(2 * M, -1).astype(kind, copy=False)
    by_host, by_rho = rows.by_host.astype(kind, copy=False), rows.by_rho.astype(kind, copy=False)
    by_host, feature = by_host.reshape(2 * M, 6), state.features_at + rows.which
    groups = [
        (state.keyframe(h), slice(2 * a, 2 * b))
        for h, a, b in zip(*(part.tolist() for part in _runs(rows.host)), strict=True)
    ]
    HP = known @ P[KNOWN]
    HP.reshape(M, 2, n)[:] += by_rho[:, :, None] * P.take(feature, axis=0)[:, None, :]
    for columns, part in groups:
        HP[part] += by_host[part] @ P[columns]
    S = known @ HP[:, KNOWN].T
    S.reshape(M, 2, 2 * M)[:] += by_rho[:, :, None] * HP.T.take(feature, axis=0)[:, None, :]
    for columns, part in groups:
        S[part] += by_host[part] @ HP[:, columns].T
    S.reshape(-1)[:: 2 * M + 1] += np.repeat(rows.sigma**2 + AS_ONE * rows.lasting**2, 2).astype(kind)
    left, right = _pairs(rows.which)
    for axis in (0, 1):
        both = 2 * left + axis, 2 * right + axis
        S[both] += (AS_ONE * rows.lasting[left] * rows.lasting[right]).astype(kind)
        S[both[::-1]] = S[both]
    if common is not None:
        B = by_host @ se3.adjoint(state.T).astype(kind)
        S += B @ common.astype(kind) @ B.T
    poses = HP[:, CORE : state.features_at].reshape(2 * M, -1, 6)
    poses += HP[:, None, POSE]
    return HP, S


def _is_vague(state: State) -> bool:
    """Whether so much of what is unknown may go at once that single precision is too little."""
    return bool((state.cov.diagonal()[_UNSURE] > _LOOSE).any())


def _less_body(state: State) -> F64:
    """cov with the errors of keyframes' poses less that of the body's in their place."""
    P, n = state.cov.copy(), state.size
    poses = slice(CORE, state.features_at)
    rows = P[poses].reshape(-1, 6, n)
    rows -= P[POSE]
    columns = P[:, poses].reshape(n, -1, 6)
    columns -= P[:, None, POSE]
    return P


def _pairs(which: I64) -> tuple[I64, I64]:
    """Numbers (K,) of rows that both cameras have of a feature."""
    order = np.argsort(which, kind="stable")
    twice = np.flatnonzero(which[order[1:]] == which[order[:-1]])
    return order[twice], order[twice + 1]


def _runs(host: I64) -> tuple[I64, I64, I64]:
    """Value, first and last + 1 of each run of equal ones."""
    first = np.flatnonzero(np.r_[True, host[1:] != host[:-1]]) if len(host) else np.zeros(0, np.int64)
    return host[first], first, np.r_[first[1:], len(host)]


def surprise(rows: Sight, S: Gain) -> F64:
    """Squared Mahalanobis distance (M,) of each residual on its own, 2 degrees of freedom; inf where nothing
    was predicted."""
    M = len(rows.which)
    a, b = 2 * np.arange(M), 2 * np.arange(M) + 1
    x, y = rows.residual.T
    less = (AS_ONE - 1) * rows.lasting**2  # it is no larger for lasting
    sxx, sxy, syy = S[a, a] - less, S[a, b], S[b, b] - less
    d = (syy * x * x - 2 * sxy * x * y + sxx * y * y) / (sxx * syy - sxy * sxy)
    out: F64 = np.where(np.isfinite(d), d, np.inf)
    return out


def relinearised(
    state: State, rows_at: Callable[[], Sight], common: F64 | None = None, rounds: int = 4
) -> Sight:
    """Rows whose derivatives are those at the state that they lead to: an iterated EKF (Bell & Cathey 1993).

    rows_at: makes them from `state`, whose means are as before when this returns. For where the first
    prediction is far off; the rows' residuals are what `gains` and `update` want.
    """
    before, error = state.means(), np.zeros(state.size)
    for _ in range(rounds):
        rows = rows_at()
        rows.residual[:] += times(state, rows, error)
        step = _gain(*gains(state, rows, common, exactly=True), rows.residual.ravel())[0] - error
        error += step
        state.restore(before)
        move(state, error)
        if np.abs(step).max() < _SETTLED:
            break
    rows = rows_at()
    rows.residual[:] += times(state, rows, error)
    state.restore(before)
    return rows


def times(state: State, rows: Sight, error: F64) -> F64:
    """H error (M, 2)."""
    poses = error[CORE : state.features_at].reshape(-1, 6)[rows.host]
    by_rho = rows.by_rho * error[state.features_at + rows.which, None]
    out: F64 = rows.core @ error[:CORE] + (rows.by_host @ poses[:, :, None])[:, :, 0] + by_rho
    return out


def update(state: State, rows: Sight, HP: Gain, S: Gain) -> float:
    """Apply rows with their `gains`. The squared Mahalanobis distance of all of them together.

    Raises numpy.linalg.LinAlgError where S is not positive definite."""
    return apply(state, rows.residual.ravel(), HP, S)


def apply(state: State, residual: F64, HP: Gain, S: Gain) -> float:
    """residual (m,), H cov (m, n), its covariance S (m, m)."""
    error, W, white = _gain(HP, S, residual)
    state.cov -= W.T @ W  # numpy makes this one symmetric to the last bit
    move(state, error)
    return float(white @ white)


def learn(state: State, residual: F64, H: F64, sigma: float, gate: float = np.inf) -> bool:
    """Apply a few rows H (m, n) of any kind, sigma of each. Whether they were believed: where they contradict
    the state by more than `gate`, a squared Mahalanobis distance, nothing is done."""
    HP = H @ state.cov
    S = HP @ H.T + sigma**2 * np.eye(len(H))
    if residual @ np.linalg.solve(S, residual) > gate:
        return False
    apply(state, residual, HP, S)
    return True


def rest(state: State, sigma: float, gate: float) -> bool:
    """The body stands still: its velocity is 0, sigma m/s. Whether that was believed, see `learn`."""
    H = np.zeros((3, state.size))
    H[:, POSE][:, :3], H[:, VELOCITY] = -se3.hat(state.v), np.eye(3)
    return learn(state, -state.v, H, sigma, gate)


def doubt(state: State, turn: float, shift: float, speed: float) -> None:
    """Nobody knows why, but pose and velocity may be off by so much, rad, m, m/s."""
    Ad = se3.adjoint(state.T)
    state.cov[POSE, POSE] += Ad @ np.diag(np.repeat([turn**2, shift**2], 3)) @ Ad.T
    state.cov[VELOCITY, VELOCITY] += speed**2 * np.eye(3)


def _gain(HP: Gain, S: Gain, residual: F64) -> tuple[F64, Gain, Gain]:
    """The error (n,) that the residual tells of, L^-1 H cov (m, n), L^-1 residual (m,) with L L' = S; in
    the precision that HP and S have."""
    short = HP.dtype == np.float32
    factor, solve = (lapack.spotrf, blas.strsm) if short else (lapack.dpotrf, blas.dtrsm)
    L, failed = factor(S, lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError("innovation covariance is not positive definite")
    white: Gain = solve(1.0, L, residual[:, None].astype(HP.dtype), lower=1)[:, 0]
    W: Gain = solve(1.0, L, HP.T, side=1, lower=1, trans_a=1).T  # as Fortran has it: no copy
    return (W.T @ white).astype(np.float64), W, white


def move(state: State, error: F64) -> None:
    """Means by an error (n,)."""
    poses = error[CORE : state.features_at].reshape(-1, 6)
    by = se3.exp(np.concatenate([error[POSE][None], error[EXTRINSIC][None], poses]))
    turn = by[0, :3, :3]
    state.v = turn @ state.v + error[VELOCITY]
    state.T = by[0] @ state.T
    state.poses = by[2:] @ state.poses
    state.bg, state.ba = state.bg + error[GYRO_BIAS], state.ba + error[ACCEL_BIAS]
    state.T_body_cam = state.T_body_cam @ by[1]
    state.offset_s += float(error[OFFSET])
    state.rho = state.rho + error[state.features_at :]


def add_keyframe(state: State, keyframe: int, rate: F64) -> int:
    """The body's pose as it is when the image is taken: how far it has come by then depends on the time
    offset. Its number."""
    n, at = state.size, state.features_at
    copy = np.zeros((6, n))
    copy[:, POSE] = np.eye(6)
    copy[:, OFFSET] = twist(state, rate)
    rows = copy @ state.cov
    grown = _widened(state.cov, at, 6)
    for old, now in ((slice(0, at), slice(0, at)), (slice(at, n), slice(at + 6, n + 6))):
        grown[at : at + 6, now], grown[now, at : at + 6] = rows[:, old], rows[:, old].T
    grown[at : at + 6, at : at + 6] = rows @ copy.T
    state.cov = grown
    state.keyframes = np.append(state.keyframes, keyframe)
    state.poses = np.concatenate([state.poses, state.T[None]])
    return len(state.keyframes) - 1


def add_features(
    state: State,
    ids: I64,
    host: I64,
    ray: F64,
    rho: F64,
    sigma: F64,
    like: F64 | None = None,
    common: F64 | None = None,
) -> None:
    """Features (N,) that keyframes number `host` (N,) see on rays (N, 2), inverse depths rho, sigma (N,) of
    what each is off by itself. like (N, M): how the errors of the M inverse depths there are come in; common
    (N,): sigma of an error that the new ones share."""
    n, more = state.size, len(ids)
    grown = _widened(state.cov, n, more)
    new = slice(n, n + more)
    if like is not None and like.shape[1]:
        rows = like @ state.cov[state.features_at :]
        grown[new, :n], grown[:n, new] = rows, rows.T
        grown[new, new] = rows[:, state.features_at :] @ like.T
    own = np.arange(n, n + more)
    grown[own, own] += sigma**2
    if common is not None and common.any():
        grown[new, new] += np.outer(common, common)
    state.cov = grown
    state.ids = np.concatenate([state.ids, ids])
    state.host = np.concatenate([state.host, host])
    state.ray = np.concatenate([state.ray, ray])
    state.rho = np.concatenate([state.rho, rho])


def keep_features(state: State, keep: NDArray[np.bool_]) -> None:
    """The others are forgotten; what they taught of the rest stays."""
    if keep.all():
        return
    _keep_columns(state, np.concatenate([np.ones(state.features_at, bool), keep]))
    state.ids, state.host = state.ids[keep], state.host[keep]
    state.ray, state.rho = state.ray[keep], state.rho[keep]


def drop_keyframes(state: State, keyframes: I64) -> None:
    """These ids, with the features that they host."""
    leave = np.isin(state.keyframes, keyframes)
    if not leave.any():
        return
    keep = ~leave[state.host]
    _keep_columns(state, np.concatenate([np.ones(CORE, bool), np.repeat(~leave, 6), keep]))
    state.ids, state.ray, state.rho = state.ids[keep], state.ray[keep], state.rho[keep]
    state.host = (np.cumsum(~leave) - 1)[state.host[keep]]
    state.keyframes, state.poses = state.keyframes[~leave], state.poses[~leave]


def _keep_columns(state: State, keep: NDArray[np.bool_]) -> None:
    state.cov = square(state.cov, np.flatnonzero(keep))


def square(matrix: NDArray[Float], which: I64) -> NDArray[Float]:
    """Rows and columns number `which` of a square matrix; faster than with `np.ix_`."""
    return matrix.take(which, axis=0).take(which, axis=1)


def _widened(cov: F64, at: int, more: int) -> F64:
    """With so many new rows and columns of zeros before number `at`."""
    n = len(cov)
    out = np.zeros((n + more, n + more))
    out[:at, :at], out[:at, at + more :] = cov[:at, :at], cov[:at, at:]
    out[at + more :, :at], out[at + more :, at + more :] = cov[at:, :at], cov[at:, at:]
    return out


def number_of(state: State, keyframe: int) -> int:
    """Of the keyframe with this id, which the state has."""
    return int(np.flatnonzero(state.keyframes == keyframe)[0])


def motion(state: State, a: int, b: int) -> F64:
    """T_a_b (4, 4) between keyframes number a and b of the state."""
    return se3.orthonormal(se3.inverse(state.poses[a]) @ state.poses[b])


def motion_cov(state: State, a: int, b: int) -> F64:
    """Of T_a_b (6, 6) between keyframes number a and b of the state, perturbed on the right."""
    Ad = se3.adjoint(se3.inverse(state.poses[b]))
    out: F64 = Ad @ _between(state, state.keyframe(a), state.keyframe(b)) @ Ad.T
    return (out + out.T) / 2 + _LEAST_COV * np.eye(6)


def motion_since(state: State) -> F64:
    """Covariance (6, 6) of the body's motion since the newest keyframe, perturbed on the right."""
    Ad = se3.adjoint(se3.inverse(state.T))
    out: F64 = Ad @ _between(state, POSE, state.keyframe(len(state.keyframes) - 1)) @ Ad.T
    return (out + out.T) / 2


def drift_m(state: State) -> float:
    """Sigma of the body's position against the newest keyframe's, m."""
    return se3.position_sigma(motion_since(state))


def _between(state: State, a: slice, b: slice) -> F64:
    """Covariance (6, 6) of the difference of two poses' errors, in odom."""
    P = state.cov
    out: F64 = P[a, a] + P[b, b] - P[a, b] - P[b, a]
    return out


def scale_sigma(state: State) -> float:
    """Of the scale of what is seen, relative: of the best estimate of an error that all inverse depths share;
    inf without any."""
    at = slice(state.features_at, state.size)
    P = state.cov[at, at]
    known = float(state.rho @ np.linalg.solve(P, state.rho)) if len(P) else 0.0
    return float(np.inf) if known <= 0 else known**-0.5


def pose_cov(state: State) -> F64:
    """Of T_odom_body (6, 6), perturbed on the right as everywhere else (`share.geometry.se3`)."""
    return _on_the_right(state, state.T, POSE)


def keyframe_cov(state: State, k: int) -> F64:
    """The same of keyframe number k's."""
    return _on_the_right(state, state.poses[k], state.keyframe(k))


def _on_the_right(state: State, T: F64, at: slice) -> F64:
    Ad = se3.adjoint(se3.inverse(T))
    out: F64 = Ad @ state.cov[at, at] @ Ad.T
    return out
