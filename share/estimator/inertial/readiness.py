"""When a filter that has begun knows enough: for a first pose, and for its biases to be remembered."""

from __future__ import annotations

import numpy as np

from share.config import InertialConfig
from share.estimator.inertial.state import ACCEL_BIAS, GYRO_BIAS, POSE, VELOCITY, State
from share.geometry.camera import ImuBias
from share.types import Wait

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
