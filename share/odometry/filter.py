"""The steps of the filter: propagate, gate, update, covariances of poses. Each changes the state in place.

Source: EKF with right-invariant errors, see `state`; time offset in the state: Li & Mourikis (2014).
`state` adds and removes keyframes and features.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

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
    IMU_STATE_SIZE,
    KEYFRAMES_START,
    ORIGIN,
    POSE,
    TIMESHIFT,
    VELOCITY,
    FilterState,
    twist,
)
from share.types import F64, I64, ImuBatch

CALIBRATION = slice(EXTRINSIC.start, CORE_SIZE)  # extrinsic and time offset
_TILT_AND_VELOCITY = np.array([0, 1, 6, 7, 8])  # columns
# rad^2, (m/s)^2 of these: with a larger variance, single precision does not suffice.
_SINGLE_PRECISION_VARIANCE = np.array([3e-4, 3e-4, 1e-2, 1e-2, 1e-2])
_MIN_VARIANCE = 1e-10  # rounding error of differences of covariances
GATE = 12.0  # NIS above which a measurement is rejected (2 degrees of freedom: 99.8 %; 3: 99.3 %)
CORRELATION_INFLATION = 16.0  # frames for which a correlated error lasts; chosen by NEES
FloatArray = NDArray[np.floating[Any]]  # in double or in single precision
_MAX_ITERATIONS = 4  # of the iterated update
_STEP_TOLERANCE = 1e-4  # rad, m, 1/m: a smaller step does not change the derivatives


@dataclass(frozen=True, eq=False)
class FeatureMeasurements(ArrayTable):
    """M measurements of an update.

    feature, anchor (M,): indices of the feature and of its anchor keyframe. residual (M, 2): measured -
    predicted. Its derivatives: H_core (M, 2, 22), H_anchor (M, 2, 6) by the anchor's pose, H_rho (M, 2) by
    the inverse depth. Noise of a coordinate, in the residual's unit: sigma (M,), independent in every image;
    correlated_sigma (M,), the same in both cameras and almost the same in the next images.
    """

    feature: I64
    anchor: I64
    residual: F64
    H_core: F64
    H_anchor: F64
    H_rho: F64
    sigma: F64
    correlated_sigma: F64


def propagate(state: FilterState, imu: ImuBatch, to_ns: int, noise: ImuNoise, gravity: float) -> F64:
    """Propagate the state to `to_ns`, IMU time. Return the body's rate (3,) rad/s then, free of bias.

    Raises ValueError without samples.
    """
    motion = integrate(state.T, state.v, state.bg, state.ba, imu, state.stamp_ns, to_ns, noise, gravity)
    F, P = motion.transition, state.cov
    own = F @ P[:IMU_STATE_SIZE, :IMU_STATE_SIZE] @ F.T + motion.noise_cov
    P[:IMU_STATE_SIZE, :IMU_STATE_SIZE] = (own + own.T) / 2
    P[:IMU_STATE_SIZE, IMU_STATE_SIZE:] = F @ P[:IMU_STATE_SIZE, IMU_STATE_SIZE:]
    P[IMU_STATE_SIZE:, :IMU_STATE_SIZE] = P[:IMU_STATE_SIZE, IMU_STATE_SIZE:].T
    state.T, state.v, state.stamp_ns = motion.T, motion.v, to_ns
    return motion.rate


def feature_measurements(
    state: FilterState,
    indices: I64,
    predicted: Prediction,
    uv: F64,
    sigma: F64,
    correlated_sigma: F64,
    rate: F64,
) -> FeatureMeasurements:
    """Return measurements of features `indices` (M,) at uv (M, 2), with `predicted` positions; sigma,
    correlated_sigma (M,)."""
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
    """Return H cov (2 M, n) and H cov H' + R (2 M, 2 M) of measurements sorted by anchor.

    common_cov (6, 6): covariance of a pose error (on the right) that all measurements share. H is not formed:
    a row has 29 entries.

    Measurements depend on a keyframe's pose only relative to the body's. With that difference taken first,
    their common uncertainty cancels and single precision suffices, except where tilt or velocity is
    uncertain, or with `double_precision`.
    """
    M, n = len(rows.feature), state.size
    dtype: type[np.floating[Any]] = (
        np.float64 if double_precision or needs_double_precision(state) else np.float32
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
    _add_measurement_noise(S, rows)
    if common_cov is not None:
        B = H_anchor @ se3.adjoint(state.T).astype(dtype)
        S += B @ common_cov.astype(dtype) @ B.T
    poses = HP[:, KEYFRAMES_START : state.features_start].reshape(2 * M, -1, 6)
    poses += HP[:, None, POSE]
    return HP, S


def _add_measurement_noise(S: FloatArray, rows: FeatureMeasurements) -> None:
    """Add R to S (2 M, 2 M): independent noise, and the part that both cameras' measurements of a feature
    share."""
    S.reshape(-1)[:: len(S) + 1] += np.repeat(
        rows.sigma**2 + CORRELATION_INFLATION * rows.correlated_sigma**2, 2
    ).astype(S.dtype)
    first, second = _stereo_pairs(rows.feature)
    shared = CORRELATION_INFLATION * rows.correlated_sigma[first] * rows.correlated_sigma[second]
    for axis in (0, 1):
        entries = 2 * first + axis, 2 * second + axis
        S[entries] += shared.astype(S.dtype)
        S[entries[::-1]] = S[entries]


def needs_double_precision(state: FilterState) -> bool:
    """Return whether an update may reduce the uncertainty by more than single precision can represent."""
    return bool((state.cov.diagonal()[_TILT_AND_VELOCITY] > _SINGLE_PRECISION_VARIANCE).any())


def _relative_to_body(state: FilterState) -> F64:
    """Return the covariance with the errors of keyframe poses relative to the body's."""
    P, n = state.cov.copy(), state.size
    poses = slice(KEYFRAMES_START, state.features_start)
    rows = P[poses].reshape(-1, 6, n)
    rows -= P[POSE]
    columns = P[:, poses].reshape(n, -1, 6)
    columns -= P[:, None, POSE]
    return P


