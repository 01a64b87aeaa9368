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

from share.array_table import ArrayTable
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.odometry.feature_matching import Prediction
from share.odometry.imu_propagation import integrate
from share.odometry.state import (
    ACCEL_BIAS,
    CORE_SIZE,
    EXTRINSIC,
    GYRO_BIAS,
    POSE,
    TIMESHIFT,
    VELOCITY,
    FilterState,
)
from share.types import F64, I64, ImuBatch

CALIBRATION = slice(EXTRINSIC.start, CORE_SIZE)  # what rows see of the core beside poses
_TILT_AND_VELOCITY = np.array([0, 1, 6, 7, 8])  # tilt and velocity,
_SINGLE_PRECISION_VARIANCE = np.array(
    [3e-4, 3e-4, 1e-2, 1e-2, 1e-2]
)  # rad^2, (m/s)^2: where single precision is too little
_IMU_STATE_SIZE = 15  # columns that propagation changes
_MIN_VARIANCE = 1e-10  # what differences of covariances lose
CORRELATION_INFLATION = 16.0  # sights of an error that lasts; chosen by NEES
FloatArray = NDArray[np.floating[Any]]  # in double or in single precision
Float = TypeVar("Float", bound=np.floating[Any])
_STEP_TOLERANCE = 1e-4  # rad, m, 1/m: a correction that changes no derivative


@dataclass(frozen=True, eq=False)
class FeatureMeasurements(ArrayTable):
    """Rows of an update: residual (M, 2) measured - predicted, and how it depends on the state: core
    (M, 2, 22), the pose (M, 2, 6) of keyframe number host (M,), inverse depth (M, 2) of feature number
    which (M,). Of one coordinate, as the residual: sigma (M,), anew in every image; lasting (M,), the same
    in both cameras' and much the same in the next ones."""

    feature: I64
    anchor: I64
    residual: F64
    H_core: F64
    H_anchor: F64
    H_rho: F64
    sigma: F64
    correlated_sigma: F64


def propagate(state: FilterState, imu: ImuBatch, to_ns: int, noise: ImuNoise, gravity: float) -> F64:
    """To `to_ns`, IMU time. The body's rate (3,) rad/s then, free of bias. Raises ValueError without
    samples."""
    motion = integrate(state.T, state.v, state.bg, state.ba, imu, state.stamp_ns, to_ns, noise, gravity)
    F, P = motion.transition, state.cov
    own = F @ P[:_IMU_STATE_SIZE, :_IMU_STATE_SIZE] @ F.T + motion.noise_cov
    P[:_IMU_STATE_SIZE, :_IMU_STATE_SIZE] = (own + own.T) / 2
    P[:_IMU_STATE_SIZE, _IMU_STATE_SIZE:] = F @ P[:_IMU_STATE_SIZE, _IMU_STATE_SIZE:]
    P[_IMU_STATE_SIZE:, :_IMU_STATE_SIZE] = P[:_IMU_STATE_SIZE, _IMU_STATE_SIZE:].T
    state.T, state.v, state.stamp_ns = motion.T, motion.v, to_ns
    return motion.rate


def twist(state: FilterState, rate: F64) -> F64:
    """How the body's pose moves with time, (6,): T(t + dt) = Exp(twist dt) T(t). rate (3,): rad/s, body."""
    turning = state.T[:3, :3] @ rate
    (a, b, c), (x, y, z) = turning.tolist(), state.T[:3, 3].tolist()
    return np.concatenate([turning, state.v - (b * z - c * y, c * x - a * z, a * y - b * x)])


def feature_measurements(
    state: FilterState,
    indices: I64,
    predicted: Prediction,
    uv: F64,
    sigma: F64,
    correlated_sigma: F64,
    rate: F64,
) -> FeatureMeasurements:
    """What was seen at uv (M, 2), sigma and lasting (M,), of features number `which` (M,), where `predicted`
    was predicted."""
    core = np.zeros((len(indices), 2, CORE_SIZE))
    core[:, :, POSE], core[:, :, EXTRINSIC] = predicted.H_pose, predicted.H_extrinsic
    core[:, :, TIMESHIFT] = predicted.H_pose @ twist(state, rate)
    return FeatureMeasurements(
        indices,
        state.anchor[indices],
        uv - predicted.uv,
        core,
        -predicted.H_pose,
        predicted.H_rho,
        sigma,
        correlated_sigma,
    )


