"""A path that a real IMU took, known at every instant by a batch fit of IMU and motion capture
(`share.lab.mocap.path`), and placed in a room."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from share.lab.mocap.factors import interpolate_samples
from share.lab.mocap.fit import MocapFit
from share.lab.mocap.path import FittedPath
from share.types import F64, I64, ImuBatch


@dataclass(frozen=True, eq=False)
class RecordedPath:
    """A `MotionPath` from start_ns to end_ns, within the nodes of `fit`.

    imu: the fitted samples, which reach beyond the span. T_world_fit (4, 4): pose of the fit's world.
    """

    fit: MocapFit
    imu: ImuBatch
    start_ns: int
    end_ns: int
    T_world_fit: F64

    @property
    def gaps(self) -> I64:
        """Return (G, 2) ns: gaps of the motion capture too long to bridge by the IMU."""
        gaps = self.fit.gaps
        keep = (gaps[:, 1] > self.start_ns) & (gaps[:, 0] < self.end_ns)
        return gaps[keep].clip(self.start_ns, self.end_ns)

    @cached_property
    def recorded(self) -> ImuBatch:
        """Return the IMU's samples within the span, as recorded."""
        keep = (self.imu.stamps_ns >= self.start_ns) & (self.imu.stamps_ns <= self.end_ns)
        return self.imu.take(keep)

    def poses(self, stamps_ns: I64) -> F64:
        """Return T_world_body (N, 4, 4). Raises ValueError outside the span."""
        return self.T_world_fit @ self._pose_and_velocity(stamps_ns)[0]

    def velocity(self, stamps_ns: I64) -> F64:
        """Return the body's velocity in the world (N, 3) m/s. Raises ValueError outside the span."""
        return np.asarray(self._pose_and_velocity(stamps_ns)[1] @ self.T_world_fit[:3, :3].T, np.float64)

    def inertial(self, stamps_ns: I64) -> tuple[F64, F64]:
        """Return angular rate (N, 3) rad/s and specific force (N, 3) m/s^2 as recorded less the biases,
        linear between samples, so with the real IMU's noise. Raises ValueError outside the span."""
        stamps = self._checked_stamps(stamps_ns)
        gyro, accel = (
            interpolate_samples(self.imu, stamps, self.imu.gyro),
            interpolate_samples(self.imu, stamps, self.imu.accel),
        )
        nodes = ImuBatch(self.fit.stamps_ns, self.fit.gyro_bias, self.fit.accel_bias)
        return gyro - interpolate_samples(nodes, stamps, nodes.gyro), accel - interpolate_samples(
            nodes, stamps, nodes.accel
        )

    def transformed(self, T_world_old: F64) -> RecordedPath:
        """Return the same motion turned about the vertical and shifted by T_world_old (4, 4). Raises
        ValueError if that would tilt gravity."""
        if not np.allclose(T_world_old[2, :3], (0, 0, 1), atol=1e-9):
            raise ValueError("T_world_old: turns about more than the vertical")
        return replace(self, T_world_fit=T_world_old @ self.T_world_fit)

    def cut(self, start_ns: int, end_ns: int) -> RecordedPath:
        """Return the motion between two stamps of the same clock. Raises ValueError outside the span."""
        if not self.start_ns <= start_ns < end_ns <= self.end_ns:
            raise ValueError(f"{start_ns} .. {end_ns} ns: is not within {self.start_ns} .. {self.end_ns} ns")
        return replace(self, start_ns=start_ns, end_ns=end_ns)

    def _checked_stamps(self, stamps_ns: I64) -> I64:
        stamps = np.asarray(stamps_ns, np.int64)
        if len(stamps) and not self.start_ns <= stamps.min() <= stamps.max() <= self.end_ns:
            raise ValueError(
                f"stamps {stamps.min()} .. {stamps.max()} ns: "
                f"the path spans {self.start_ns} .. {self.end_ns} ns"
            )
        return stamps

    @cached_property
    def _fitted_path(self) -> FittedPath:
        return FittedPath(self.fit, self.imu)

    def _pose_and_velocity(self, stamps_ns: I64) -> tuple[F64, F64]:
        """Return T_fit_body (N, 4, 4) and velocity (N, 3) in the fit's world."""
        return self._fitted_path.pose_and_velocity(self._checked_stamps(stamps_ns))