def _stereo_pairs(indices: I64) -> tuple[I64, I64]:
    """Return the indices (K,), (K,) of measurements of one feature by both cameras."""
    order = np.argsort(indices, kind="stable")
    repeated = np.flatnonzero(indices[order[1:]] == indices[order[:-1]])
    return order[repeated], order[repeated + 1]


def _runs(anchor: I64) -> tuple[I64, I64, I64]:
    """Return value, start and end of each run of equal values."""
    bounds = np.flatnonzero(anchor[1:] != anchor[:-1]) + 1
    first = np.concatenate([[0], bounds]) if len(anchor) else bounds
    return anchor[first], first, np.concatenate([bounds, [len(anchor)]]) if len(anchor) else bounds


def nis(rows: FeatureMeasurements, S: FloatArray) -> F64:
    """Return the NIS (M,) of each measurement by itself, 2 degrees of freedom; inf where nothing was
    predicted."""
    M = len(rows.feature)
    a, b = 2 * np.arange(M), 2 * np.arange(M) + 1
    inflation = (CORRELATION_INFLATION - 1) * rows.correlated_sigma**2  # a single error is not inflated
    return residual_nis(rows.residual, S[a, a] - inflation, S[a, b], S[b, b] - inflation)


def residual_nis(residual: F64, sxx: FloatArray, sxy: FloatArray, syy: FloatArray) -> F64:
    """Return the NIS (M,) of residuals (M, 2) with covariances [[sxx, sxy], [sxy, syy]], each (M,)."""
    x, y = residual.T
    distance = (syy * x * x - 2 * sxy * x * y + sxx * y * y) / (sxx * syy - sxy * sxy)
    out: F64 = np.where(np.isfinite(distance), distance, np.inf)
    return out


def relinearised_rows(
    state: FilterState, make_rows: Callable[[], FeatureMeasurements], common_cov: F64 | None = None
) -> FeatureMeasurements:
    """Return measurements with derivatives at the state that they lead to: an iterated EKF (Bell & Cathey
    1993).

    make_rows: computes the measurements from `state`, whose means are unchanged on return. For first
    predictions that are far off. The residuals are as `innovation_covariance` and `update` expect them.
    """
    before, error = state.means(), np.zeros(state.size)
    for _ in range(_MAX_ITERATIONS):
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
    """Return H error (M, 2)."""
    pose_errors = error[KEYFRAMES_START : state.features_start].reshape(-1, 6)[rows.anchor]
    from_rho = rows.H_rho * error[state.features_start + rows.feature, None]
    out: F64 = rows.H_core @ error[:CORE_SIZE] + (rows.H_anchor @ pose_errors[:, :, None])[:, :, 0] + from_rho
    return out