def innovation_covariance(
    state: FilterState,
    rows: FeatureMeasurements,
    common_cov: F64 | None = None,
    double_precision: bool = False,
) -> tuple[FloatArray, FloatArray]:
    """H cov (2 M, n) and H cov H' + R (2 M, 2 M) of rows sorted by host. H is not formed: a row has 29
    entries. common (6, 6): covariance of an error that all rows share, as one of the pose, on its right.

    Rows know of a keyframe's pose only less the body's. With that difference taken first, what both are
    unsure of together is gone, and single precision is enough; but where all is vague, or `double_precision`.
    """
    M, n = len(rows.feature), state.size
    dtype: type[np.floating[Any]] = (
        np.float64 if double_precision or _needs_double_precision(state) else np.float32
    )
    P = _relative_to_body(state).astype(dtype, copy=False)
    H_calibration = rows.H_core[:, :, CALIBRATION].reshape(2 * M, -1).astype(dtype, copy=False)
    H_anchor, H_rho = rows.H_anchor.astype(dtype, copy=False), rows.H_rho.astype(dtype, copy=False)
    H_anchor, feature_columns = H_anchor.reshape(2 * M, 6), state.features_start + rows.feature
    groups = [
        (state.keyframe_columns(h), slice(2 * a, 2 * b))
        for h, a, b in zip(*(part.tolist() for part in _runs(rows.anchor)), strict=True)
    ]
    HP = H_calibration @ P[CALIBRATION]
    HP.reshape(M, 2, n)[:] += H_rho[:, :, None] * P.take(feature_columns, axis=0)[:, None, :]
    for columns, part in groups:
        HP[part] += H_anchor[part] @ P[columns]
    S = H_calibration @ HP[:, CALIBRATION].T
    S.reshape(M, 2, 2 * M)[:] += H_rho[:, :, None] * HP.T.take(feature_columns, axis=0)[:, None, :]
    for columns, part in groups:
        S[part] += H_anchor[part] @ HP[:, columns].T
    S.reshape(-1)[:: 2 * M + 1] += np.repeat(
        rows.sigma**2 + CORRELATION_INFLATION * rows.correlated_sigma**2, 2
    ).astype(dtype)
    first, second = _stereo_pairs(rows.feature)
    for axis in (0, 1):
        entries = 2 * first + axis, 2 * second + axis
        S[entries] += (
            CORRELATION_INFLATION * rows.correlated_sigma[first] * rows.correlated_sigma[second]
        ).astype(dtype)
        S[entries[::-1]] = S[entries]
    if common_cov is not None:
        B = H_anchor @ se3.adjoint(state.T).astype(dtype)
        S += B @ common_cov.astype(dtype) @ B.T
    poses = HP[:, CORE_SIZE : state.features_start].reshape(2 * M, -1, 6)
    poses += HP[:, None, POSE]
    return HP, S


def _needs_double_precision(state: FilterState) -> bool:
    """Whether so much of what is unknown may go at once that single precision is too little."""
    return bool((state.cov.diagonal()[_TILT_AND_VELOCITY] > _SINGLE_PRECISION_VARIANCE).any())


def _relative_to_body(state: FilterState) -> F64:
    """cov with the errors of keyframes' poses less that of the body's in their place."""
    P, n = state.cov.copy(), state.size
    poses = slice(CORE_SIZE, state.features_start)
    rows = P[poses].reshape(-1, 6, n)
    rows -= P[POSE]
    columns = P[:, poses].reshape(n, -1, 6)
    columns -= P[:, None, POSE]
    return P


def _stereo_pairs(indices: I64) -> tuple[I64, I64]:
    """Numbers (K,) of rows that both cameras have of a feature."""
    order = np.argsort(indices, kind="stable")
    repeated = np.flatnonzero(indices[order[1:]] == indices[order[:-1]])
    return order[repeated], order[repeated + 1]


def _runs(anchor: I64) -> tuple[I64, I64, I64]:
    """Value, first and last + 1 of each run of equal ones."""
    first = np.flatnonzero(np.r_[True, anchor[1:] != anchor[:-1]]) if len(anchor) else np.zeros(0, np.int64)
    return anchor[first], first, np.r_[first[1:], len(anchor)]


