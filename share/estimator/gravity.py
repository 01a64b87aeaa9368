"""Which way is up, from an accelerometer that is nearly at rest."""

from __future__ import annotations

import numpy as np

from share.geometry.se3 import compose
from share.types import F64, ImuBatch

STANDARD_GRAVITY = 9.80665  # m/s^2


class AtRest:
    """Mean specific force over the first samples; believed if its size is gravity's."""

    def __init__(self, samples: int = 20, tolerance: float = 0.05, patience: int = 10) -> None:
        self._samples, self._tolerance, self._patience = samples, tolerance, patience
        self._sum = np.zeros(3)
        self._count = 0
        self._frames = 0

    @property
    def gave_up(self) -> bool:
        """The IMU stayed silent, or its mean is not gravity: begin without knowing up."""
        return self._frames >= self._patience

    def add(self, imu: ImuBatch) -> F64 | None:
        """Unit vector up in the body frame (3,) once it is known, else None."""
        self._sum += imu.accel.sum(axis=0)
        self._count += len(imu)
        self._frames += 1
        if self._count < self._samples:
            return None
        mean = self._sum / self._count
        size = float(np.linalg.norm(mean))
        if abs(size - STANDARD_GRAVITY) > self._tolerance * STANDARD_GRAVITY:
            return None
        return mean / size


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
