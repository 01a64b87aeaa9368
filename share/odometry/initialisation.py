"""A first state from IMU samples, at rest or in motion, with the covariance that they allow.

There is no separate start-up. The filter's errors are right-invariant, so it converges from a tilt of tens of
degrees and a velocity of metres per second (Barrau & Bonnabel 2017).
"""

from __future__ import annotations

import numpy as np

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import ImuBias, Rig
from share.geometry.se3 import from_rt
from share.odometry import filter
from share.odometry.state import (
    ACCEL_BIAS,
    CORE_SIZE,
    EXTRINSIC,
    GYRO_BIAS,
    POSE,
    TIMESHIFT,
    VELOCITY,
    FilterState,
    initial_state,
)
from share.types import F64, ImuBatch, WaitReason

MIN_IMU_S = 0.05  # of IMU samples
_MAX_AGE_S = 0.1  # of the newest sample: an older one says nothing about the state now
_MIN_FORCE = 1.0  # m/s^2; in free fall, or of a dead accelerometer, a force does not show which way is up
_AVERAGING_S = 0.5
UNKNOWN_TILT_RAD = 1.0
_GAUGE_SIGMA = 1e-4  # rad, m: of position and heading, which define odom
_STILL_SPEED_SIGMA = 0.1  # m/s, of a body at rest
_MOVING_SPEED_SIGMA = 1.0  # m/s, of a body in motion
_MAX_STILL_ACCEL_STD = 0.15  # m/s^2, standard deviation at rest
_MAX_STILL_RATE = 0.05  # rad/s, mean plus standard deviation at rest
_STILL_FORCE_SIGMA = 0.03  # m/s^2, of the mean force less gravity and bias, at rest
_MOVING_FORCE_SIGMA = 1.5  # m/s^2, the same in motion
_STILL_RATE_SIGMA = 0.005  # rad/s, of the mean rate less bias, at rest
EXTRINSIC_SIGMA_RAD, EXTRINSIC_SIGMA_M = 1e-5, 1e-5  # of T_body_cam; small: as calibrated
_TIMESHIFT_SIGMA_S = 1e-6  # the same, of the camera's time offset to the IMU
_RATE_GATE, _FORCE_GATE = 16.3, 10.8  # chi-square, 3 and 1 degrees of freedom, 0.1 %


def state_from_imu(
    stamp_ns: int, imu: ImuBatch, rig: Rig, config: InertialConfig, bias: ImuBias
) -> FilterState | None:
    """Return a state at odom's origin, z up, at the time of the image; None with too few samples, with none
    of late, or while they do not show which way is up.

    bias: as known before; it is ignored where samples at rest contradict it.
    """
    force = mean_force(stamp_ns + rig.timeshift_ns, imu)
    if force is None:
        return None
    recent = _recent(imu)
    rate = recent.gyro.mean(axis=0)
    is_still = _is_still(recent.gyro, recent.accel)
    if rest_contradicts(bias, imu, config):
        bias = unknown_bias(config)
    T = align_to_gravity(force - bias.accel, rig.T_body_cam0[:3, 2])
    state = _state_at_image(stamp_ns, T, rig, bias, _initial_sigmas(is_still, bias))
    _update_with_force(state, force, _STILL_FORCE_SIGMA if is_still else _MOVING_FORCE_SIGMA, config.gravity)
    if is_still:
        _update_with_rate(state, rate)
    return state


def mean_force(now_ns: int, imu: ImuBatch) -> F64 | None:
    """Return the mean force (3,) of the newest samples; None with too few, with none of late, or where it
    does not show which way is up."""
    if len(imu) < 2 or (imu.stamps_ns[-1] - imu.stamps_ns[0]) < MIN_IMU_S * 1e9:
        return None
    if imu.stamps_ns[-1] < now_ns - _MAX_AGE_S * 1e9:
        return None
    force: F64 = _recent(imu).accel.mean(axis=0)
    return None if np.linalg.norm(force) < _MIN_FORCE else force