def nis(rows: FeatureMeasurements, S: FloatArray) -> F64:
    """Squared Mahalanobis distance (M,) of each residual on its own, 2 degrees of freedom; inf where nothing
    was predicted."""
    M = len(rows.feature)
    a, b = 2 * np.arange(M), 2 * np.arange(M) + 1
    x, y = rows.residual.T
    inflation = (CORRELATION_INFLATION - 1) * rows.correlated_sigma**2  # it is no larger for lasting
    sxx, sxy, syy = S[a, a] - inflation, S[a, b], S[b, b] - inflation
    distance = (syy * x * x - 2 * sxy * x * y + sxx * y * y) / (sxx * syy - sxy * sxy)
    out: F64 = np.where(np.isfinite(distance), distance, np.inf)
    return out


def relinearised_rows(
    state: FilterState,
    make_rows: Callable[[], FeatureMeasurements],
    common_cov: F64 | None = None,
    iterations: int = 4,
) -> FeatureMeasurements:
    """Rows whose derivatives are those at the state that they lead to: an iterated EKF (Bell & Cathey 1993).

    rows_at: makes them from `state`, whose means are as before when this returns. For where the first
    prediction is far off; the rows' residuals are what `innovation_covariance` and `update` want.
    """
    before, error = state.means(), np.zeros(state.size)
    for _ in range(iterations):
        rows = make_rows()
        rows.residual[:] += jacobian_product(state, rows, error)
        step = (
            _whitened_update(
                *innovation_covariance(state, rows, common_cov, double_precision=True), rows.residual.ravel()
            )[0]
            - error
        )
        error += step
        state.restore(before)
        correct_means(state, error)
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    rows = make_rows()
    rows.residual[:] += jacobian_product(state, rows, error)
    state.restore(before)
    return rows


def jacobian_product(state: FilterState, rows: FeatureMeasurements, error: F64) -> F64:
    """H error (M, 2)."""
    pose_errors = error[CORE_SIZE : state.features_start].reshape(-1, 6)[rows.anchor]
    from_rho = rows.H_rho * error[state.features_start + rows.feature, None]
    out: F64 = rows.H_core @ error[:CORE_SIZE] + (rows.H_anchor @ pose_errors[:, :, None])[:, :, 0] + from_rho
    return out


def update(state: FilterState, rows: FeatureMeasurements, HP: FloatArray, S: FloatArray) -> float:
    """Apply rows with their `innovation_covariance`. The squared Mahalanobis distance of all of them
    together.

    Raises numpy.linalg.LinAlgError where S is not positive definite."""
    return apply_update(state, rows.residual.ravel(), HP, S)


def apply_update(state: FilterState, residual: F64, HP: FloatArray, S: FloatArray) -> float:
    """residual (m,), H cov (m, n), its covariance S (m, m)."""
    error, W, whitened = _whitened_update(HP, S, residual)
    state.cov -= W.T @ W  # numpy makes this one symmetric to the last bit
    correct_means(state, error)
    return float(whitened @ whitened)


def scalar_update(state: FilterState, residual: F64, H: F64, sigma: float, gate: float = np.inf) -> bool:
    """Apply a few rows H (m, n) of any kind, sigma of each. Whether they were believed: where they contradict
    the state by more than `gate`, a squared Mahalanobis distance, nothing is done."""
    HP = H @ state.cov
    S = HP @ H.T + sigma**2 * np.eye(len(H))
    if residual @ np.linalg.solve(S, residual) > gate:
        return False
    apply_update(state, residual, HP, S)
    return True


def zero_velocity_update(state: FilterState, sigma: float, gate: float) -> bool:
    """The body stands still: its velocity is 0, sigma m/s. Whether that was believed, see `scalar_update`."""
    H = np.zeros((3, state.size))
    H[:, POSE][:, :3], H[:, VELOCITY] = -se3.hat(state.v), np.eye(3)
    return scalar_update(state, -state.v, H, sigma, gate)


def inflate(state: FilterState, sigma_rad: float, sigma_m: float, sigma_m_s: float) -> None:
    """Nobody knows why, but pose and velocity may be off by so much, rad, m, m/s."""
    Ad = se3.adjoint(state.T)
    state.cov[POSE, POSE] += Ad @ np.diag(np.repeat([sigma_rad**2, sigma_m**2], 3)) @ Ad.T
    state.cov[VELOCITY, VELOCITY] += sigma_m_s**2 * np.eye(3)


