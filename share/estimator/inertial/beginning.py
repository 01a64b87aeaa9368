"""A first state from nothing but IMU samples: at rest or in motion, as sure as these allow.

There is no start-up of its own. The filter's errors are right-invariant, so it converges from a tilt of
tens of degrees and a velocity of metres a second (Barrau & Bonnabel 2017).
"""

from __future__ import annotations

import numpy as np

from share.config import InertialConfig
from share.estimator import gravity
from share.estimator.inertial import ekf
from share.estimator.inertial.state import (
    ACCEL_BIAS,
    CORE,
    EXTRINSIC,
    GYRO_BIAS,
    OFFSET,
    POSE,
    VELOCITY,
    State,
    begin,
)
from share.geometry import se3
from share.geometry.camera import ImuBias, Rig
from share.types import F64, ImuBatch

SHORTEST_S = 0.05  # of IMU samples
_AVERAGED_S = 0.5
_UNKNOWN_TILT, _SAME = 1.0, 1e-4  # rad; of what defines odom
_STILL_M_S, _WALKING_M_S = 0.1, 1.0  # velocity that is not there, or may be
_STILL_SHAKE, _STILL_TURN = 0.15, 0.05  # m/s^2, rad/s: standard deviation and mean of a body at rest
_SHAKE, _WALKING = 0.03, 1.5  # m/s^2, what a mean force has beside gravity and bias
_TREMOR = 0.005  # rad/s, the same of a mean rate
_TURN_GATE, _FORCE_GATE = 16.3, 10.8  # chi-square, 3 and 1 degrees of freedom, 0.1 %


def first_state(
    stamp_ns: int, imu: ImuBatch, rig: Rig, config: InertialConfig, bias: ImuBias
) -> State | None:
    """Body at odom's origin, z up, at the time of the last samples; None before there are enough. bias: as it
    is known before; it is left aside where samples at rest contradict it."""
    if len(imu) < 2 or (imu.stamps_ns[-1] - imu.stamps_ns[0]) < SHORTEST_S * 1e9:
        return None
    recent = imu.stamps_ns >= imu.stamps_ns[-1] - round(_AVERAGED_S * 1e9)
    gyro, accel = imu.gyro[recent], imu.accel[recent]
    force, rate = accel.mean(axis=0), gyro.mean(axis=0)
    still = _still(gyro, accel)
    if still and _contradicted(bias, force, rate, config.gravity):
        bias = unknown_bias(config)
    T = gravity.level(force - bias.accel, rig.T_body_cam0[:3, 2])
    state = _begun(stamp_ns, T, rig, bias, _sigmas(still, bias, config))
    _learn_force(state, force, _SHAKE if still else _WALKING, config.gravity)
    if still:
        _learn_rate(state, rate)
    return state


def state_by_camera(stamp_ns: int, rig: Rig, config: InertialConfig, bias: ImuBias) -> State:
    """For a body whose IMU says nothing: up is where the top of the image is, more or less."""
    up = rig.T_body_cam0[:3, :3] @ np.array([0.0, -1.0, 0.0])
    T = gravity.level(up, rig.T_body_cam0[:3, 2])
    sigma = _sigmas(False, bias, config)
    sigma[0:2] = _SAME  # a body that coasts tells nothing of gravity
    return _begun(stamp_ns, T, rig, bias, sigma)


def unknown_bias(config: InertialConfig) -> ImuBias:
    """Of an IMU that nobody knows."""
    return ImuBias(np.zeros(3), np.zeros(3), config.gyro_bias, config.accel_bias)


def _begun(stamp_ns: int, T: F64, rig: Rig, bias: ImuBias, sigma: F64) -> State:
    """When the image with this stamp was taken, by the IMU's clock."""
    at_ns = stamp_ns + rig.timeshift_ns
    state = begin(at_ns, T, np.zeros(3), bias.gyro, bias.accel, rig.T_body_cam0, sigma)
    state.offset_s = rig.timeshift_s
    return state


def _still(gyro: F64, accel: F64) -> bool:
    turn = np.linalg.norm(gyro.mean(axis=0)) + np.linalg.norm(gyro.std(axis=0))
    return bool(turn < _STILL_TURN and np.linalg.norm(accel.std(axis=0)) < _STILL_SHAKE)


def _contradicted(bias: ImuBias, force: F64, rate: F64, g: float) -> bool:
    """Whether the mean force and rate (3,) of a body at rest cannot come of this bias: the IMU is another by
    now, or was calibrated since."""
    turn = ((rate - bias.gyro) ** 2).sum() / (bias.gyro_sigma**2 + _TREMOR**2)
    weight = (np.linalg.norm(force - bias.accel) - g) ** 2 / (bias.accel_sigma**2 + _SHAKE**2)
    return bool(turn > _TURN_GATE or weight > _FORCE_GATE)


def _sigmas(still: bool, bias: ImuBias, config: InertialConfig) -> F64:
    out = np.zeros(CORE)
    out[0:2], out[2:6] = _UNKNOWN_TILT, _SAME
    out[VELOCITY] = _STILL_M_S if still else _WALKING_M_S
    out[GYRO_BIAS], out[ACCEL_BIAS] = bias.gyro_sigma, bias.accel_sigma
    out[EXTRINSIC][:3], out[EXTRINSIC][3:] = config.extrinsic_rad, config.extrinsic_m
    out[OFFSET] = config.offset_s
    return out


def _learn_force(state: State, force: F64, sigma: float, g: float) -> None:
    """Mean specific force = R' g + bias: a tilt and a bias that look alike are tied to each other."""
    z = np.array([0.0, 0.0, g])
    Rt = state.T[:3, :3].T
    H = np.zeros((3, state.size))
    H[:, POSE][:, :3], H[:, ACCEL_BIAS] = Rt @ se3.hat(z), np.eye(3)
    ekf.learn(state, force - Rt @ z - state.ba, H, sigma)


def _learn_rate(state: State, rate: F64) -> None:
    H = np.zeros((3, state.size))
    H[:, GYRO_BIAS] = np.eye(3)
    ekf.learn(state, rate - state.bg, H, _TREMOR)
