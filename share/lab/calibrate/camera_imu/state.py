"""The estimated state, and the order of its parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.geometry import se3
from share.lab.calibrate.camera_imu.spline import ORDER, Curve
from share.types import F64, I64

KNOTS = 6 * ORDER  # columns of one segment: rotation (3) and position (3) of each of its knots
MOUNT, SHIFT, GRAVITY = slice(0, 6), 6, slice(7, 10)  # among the SHARED columns of all segments
SHARED = 10
LOCAL_COLUMNS = KNOTS + SHARED + 12  # and the biases (gyro, accel) at both ends of the segment's interval


@dataclass(frozen=True, eq=False)
class CameraImuState:
    """State in the target's frame as world.

    curve: of the IMU, in its clock. biases (M, 6) rad/s, m/s^2: at nodes every `per_node` segments, linear
    between them. T_imu_cam0 (4, 4). t_imu = t_cam + shift_s. gravity (3,) m/s^2, downwards.
    """

    curve: Curve
    biases: F64
    per_node: int
    T_imu_cam0: F64
    shift_s: float
    gravity: F64

    def updated(self, knots: F64, border: F64) -> CameraImuState:
        """Return the state after a step of the knots (K, 6) and of the SHARED + 6 M others."""
        curve = replace(self.curve, R=self.curve.R @ se3.so3_exp(knots[:, :3]), p=self.curve.p + knots[:, 3:])
        return replace(
            self,
            curve=curve,
            biases=self.biases + border[SHARED:].reshape(-1, 6),
            T_imu_cam0=self.T_imu_cam0 @ se3.exp(border[MOUNT]),
            shift_s=self.shift_s + float(border[SHIFT]),
            gravity=self.gravity + border[GRAVITY],
        )

    def bias(self, segment: I64, u: F64) -> tuple[F64, F64]:
        """Return biases (N, 6), and the weight (N,) of the node after."""
        node = segment // self.per_node
        share_after = (segment - node * self.per_node + u) / self.per_node
        return self.biases[node] * (1 - share_after[:, None]) + self.biases[node + 1] * share_after[
            :, None
        ], share_after


def node_count(segments: int, per_node: int) -> int:
    """Return the number of bias nodes of a curve."""
    return -(-segments // per_node) + 1


def body_twist(R: F64, rate: F64, velocity: F64) -> F64:
    """Return the body's twist (N, 6), xi per second, of a motion in the world."""
    return np.concatenate([rate, np.einsum("nji,nj->ni", R, velocity)], axis=1)