def _whitened_update(HP: FloatArray, S: FloatArray, residual: F64) -> tuple[F64, FloatArray, FloatArray]:
    """The error (n,) that the residual tells of, L^-1 H cov (m, n), L^-1 residual (m,) with L L' = S; in
    the precision that HP and S have."""
    single = HP.dtype == np.float32
    factor, solve = (lapack.spotrf, blas.strsm) if single else (lapack.dpotrf, blas.dtrsm)
    L, info = factor(S, lower=1, clean=1)
    if info:
        raise np.linalg.LinAlgError("innovation covariance is not positive definite")
    whitened: FloatArray = solve(1.0, L, residual[:, None].astype(HP.dtype), lower=1)[:, 0]
    W: FloatArray = solve(1.0, L, HP.T, side=1, lower=1, trans_a=1).T  # as Fortran has it: no copy
    return (W.T @ whitened).astype(np.float64), W, whitened


def correct_means(state: FilterState, error: F64) -> None:
    """Means by an error (n,)."""
    pose_errors = error[CORE_SIZE : state.features_start].reshape(-1, 6)
    delta = se3.exp(np.concatenate([error[POSE][None], error[EXTRINSIC][None], pose_errors]))
    rotation = delta[0, :3, :3]
    state.v = rotation @ state.v + error[VELOCITY]
    state.T = delta[0] @ state.T
    state.keyframe_poses = delta[2:] @ state.keyframe_poses
    state.bg, state.ba = state.bg + error[GYRO_BIAS], state.ba + error[ACCEL_BIAS]
    state.T_body_cam = state.T_body_cam @ delta[1]
    state.timeshift_s += float(error[TIMESHIFT])
    state.rho = state.rho + error[state.features_start :]


def add_keyframe(state: FilterState, keyframe_id: int, rate: F64) -> int:
    """The body's pose as it is when the image is taken: how far it has come by then depends on the time
    offset. Its number."""
    n, start = state.size, state.features_start
    J = np.zeros((6, n))
    J[:, POSE] = np.eye(6)
    J[:, TIMESHIFT] = twist(state, rate)
    rows = J @ state.cov
    grown = _insert_zeros(state.cov, start, 6)
    for old, now in ((slice(0, start), slice(0, start)), (slice(start, n), slice(start + 6, n + 6))):
        grown[start : start + 6, now], grown[now, start : start + 6] = rows[:, old], rows[:, old].T
    grown[start : start + 6, start : start + 6] = rows @ J.T
    state.cov = grown
    state.keyframe_ids = np.append(state.keyframe_ids, keyframe_id)
    state.keyframe_poses = np.concatenate([state.keyframe_poses, state.T[None]])
    return len(state.keyframe_ids) - 1


def add_features(
    state: FilterState,
    ids: I64,
    anchor: I64,
    ray: F64,
    rho: F64,
    sigma: F64,
    J_existing: F64 | None = None,
    common_sigma: F64 | None = None,
) -> None:
    """Features (N,) that keyframes number `anchor` (N,) see on rays (N, 2), inverse depths rho, sigma (N,) of
    what each is off by itself. like (N, M): how the errors of the M inverse depths there are come in; common
    (N,): sigma of an error that the new ones share."""
    n, count = state.size, len(ids)
    grown = _insert_zeros(state.cov, n, count)
    new = slice(n, n + count)
    if J_existing is not None and J_existing.shape[1]:
        rows = J_existing @ state.cov[state.features_start :]
        grown[new, :n], grown[:n, new] = rows, rows.T
        grown[new, new] = rows[:, state.features_start :] @ J_existing.T
    diagonal = np.arange(n, n + count)
    grown[diagonal, diagonal] += sigma**2
    if common_sigma is not None and common_sigma.any():
        grown[new, new] += np.outer(common_sigma, common_sigma)
    state.cov = grown
    state.feature_ids = np.concatenate([state.feature_ids, ids])
    state.anchor = np.concatenate([state.anchor, anchor])
    state.ray = np.concatenate([state.ray, ray])
    state.rho = np.concatenate([state.rho, rho])


def keep_features(state: FilterState, keep: NDArray[np.bool_]) -> None:
    """The others are forgotten; what they taught of the rest stays."""
    if keep.all():
        return
    _keep_columns(state, np.concatenate([np.ones(state.features_start, bool), keep]))
    state.feature_ids, state.anchor = state.feature_ids[keep], state.anchor[keep]
    state.ray, state.rho = state.ray[keep], state.rho[keep]


