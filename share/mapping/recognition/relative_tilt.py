"""What two accelerometers know of the rotation between two cameras: which way is up in either.

A person and a robot see the same surfaces from other heights, few of them, and mostly from afar: a tilt then
looks nearly like a height. Both tilts are known from gravity to a tenth of a degree, so the images have to
tell four of the six degrees of freedom only. Where images contradict, a camera may sit on its IMU otherwise
than is said: then they decide alone, so that the loop tells of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from share.geometry import se3
from share.types import F64

_CONTRADICT_CHI2 = 9.0  # of the angle between both directions
_FLOOR_RAD = float(np.radians(0.1))  # of either: no camera is calibrated to its IMU better


class Upright(Protocol):
    """A camera with the direction against gravity.

    T_body_cam0 (4, 4); up (3,): in the body frame, zeros if unknown; up_sigma: of both its angles, rad.
    """

    @property
    def T_body_cam0(self) -> F64: ...

    @property
    def up(self) -> F64: ...

    @property
    def up_sigma(self) -> float: ...


@dataclass(frozen=True, eq=False)
class RelativeTilt:
    """up_q, up_c (3,): unit vectors against gravity in the frames of two cameras; zeros: unknown. sigma: of
    the angle between them after rotation, rad."""

    up_q: F64
    up_c: F64
    sigma: float

    @staticmethod
    def between(query: Upright, candidate: Upright) -> RelativeTilt:
        """Return what is known of two cameras: nothing where either direction is unknown."""
        if not (query.up.any() and candidate.up.any()):
            return UNKNOWN_TILT
        up_q, up_c = (
            one.T_body_cam0[:3, :3].T @ (one.up / np.linalg.norm(one.up)) for one in (query, candidate)
        )
        variance = query.up_sigma**2 + candidate.up_sigma**2 + 2 * _FLOOR_RAD**2
        return RelativeTilt(up_q, up_c, float(np.sqrt(variance)))

    def contradicts(self, T_c_q: F64) -> bool:
        """Return whether a pose that was fitted to images and tilts is still three sigma from these."""
        difference = (self.up_c - T_c_q[:3, :3] @ self.up_q) / self.sigma
        return bool(difference @ difference > _CONTRADICT_CHI2)

    def equations(self, T_c_q: F64) -> tuple[F64, F64]:
        """Information (6, 6) and gradient (6,) of Exp(xi) T_c_q at xi = 0: xi solves H xi = g."""
        predicted = T_c_q[:3, :3] @ self.up_q
        J = -se3.hat(predicted) / self.sigma
        H, g = np.zeros((6, 6)), np.zeros(6)
        H[:3, :3], g[:3] = J.T @ J, J.T @ ((self.up_c - predicted) / self.sigma)
        return H, g


UNKNOWN_TILT = RelativeTilt(np.zeros(3), np.zeros(3), 1.0)
