"""Which way is up, from an accelerometer that is nearly at rest."""

from __future__ import annotations

import numpy as np

from share.geometry.se3 import compose
from share.types import F64, ImuBatch

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
