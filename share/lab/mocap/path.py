"""The fitted path between its nodes.

Between two nodes the path is the IMU's bias-corrected motion from the node before. Its error in position and
velocity at the node after is spread over the interval by a cubic (Hermite), so that path and velocity are
continuous and keep the IMU's vibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from share.geometry import se3
from share.lab.mocap.factors import preintegrate, propagate
from share.lab.mocap.fit import MocapFit
from share.types import F64, I64, ImuBatch


@dataclass(frozen=True, eq=False)
class FittedPath:
    """The path of `fit` at any stamp within its nodes. imu: the samples that were fitted."""

    fit: MocapFit
    imu: ImuBatch

    def pose_and_velocity(self, stamps_ns: I64) -> tuple[F64, F64]:
        """Return T_world_body (N, 4, 4) and velocity (N, 3) m/s, in the fit's world, at stamps within the
        nodes."""
        stamps, fit = stamps_ns, self.fit
        i = np.clip(np.searchsorted(fit.stamps_ns, stamps, "right") - 1, 0, len(fit.stamps_ns) - 2)
        span = (fit.stamps_ns[i + 1] - fit.stamps_ns[i])[:, None] * 1e-9
        s = (stamps - fit.stamps_ns[i])[:, None] * 1e-9 / span
        T, v = self._propagate(i, np.where(fit.is_break[i], fit.stamps_ns[i], stamps))
        rotation_error, position_error, velocity_error = (e[i] for e in self._node_errors)
        R = T[:, :3, :3] @ se3.so3_exp((3 - 2 * s) * s**2 * rotation_error)
        p = T[:, :3, 3] + (3 - 2 * s) * s**2 * position_error + (s - 1) * s**2 * span * velocity_error
        return se3.from_rt(R, p), v + 6 * s * (1 - s) * position_error / span + (
            3 * s - 2
        ) * s * velocity_error

    @cached_property
    def _node_errors(self) -> tuple[F64, F64, F64]:
        """Errors of every node's prediction from the one before: rotation rad (N - 1, 3) on the right,
        position m and velocity m/s in the fit's world. Across a break there is no prediction, only the
        difference."""
        fit = self.fit
        i = np.arange(len(fit.stamps_ns) - 1)
        T, v = self._propagate(i, np.where(fit.is_break, fit.stamps_ns[:-1], fit.stamps_ns[1:]))
        rotation_error = se3.so3_log(T[:, :3, :3].swapaxes(1, 2) @ fit.T_world_body[1:, :3, :3])
        return rotation_error, fit.T_world_body[1:, :3, 3] - T[:, :3, 3], fit.velocity[1:] - v

    def _propagate(self, node: I64, stamps_ns: I64) -> tuple[F64, F64]:
        """Return pose (N, 4, 4) and velocity (N, 3) at stamps by the IMU alone, from the given nodes."""
        fit = self.fit
        inc = preintegrate(
            self.imu, fit.stamps_ns[node], stamps_ns, fit.gyro_bias[node], fit.accel_bias[node]
        )
        T = fit.T_world_body[node]
        R, p, v = propagate(T[:, :3, :3], T[:, :3, 3], fit.velocity[node], inc, fit.gravity)
        return se3.from_rt(R, p), v