def drop_keyframes(state: FilterState, keyframe_ids: I64) -> None:
    """These ids, with the features that they host."""
    dropped = np.isin(state.keyframe_ids, keyframe_ids)
    if not dropped.any():
        return
    keep = ~dropped[state.anchor]
    _keep_columns(state, np.concatenate([np.ones(CORE_SIZE, bool), np.repeat(~dropped, 6), keep]))
    state.feature_ids, state.ray, state.rho = state.feature_ids[keep], state.ray[keep], state.rho[keep]
    state.anchor = (np.cumsum(~dropped) - 1)[state.anchor[keep]]
    state.keyframe_ids, state.keyframe_poses = state.keyframe_ids[~dropped], state.keyframe_poses[~dropped]


def _keep_columns(state: FilterState, keep: NDArray[np.bool_]) -> None:
    state.cov = submatrix(state.cov, np.flatnonzero(keep))


def submatrix(matrix: NDArray[Float], indices: I64) -> NDArray[Float]:
    """Rows and columns number `which` of a square matrix; faster than with `np.ix_`."""
    return matrix.take(indices, axis=0).take(indices, axis=1)


def _insert_zeros(cov: F64, start: int, count: int) -> F64:
    """With so many new rows and columns of zeros before number `at`."""
    n = len(cov)
    out = np.zeros((n + count, n + count))
    out[:start, :start], out[:start, start + count :] = cov[:start, :start], cov[:start, start:]
    out[start + count :, :start], out[start + count :, start + count :] = (
        cov[start:, :start],
        cov[start:, start:],
    )
    return out


def keyframe_index(state: FilterState, keyframe_id: int) -> int:
    """Of the keyframe with this id, which the state has."""
    return int(np.flatnonzero(state.keyframe_ids == keyframe_id)[0])


def relative_pose(state: FilterState, a: int, b: int) -> F64:
    """T_a_b (4, 4) between keyframes number a and b of the state."""
    return se3.orthonormal(se3.inverse(state.keyframe_poses[a]) @ state.keyframe_poses[b])


def relative_pose_cov(state: FilterState, a: int, b: int) -> F64:
    """Of T_a_b (6, 6) between keyframes number a and b of the state, perturbed on the right."""
    Ad = se3.adjoint(se3.inverse(state.keyframe_poses[b]))
    out: F64 = Ad @ _relative_cov(state, state.keyframe_columns(a), state.keyframe_columns(b)) @ Ad.T
    return (out + out.T) / 2 + _MIN_VARIANCE * np.eye(6)


def motion_cov_since_keyframe(state: FilterState) -> F64:
    """Covariance (6, 6) of the body's motion since the newest keyframe, perturbed on the right."""
    Ad = se3.adjoint(se3.inverse(state.T))
    out: F64 = Ad @ _relative_cov(state, POSE, state.keyframe_columns(len(state.keyframe_ids) - 1)) @ Ad.T
    return (out + out.T) / 2


def drift_m(state: FilterState) -> float:
    """Sigma of the body's position against the newest keyframe's, m."""
    return se3.position_sigma(motion_cov_since_keyframe(state))


def _relative_cov(state: FilterState, a: slice, b: slice) -> F64:
    """Covariance (6, 6) of the difference of two poses' errors, in odom."""
    P = state.cov
    out: F64 = P[a, a] + P[b, b] - P[a, b] - P[b, a]
    return out


def scale_sigma(state: FilterState) -> float:
    """Of the scale of what is seen, relative: of the best estimate of an error that all inverse depths share;
    inf without any."""
    columns = slice(state.features_start, state.size)
    P = state.cov[columns, columns]
    information = float(state.rho @ np.linalg.solve(P, state.rho)) if len(P) else 0.0
    return float(np.inf) if information <= 0 else information**-0.5


def pose_cov(state: FilterState) -> F64:
    """Of T_odom_body (6, 6), perturbed on the right as everywhere else (`share.geometry.se3`)."""
    return _right_perturbed_cov(state, state.T, POSE)


def keyframe_cov(state: FilterState, k: int) -> F64:
    """The same of keyframe number k's."""
    return _right_perturbed_cov(state, state.keyframe_poses[k], state.keyframe_columns(k))


def _right_perturbed_cov(state: FilterState, T: F64, columns: slice) -> F64:
    Ad = se3.adjoint(se3.inverse(T))
    out: F64 = Ad @ state.cov[columns, columns] @ Ad.T
    return out