def state_from_camera(stamp_ns: int, rig: Rig, bias: ImuBias) -> FilterState:
    """Return a state for a body without IMU samples: up is the top of the image, until samples come (see
    `levelling`)."""
    up = rig.T_body_cam0[:3, :3] @ np.array([0.0, -1.0, 0.0])
    T = align_to_gravity(up, rig.T_body_cam0[:3, 2])
    sigma = _initial_sigmas(False, bias)
    sigma[0:2] = _GAUGE_SIGMA  # constant velocity says nothing of gravity
    return _state_at_image(stamp_ns, T, rig, bias, sigma)


def unknown_bias(config: InertialConfig) -> ImuBias:
    """Return a bias of 0 with the configured sigmas."""
    return ImuBias(np.zeros(3), np.zeros(3), config.gyro_bias, config.accel_bias)


def _state_at_image(stamp_ns: int, T: F64, rig: Rig, bias: ImuBias, sigma: F64) -> FilterState:
    """Return the state at the time of the image with this stamp, by the IMU's clock."""
    image_ns = stamp_ns + rig.timeshift_ns
    state = initial_state(image_ns, T, np.zeros(3), bias.gyro, bias.accel, rig.T_body_cam0, sigma)
    state.timeshift_s = rig.timeshift_s
    return state


def _is_still(gyro: F64, accel: F64) -> bool:
    rate = np.linalg.norm(gyro.mean(axis=0)) + np.linalg.norm(gyro.std(axis=0))
    return bool(rate < _MAX_STILL_RATE and np.linalg.norm(accel.std(axis=0)) < _MAX_STILL_ACCEL_STD)


def _recent(imu: ImuBatch) -> ImuBatch:
    """Return the samples that are averaged, of one or more."""
    return imu.take(imu.stamps_ns >= imu.stamps_ns[-1] - round(_AVERAGING_S * 1e9))


def rest_contradicts(bias: ImuBias, imu: ImuBatch, config: InertialConfig) -> bool:
    """Return whether the newest of these samples are of a body at rest, and inconsistent with the bias: of
    another IMU, or before a new calibration."""
    if not len(imu):
        return False
    recent, g = _recent(imu), config.gravity
    if not _is_still(recent.gyro, recent.accel):
        return False
    force, rate = recent.accel.mean(axis=0), recent.gyro.mean(axis=0)
    rate_nis = ((rate - bias.gyro) ** 2).sum() / (bias.gyro_sigma**2 + _STILL_RATE_SIGMA**2)
    force_nis = (np.linalg.norm(force - bias.accel) - g) ** 2 / (bias.accel_sigma**2 + _STILL_FORCE_SIGMA**2)
    return bool(rate_nis > _RATE_GATE or force_nis > _FORCE_GATE)


def _initial_sigmas(is_still: bool, bias: ImuBias) -> F64:
    out = np.zeros(CORE_SIZE)
    out[0:2], out[2:6] = UNKNOWN_TILT_RAD, _GAUGE_SIGMA
    out[VELOCITY] = _STILL_SPEED_SIGMA if is_still else _MOVING_SPEED_SIGMA
    out[GYRO_BIAS], out[ACCEL_BIAS] = bias.gyro_sigma, bias.accel_sigma
    out[EXTRINSIC][:3], out[EXTRINSIC][3:] = EXTRINSIC_SIGMA_RAD, EXTRINSIC_SIGMA_M
    out[TIMESHIFT] = _TIMESHIFT_SIGMA_S
    return out


def _update_with_force(state: FilterState, force: F64, sigma: float, g: float) -> None:
    """Update with mean specific force = R' g + bias; tilt and accelerometer bias become correlated."""
    z = np.array([0.0, 0.0, g])
    Rt = state.T[:3, :3].T
    H = np.zeros((3, state.size))
    H[:, POSE][:, :3], H[:, ACCEL_BIAS] = Rt @ se3.hat(z), np.eye(3)
    filter.isotropic_update(state, force - Rt @ z - state.ba, H, sigma)