def update(state: FilterState, rows: FeatureMeasurements, HP: FloatArray, S: FloatArray) -> float:
    """Update with measurements and their `innovation_covariance`. Return the NIS of all of them together.

    Raises numpy.linalg.LinAlgError where S is not positive definite.
    """
    return apply_update(state, rows.residual.ravel(), HP, S)


def apply_update(state: FilterState, residual: F64, HP: FloatArray, S: FloatArray) -> float:
    """Update with a residual (m,), HP = H cov (m, n) and its covariance S (m, m). Return the NIS."""
    error, W, whitened = _whitened_update(HP, S, residual)
    state.cov -= W.T @ W  # numpy makes this product exactly symmetric
    correct_means(state, error)
    return float(whitened @ whitened)


def isotropic_update(state: FilterState, residual: F64, H: F64, sigma: float, gate: float = np.inf) -> bool:
    """Update with a residual (m,), its Jacobian H (m, n) and independent noise of the same `sigma` in each.
    Return False, and change nothing, if the NIS exceeds `gate`."""
    HP = H @ state.cov
    S = HP @ H.T + sigma**2 * np.eye(len(H))
    if residual @ np.linalg.solve(S, residual) > gate:
        return False
    apply_update(state, residual, HP, S)
    return True


def zero_velocity_update(state: FilterState, sigma: float) -> bool:
    """Update with a velocity of 0, sigma m/s. Return False if `GATE` rejects it, see `isotropic_update`."""
    H = np.zeros((3, state.size))
    H[:, POSE][:, :3], H[:, VELOCITY] = -se3.hat(state.v), np.eye(3)
    return isotropic_update(state, -state.v, H, sigma, GATE)


def inflate(state: FilterState, sigma_rad: float, sigma_m: float, sigma_m_s: float) -> None:
    """Inflate the covariance of pose and velocity, for errors that no model explains. rad, m, m/s."""
    Ad = se3.adjoint(state.T)
    state.cov[POSE, POSE] += Ad @ np.diag(np.repeat([sigma_rad**2, sigma_m**2], 3)) @ Ad.T
    state.cov[VELOCITY, VELOCITY] += sigma_m_s**2 * np.eye(3)


def _whitened_update(HP: FloatArray, S: FloatArray, residual: F64) -> tuple[F64, FloatArray, FloatArray]:
    """Return the correction (n,), L^-1 H cov (m, n) and L^-1 residual (m,), where L L' = S, in the precision
    of HP and S."""
    single = HP.dtype == np.float32
    factor, solve = (lapack.spotrf, blas.strsm) if single else (lapack.dpotrf, blas.dtrsm)
    L, info = factor(S, lower=1, clean=1)
    if info:
        raise np.linalg.LinAlgError("innovation covariance is not positive definite")
    whitened: FloatArray = solve(1.0, L, residual[:, None].astype(HP.dtype), lower=1)[:, 0]
    W: FloatArray = solve(1.0, L, HP.T, side=1, lower=1, trans_a=1).T  # Fortran order: no copy
    return (W.T @ whitened).astype(np.float64), W, whitened


def correct_means(state: FilterState, error: F64) -> None:
    """Apply a correction (n,) to the means."""
    pose_errors = error[KEYFRAMES_START : state.features_start].reshape(-1, 6)
    delta = se3.exp(np.concatenate([[error[POSE], error[EXTRINSIC], error[ORIGIN]], pose_errors]))
    rotation = delta[0, :3, :3]
    state.v = rotation @ state.v + error[VELOCITY]
    state.T = delta[0] @ state.T
    state.T_origin = delta[2] @ state.T_origin
    state.keyframe_poses = delta[3:] @ state.keyframe_poses
    state.bg, state.ba = state.bg + error[GYRO_BIAS], state.ba + error[ACCEL_BIAS]
    state.T_body_cam = state.T_body_cam @ delta[1]
    state.timeshift_s += float(error[TIMESHIFT])
    state.rho = state.rho + error[state.features_start :]


