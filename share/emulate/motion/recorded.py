"""A path that a real IMU took, from the batch fit of it and a motion capture: known at every instant.

Between two nodes the path is the IMU's own, freed of its bias, from the node before; what it misses
the node after by, in place and in speed, is spread over the way by a cubic (Hermite), so that the path
and its velocity are continuous and still shake as the IMU shook.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from share.geometry import se3
from share.mocap.fit import Fit
from share.mocap.preintegrate import preintegrate, sampled
from share.types import F64, I64, ImuBatch


@dataclass(frozen=True, eq=False)
class RecordedPath:
    """A `Path` (share.emulate.types) from start_ns to end_ns, within the nodes of `fit`.

    imu: the samples that were fitted, which reach beyond the span. T_world_fit (4, 4): where the fit's
    world lies in the path's.
    """

    fit: Fit
    imu: ImuBatch
    start_ns: int
    end_ns: int
    T_world_fit: F64

    @property
    def gaps(self) -> I64:
        """(G, 2) ns: where the motion capture was blind for longer than the IMU is trusted alone."""
        gaps = self.fit.gaps
        keep = (gaps[:, 1] > self.start_ns) & (gaps[:, 0] < self.end_ns)
        return gaps[keep].clip(self.start_ns, self.end_ns)

    @cached_property
    def recorded(self) -> ImuBatch:
        """The IMU's samples within the span, untouched."""
        keep = (self.imu.stamps_ns >= self.start_ns) & (self.imu.stamps_ns <= self.end_ns)
        return self.imu.take(keep)

    def poses(self, stamps_ns: I64) -> F64:
        """T_world_body (N, 4, 4). Raises ValueError outside the span."""
        return self.T_world_fit @ self._moving(stamps_ns)[0]

    def velocity(self, stamps_ns: I64) -> F64:
        """Of the body in the world (N, 3) m/s. Raises ValueError outside the span."""
        return np.asarray(self._moving(stamps_ns)[1] @ self.T_world_fit[:3, :3].T, np.float64)

    def inertial(self, stamps_ns: I64) -> tuple[F64, F64]:
        """Angular rate (N, 3) rad/s and specific force (N, 3) m/s^2 as recorded, freed of their biases,
        linear between samples: the real IMU's noise is in them. Raises ValueError outside the span."""
        stamps = self._within(stamps_ns)
        gyro, accel = sampled(self.imu, stamps, self.imu.gyro), sampled(self.imu, stamps, self.imu.accel)
        nodes = ImuBatch(self.fit.stamps_ns, self.fit.gyro_bias, self.fit.accel_bias)
        return gyro - sampled(nodes, stamps, nodes.gyro), accel - sampled(nodes, stamps, nodes.accel)

    def placed(self, T_world_old: F64) -> RecordedPath:
        """The same motion elsewhere: turned about the vertical and shifted by T_world_old (4, 4).
        Raises ValueError if it would tilt gravity."""
        if not np.allclose(T_world_old[2, :3], (0, 0, 1), atol=1e-9):
            raise ValueError("T_world_old: turns about more than the vertical")
        return replace(self, T_world_fit=T_world_old @ self.T_world_fit)

    def part(self, start_ns: int, end_ns: int) -> RecordedPath:
        """The same motion between two stamps, which keep their meaning. Raises ValueError outside."""
        if not self.start_ns <= start_ns < end_ns <= self.end_ns:
            raise ValueError(f"{start_ns} .. {end_ns} ns: is not within {self.start_ns} .. {self.end_ns} ns")
        return replace(self, start_ns=start_ns, end_ns=end_ns)

    def _within(self, stamps_ns: I64) -> I64:
        stamps = np.asarray(stamps_ns, np.int64)
        if len(stamps) and not self.start_ns <= stamps.min() <= stamps.max() <= self.end_ns:
            raise ValueError(
                f"stamps {stamps.min()} .. {stamps.max()} ns: "
                f"the path spans {self.start_ns} .. {self.end_ns} ns"
            )
        return stamps

    def _moving(self, stamps_ns: I64) -> tuple[F64, F64]:
        """T_fit_body (N, 4, 4) and velocity (N, 3) in the fit's world."""
        stamps, fit = self._within(stamps_ns), self.fit
        i = np.clip(np.searchsorted(fit.stamps_ns, stamps, "right") - 1, 0, len(fit.stamps_ns) - 2)
        span = (fit.stamps_ns[i + 1] - fit.stamps_ns[i])[:, None] * 1e-9
        s = (stamps - fit.stamps_ns[i])[:, None] * 1e-9 / span
        T, v = self._carried(i, np.where(fit.breaks[i], fit.stamps_ns[i], stamps))
        turn, miss, miss_v = (e[i] for e in self._missed)
        R = T[:, :3, :3] @ se3.so3_exp((3 - 2 * s) * s**2 * turn)
        p = T[:, :3, 3] + (3 - 2 * s) * s**2 * miss + (s - 1) * s**2 * span * miss_v
        return se3.compose(R, p), v + 6 * s * (1 - s) * miss / span + (3 * s - 2) * s * miss_v

    @cached_property
    def _missed(self) -> tuple[F64, F64, F64]:
        """By how much every node is missed from the one before: rotation rad (N - 1, 3) at the right,
        position m and velocity m/s in the fit's world. Across a break nothing is carried, only closed."""
        fit = self.fit
        i = np.arange(len(fit.stamps_ns) - 1)
        T, v = self._carried(i, np.where(fit.breaks, fit.stamps_ns[:-1], fit.stamps_ns[1:]))
        turn = se3.so3_log(T[:, :3, :3].swapaxes(1, 2) @ fit.T_world_body[1:, :3, :3])
        return turn, fit.T_world_body[1:, :3, 3] - T[:, :3, 3], fit.velocity[1:] - v

    def _carried(self, node: I64, stamps_ns: I64) -> tuple[F64, F64]:
        """Pose (N, 4, 4) and velocity (N, 3) at stamps by the IMU alone, from the nodes given."""
        fit = self.fit
        inc = preintegrate(
            self.imu, fit.stamps_ns[node], stamps_ns, fit.gyro_bias[node], fit.accel_bias[node]
        )
        T0, v0, t = fit.T_world_body[node], fit.velocity[node], inc.dt[:, None]
        g = np.array([0.0, 0.0, -fit.gravity])
        R0 = T0[:, :3, :3]
        p = T0[:, :3, 3] + v0 * t + g * t**2 / 2 + (R0 @ inc.dp[..., None])[..., 0]
        return se3.compose(R0 @ inc.dR, p), v0 + g * t + (R0 @ inc.dv[..., None])[..., 0]
