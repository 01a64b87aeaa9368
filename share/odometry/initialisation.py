"""A first state from nothing but IMU samples: at rest or in motion, as sure as these allow.

There is no start-up of its own. The filter's errors are right-invariant, so it converges from a tilt of
tens of degrees and a velocity of metres a second (Barrau & Bonnabel 2017).
"""

from __future__ import annotations

import numpy as np

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import ImuBias, Rig
from share.geometry.se3 import compose
from share.odometry import filter
from share.odometry.state import ACCEL_BIAS, CORE, EXTRINSIC, GYRO_BIAS, OFFSET, POSE, VELOCITY, State, begin
from share.types import F64, ImuBatch, Wait

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
    T = level(force - bias.accel, rig.T_body_cam0[:3, 2])
    state = _begun(stamp_ns, T, rig, bias, _sigmas(still, bias, config))
    _learn_force(state, force, _SHAKE if still else _WALKING, config.gravity)
    if still:
        _learn_rate(state, rate)
    return state


def state_by_camera(stamp_ns: int, rig: Rig, config: InertialConfig, bias: ImuBias) -> State:
    """For a body whose IMU says nothing: up is where the top of the image is, more or less."""
    up = rig.T_body_cam0[:3, :3] @ np.array([0.0, -1.0, 0.0])
    T = level(up, rig.T_body_cam0[:3, 2])
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
    filter.learn(state, force - Rt @ z - state.ba, H, sigma)


def _learn_rate(state: State, rate: F64) -> None:
    H = np.zeros((3, state.size))
    H[:, GYRO_BIAS] = np.eye(3)
    filter.learn(state, rate - state.bg, H, _TREMOR)


# ---- When a filter that has begun knows enough: for a first pose, and for its biases to be remembered.

_TILT_RAD, _SPEED_M_S = np.radians(3.0), 0.3  # sigmas
_CARRIED_M_S, _CARRIED_S = 0.03, 0.9  # a tilt carries nobody off faster than this; or he has waited so long
_LEARNT = 0.3  # of the sigma that a bias has which nobody knows


def tilt(s: State, at: slice = POSE) -> float:
    """Sigma of what is up, rad; of the pose that has these columns."""
    return float(np.sqrt(s.cov[at.start, at.start] + s.cov[at.start + 1, at.start + 1]))


def converged(s: State) -> bool:
    """Tilt and velocity are known; a bias of the accelerometer alone (`accel_bias`) leaves 2.5 degrees."""
    return tilt(s) < _TILT_RAD and bool(np.sqrt(np.trace(s.cov[VELOCITY, VELOCITY])) < _SPEED_M_S)


def worth_telling(s: State, waited_s: float, anew: bool) -> bool:
    """Whether a first pose is, `waited_s` after the filter began; anew: so does odom.

    Who begins at rest is told it at once. Who begins at a run would be told a path that climbs or sinks by
    the tilt that a bias looks like, until turning has parted the two: mostly within a second, for which he
    is made to wait. One who goes straight on is told then.
    """
    carried = tilt(s) * np.linalg.norm(s.v) > _CARRIED_M_S
    return converged(s) and not (carried and anew and waited_s < _CARRIED_S)


def waits_for(s: State) -> Wait:
    """What a pose that is not told yet waits for."""
    return Wait.SPEED if tilt(s) < _TILT_RAD and not converged(s) else Wait.TILT


def learnt_bias(s: State, config: InertialConfig) -> ImuBias | None:
    """Of the IMU; None where the filter knows hardly more of it than when it began, or what no IMU has."""
    gyro, accel = (float(np.sqrt(np.diag(s.cov[at, at]).max())) for at in (GYRO_BIAS, ACCEL_BIAS))
    if not (accel < _LEARNT * config.accel_bias and gyro < _LEARNT * config.gyro_bias):
        return None
    try:
        return ImuBias(s.bg.copy(), s.ba.copy(), gyro, accel)
    except ValueError:
        return None


# ---- Which way is up, from an accelerometer that is nearly at rest.

STANDARD_GRAVITY = 9.80665  # m/s^2
LEAST, NEWEST = 20, 60  # samples by which rest is judged
KEPT = 200  # samples that a guess in motion is averaged over
SIZE_TOLERANCE = 0.08  # of gravity; the zero of an uncalibrated BMI055, a D435i's, is up to 0.07 off
MAX_SHAKE = 0.6  # m/s^2, standard deviation: a headset worn by somebody who stands, motors idling
MAX_TURN = 0.15  # rad/s
SIGMA_RAD = float(np.radians(3.0))  # of up, for as long as nothing corrects it


class AtRest:
    """The mean specific force is up, if the body turns little, shakes little, and its size is gravity's.

    A body that starts in motion measures its own acceleration too: 1 m/s^2 tilts "up" by 6 degrees.
    """

    def __init__(self, patience: int = 10) -> None:
        self._patience = patience
        self._imu = np.zeros((0, 6))  # gyro, accel of the newest samples
        self._frames = 0

    @property
    def gave_up(self) -> bool:
        """The IMU stayed silent, or the body was never at rest: begin without knowing up."""
        return self._frames >= self._patience

    def add(self, imu: ImuBatch) -> F64 | None:
        """Unit vector up in the body frame (3,) once it is known, else None."""
        self._imu = np.concatenate([self._imu, np.hstack([imu.gyro, imu.accel])])[-KEPT:]
        self._frames += 1
        newest = self._imu[-NEWEST:]
        return _direction(newest) if len(newest) >= LEAST and _at_rest(newest) else None

    def guess(self) -> F64 | None:
        """The direction of the mean specific force, at rest or not; None with too few samples."""
        return _direction(self._imu) if len(self._imu) >= LEAST else None


def _at_rest(imu: F64) -> bool:
    size = np.linalg.norm(imu[:, 3:].mean(axis=0))
    shake = np.linalg.norm(imu[:, 3:].std(axis=0))
    turn = np.linalg.norm(imu[:, :3].mean(axis=0))
    right_size = abs(size - STANDARD_GRAVITY) < SIZE_TOLERANCE * STANDARD_GRAVITY
    return bool(right_size and shake < MAX_SHAKE and turn < MAX_TURN)


def _direction(imu: F64) -> F64 | None:
    """Unit mean of the accelerations in (N, 6); None in free fall."""
    mean = imu[:, 3:].mean(axis=0)
    size = float(np.linalg.norm(mean))
    return mean / size if size > 0.5 * STANDARD_GRAVITY else None


def level(up: F64, forward: F64) -> F64:
    """T_odom_body (4, 4) at the origin with `up` along z and `forward` as near to x as that allows.

    up, forward: (3,) in the body frame, not parallel.
    """
    z = up / np.linalg.norm(up)
    x = forward - (forward @ z) * z
    if np.linalg.norm(x) < 1e-3:  # looking straight up or down: any heading will do
        x = np.eye(3)[np.argmin(np.abs(z))]
        x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return compose(np.stack([x, np.cross(z, x), z]), np.zeros(3))