def keyframe_index(state: FilterState, keyframe_id: int) -> int:
    """Return the index of the keyframe with this id. Raises IndexError if the state does not have it."""
    return int(np.flatnonzero(state.keyframe_ids == keyframe_id)[0])


def relative_pose(state: FilterState, a: int, b: int) -> F64:
    """Return T_a_b (4, 4) between the keyframes with indices a and b."""
    return se3.orthonormal(se3.inverse(state.keyframe_poses[a]) @ state.keyframe_poses[b])


def relative_pose_cov(state: FilterState, a: int, b: int) -> F64:
    """Return the covariance (6, 6) of T_a_b between the keyframes with indices a and b, perturbed on the
    right."""
    return _at_keyframe(state, b, _relative_cov(state, state.keyframe_columns(a), state.keyframe_columns(b)))


def relative_poses(state: FilterState, indices: I64, b: int) -> tuple[F64, F64]:
    """Return T_a_b (M, 4, 4) from the keyframes with `indices` (M,) to keyframe b, with covariances (M, 6,
    6), perturbed on the right."""
    T_a_b = se3.orthonormal(se3.inverse(state.keyframe_poses[indices]) @ state.keyframe_poses[b])
    P, columns_b = state.cov, state.keyframe_columns(b)
    columns = KEYFRAMES_START + 6 * indices[:, None] + np.arange(6)
    P_ab = P[:, columns_b][columns]
    difference = P[columns[:, :, None], columns[:, None, :]] + P[columns_b, columns_b]
    difference -= P_ab + P_ab.swapaxes(1, 2)
    return T_a_b, _at_keyframe(state, b, difference)


def motion_cov_since_keyframe(state: FilterState) -> F64:
    """Return the covariance (6, 6) of the body's motion since the newest keyframe, perturbed on the right."""
    return _motion_cov_since(state, state.keyframe_columns(len(state.keyframe_ids) - 1))


def motion_cov_since_origin(state: FilterState) -> F64:
    """Return the covariance (6, 6) of the body's motion since the filter began, perturbed on the right. It is
    that of its pose in a frame that keeps the tilt with which the filter began."""
    return _motion_cov_since(state, ORIGIN) + _MIN_VARIANCE * np.eye(6)


def _motion_cov_since(state: FilterState, columns: slice) -> F64:
    Ad = se3.adjoint(se3.inverse(state.T))
    out: F64 = Ad @ _relative_cov(state, POSE, columns) @ Ad.T
    return (out + out.T) / 2


def drift_m(state: FilterState) -> float:
    """Return the sigma, m, of the body's position relative to the newest keyframe."""
    return se3.position_sigma(motion_cov_since_keyframe(state))


def _at_keyframe(state: FilterState, b: int, cov: F64) -> F64:
    """Return covariances (..., 6, 6) of errors in odom as perturbations on the right of keyframe b."""
    Ad = se3.adjoint(se3.inverse(state.keyframe_poses[b]))
    out: F64 = Ad @ cov @ Ad.T
    return (out + out.swapaxes(-1, -2)) / 2 + _MIN_VARIANCE * np.eye(6)


def _relative_cov(state: FilterState, a: slice, b: slice) -> F64:
    """Return the covariance (6, 6) of the difference of two poses' errors, in odom."""
    P = state.cov
    out: F64 = P[a, a] + P[b, b] - P[a, b] - P[b, a]
    return out


def scale_sigma(state: FilterState) -> float:
    """Return the relative sigma of the scale: of the best estimate of an error that all inverse depths share;
    inf without features."""
    columns = slice(state.features_start, state.size)
    P = state.cov[columns, columns]
    information = float(state.rho @ np.linalg.solve(P, state.rho)) if len(P) else 0.0
    return float(np.inf) if information <= 0 else information**-0.5


def keyframe_cov(state: FilterState, k: int) -> F64:
    """Return the covariance (6, 6) of the pose of keyframe k in odom, perturbed on the right."""
    columns, Ad = state.keyframe_columns(k), se3.adjoint(se3.inverse(state.keyframe_poses[k]))
    out: F64 = Ad @ state.cov[columns, columns] @ Ad.T
    return out
