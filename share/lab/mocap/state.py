"""The unknowns of the fit: the body at every node, and the relation of mocap and IMU; and the fit's
options."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.types import F64, I64

NODE_SIZE = 15  # rotation, position, velocity, gyro bias, accel bias
SHARED_SIZE = 10  # tilt, mocap body's rotation and position, time offset and drift


@dataclass(frozen=True, eq=False)
class MocapImuState:
    """Nodes at stamps_ns (N,), IMU clock: R (N, 3, 3), p (N, 3) m, v (N, 3) m/s of the body in the levelled
    world, biases (N, 3).

    tilt (2,): R_mocap_world = Exp(tilt_x, tilt_y, 0), without rotation about the vertical. T_body_mocap (4,
    4). offset_s: IMU clock minus mocap clock at middle_ns, after the coarse offset was removed; drift: its
    growth, seconds a second.
    """

    stamps_ns: I64
    R: F64
    p: F64
    v: F64
    gyro_bias: F64
    accel_bias: F64
    tilt: F64
    T_body_mocap: F64
    middle_ns: int
    offset_s: float = 0.0
    drift: float = 0.0

    def in_imu_clock(self, stamps_ns: I64) -> I64:
        """Return mocap stamps (K,), coarse offset removed, in the IMU's clock."""
        shift_ns = self.offset_s * 1e9 + self.drift * (stamps_ns - self.middle_ns)
        return np.asarray(stamps_ns + np.round(shift_ns).astype(np.int64), np.int64)

    @property
    def R_mocap_world(self) -> F64:
        return se3.so3_exp(np.append(self.tilt, 0.0))

    def updated(self, nodes: F64, shared: F64) -> MocapImuState:
        """Return the state after a step. nodes (N, 15): rotations on the right, the others added. shared
        (10,): tilt added, T_body_mocap perturbed on the right, offset [s] and drift added."""
        return MocapImuState(
            self.stamps_ns,
            self.R @ se3.so3_exp(nodes[:, :3]),
            self.p + nodes[:, 3:6],
            self.v + nodes[:, 6:9],
            self.gyro_bias + nodes[:, 9:12],
            self.accel_bias + nodes[:, 12:15],
            self.tilt + shared[:2],
            self.T_body_mocap @ se3.exp(shared[2:8]),
            self.middle_ns,
            self.offset_s + float(shared[8]),
            self.drift + float(shared[9]),
        )


@dataclass(frozen=True, eq=False)
class MocapFitOptions:
    """Options of a fit.

    * sigma_position m, sigma_rotation rad: noise of mocap samples with independent errors at independent_hz;
      denser samples get less weight each.
    * imu_inflation: factor on the data sheet's noise.
    * within_s: largest offset of the clocks, None for any, 0 for one clock. offset_sigma s: of the offset
      after that. drift_sigma: of the clocks' relative rate (1e-4: 100 ppm).
    * T_body_mocap (4, 4): a guess, needed only for a body that turns about one axis; with guess_sigma (rad,
      m).
    * gravity m/s^2. max_bridged_s: longest mocap gap in which the path is trusted to the IMU.
    """

    sigma_position: float = 0.002
    sigma_rotation: float = np.radians(0.3)
    independent_hz: float = 20.0
    imu_inflation: float = 2.0
    within_s: float | None = 0.5
    offset_sigma: float = 0.02
    drift_sigma: float = 1e-4
    T_body_mocap: F64 | None = None
    guess_sigma: tuple[float, float] = (np.radians(10.0), 0.3)
    gravity: float = 9.81
    max_bridged_s: float = 0.5