def update_with_force_in_motion(state: FilterState, force: F64, g: float) -> None:
    """Update with the mean force (3,) of samples of a body that may be in motion."""
    _update_with_force(state, force, _MOVING_FORCE_SIGMA, g)


def _update_with_rate(state: FilterState, rate: F64) -> None:
    H = np.zeros((3, state.size))
    H[:, GYRO_BIAS] = np.eye(3)
    filter.isotropic_update(state, rate - state.bg, H, _STILL_RATE_SIGMA)


# Convergence: when the state suffices for a first pose, and its biases are worth storing.

_MAX_TILT_SIGMA_RAD = np.radians(3.0)
_MAX_SPEED_SIGMA_M_S = 0.3
_MAX_TILT_DRIFT_M_S = 0.03  # drift by the uncertain tilt; with more, the first pose waits
_MAX_TILT_WAIT_S = 0.9  # that it waits at most
_LEARNT_SIGMA_RATIO = 0.3  # of an unknown bias's sigma


def tilt_sigma(s: FilterState, columns: slice = POSE) -> float:
    """Return the sigma, rad, of the up direction of the pose with these columns."""
    return float(np.sqrt(s.cov[columns.start, columns.start] + s.cov[columns.start + 1, columns.start + 1]))


def has_converged(s: FilterState) -> bool:
    """Return whether tilt and velocity are known; an accelerometer bias of `accel_bias` alone leaves 2.5
    degrees."""
    return tilt_sigma(s) < _MAX_TILT_SIGMA_RAD and bool(
        np.sqrt(np.trace(s.cov[VELOCITY, VELOCITY])) < _MAX_SPEED_SIGMA_M_S
    )


def is_publishable(s: FilterState, waited_s: float, new_segment: bool) -> bool:
    """Return whether a first pose can be published, `waited_s` after the filter began. new_segment: odom
    begins with it.

    A body at rest gets its pose at once. The path of a moving body would climb or sink by a tilt that is
    taken for a bias. Rotation separates the two, mostly within a second, so its pose waits for that; for a
    body that moves straight on, `_MAX_TILT_WAIT_S`.
    """
    drifts = tilt_sigma(s) * np.linalg.norm(s.v) > _MAX_TILT_DRIFT_M_S
    return has_converged(s) and not (drifts and new_segment and waited_s < _MAX_TILT_WAIT_S)


def waiting_for(s: FilterState) -> WaitReason:
    """Return what the first pose waits for."""
    return (
        WaitReason.SPEED if tilt_sigma(s) < _MAX_TILT_SIGMA_RAD and not has_converged(s) else WaitReason.TILT
    )


def estimated_bias(s: FilterState, config: InertialConfig) -> ImuBias | None:
    """Return the estimated bias; None where it is hardly better known than at the start, or implausible."""
    gyro, accel = (
        float(np.sqrt(np.diag(s.cov[columns, columns]).max())) for columns in (GYRO_BIAS, ACCEL_BIAS)
    )
    if not (
        accel < _LEARNT_SIGMA_RATIO * config.accel_bias and gyro < _LEARNT_SIGMA_RATIO * config.gyro_bias
    ):
        return None
    try:
        return ImuBias(s.bg.copy(), s.ba.copy(), gyro, accel)
    except ValueError:
        return None


def align_to_gravity(up: F64, forward: F64) -> F64:
    """Return T_odom_body (4, 4) at the origin with `up` along z and `forward` as near to x as possible.

    up, forward: (3,) in the body frame, not parallel.
    """
    z = up / np.linalg.norm(up)
    x = forward - (forward @ z) * z
    if np.linalg.norm(x) < 1e-3:  # looking straight up or down: any heading will do
        x = np.eye(3)[np.argmin(np.abs(z))]
        x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return from_rt(np.stack([x, np.cross(z, x), z]), np.zeros(3))
