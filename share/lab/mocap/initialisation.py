"""Initial values of the fit in closed form: mounting, vertical, nodes."""

from __future__ import annotations

import numpy as np

from share.errors import DataError
from share.geometry import se3
from share.geometry.se3 import umeyama
from share.lab.mocap.factors import interpolate_samples, preintegrate
from share.lab.mocap.offset import WINDOW_NS, imu_rotations, mocap_rotations
from share.lab.mocap.state import MocapImuState
from share.lab.mocap.trajectory import MocapTrajectory
from share.types import F64, I64, ImuBatch

_UP = np.array([0.0, 0.0, 1.0])
_MIN_ROTATION_RATE = 0.05  # rad/s rms about the second axis


def initial_rotation(imu: ImuBatch, mocap: MocapTrajectory) -> tuple[F64, F64]:
    """Return R_body_mocap (3, 3) and gyro bias (3,) rad/s that map the mocap's rotations to the gyro's (Park
    and Martin, *Robot sensor calibration*, IEEE TRA 10(5), 1994, with the bias as the shift).

    Raises DataError if the body turned about one axis only.
    """
    times, mocap_turns = mocap_rotations(mocap)
    imu_times, imu_turns = imu_rotations(imu)
    keep = (times >= imu_times[0]) & (times <= imu_times[-1])
    imu_turns = interpolate_samples(ImuBatch(imu_times, imu_turns, imu_turns), times[keep], imu_turns)
    mocap_turns = mocap_turns[keep]
    rms_by_axis = np.linalg.svd(imu_turns - imu_turns.mean(0), compute_uv=False) / np.sqrt(
        max(len(imu_turns), 1)
    )
    if rms_by_axis[1] < _MIN_ROTATION_RATE * WINDOW_NS * 1e-9:
        raise DataError(
            "mocap and IMU: the body turned about one axis only, which does not determine the mounting; turn "
            "it about two axes, or give T_body_mocap (share dataset align: --mounting)"
        )
    errors = np.abs(np.linalg.norm(mocap_turns, axis=1) - np.linalg.norm(imu_turns, axis=1))
    is_inlier = errors <= 3 * np.median(errors)
    T = umeyama(mocap_turns[is_inlier], imu_turns[is_inlier])
    return T[:3, :3], T[:3, 3] / (WINDOW_NS * 1e-9)


def initial_state(
    nodes_ns: I64, imu: ImuBatch, mocap: MocapTrajectory, T_body_mocap: F64, gyro_bias: F64
) -> MocapImuState:
    """Return nodes on the mocap's path, with rotations by the gyro in its gaps.

    Up is the mean specific force: over a recording that starts and ends at one velocity, accelerations
    cancel.
    """
    n = len(nodes_ns)
    T_world_body = mocap.interpolate(nodes_ns) @ se3.inverse(T_body_mocap)
    bias = np.tile(gyro_bias, (n, 1))
    _propagate_by_gyro(T_world_body, mocap.is_covered(nodes_ns), imu, nodes_ns, bias)
    tilt = tilt_from_up(_world_forces(T_world_body[:, :3, :3], imu, nodes_ns).mean(0))
    R_level = se3.so3_exp(np.append(tilt, 0.0)).T
    middle = int(nodes_ns[0] + (nodes_ns[-1] - nodes_ns[0]) // 2)
    p = T_world_body[:, :3, 3] @ R_level.T
    v = np.gradient(p, (nodes_ns - nodes_ns[0]) * 1e-9, axis=0)
    R = R_level @ T_world_body[:, :3, :3]
    return MocapImuState(nodes_ns, R, p, v, bias, np.zeros((n, 3)), tilt, T_body_mocap, middle)


def up_vector(mocap: MocapTrajectory, imu: ImuBatch, T_body_mocap: F64) -> F64:
    """Return the median specific force (3,), m/s^2, in the mocap's world; robust to outliers."""
    R_world_body = mocap.T[:, :3, :3] @ T_body_mocap[:3, :3].T
    return np.asarray(np.median(_world_forces(R_world_body, imu, mocap.stamps_ns), axis=0), np.float64)


def _world_forces(R_world_body: F64, imu: ImuBatch, stamps_ns: I64) -> F64:
    """Return the specific force (N, 3) in the world, m/s^2."""
    force = interpolate_samples(imu, stamps_ns, imu.accel)
    return np.asarray((R_world_body @ force[..., None])[..., 0], np.float64)


def nearest_axis_rotation(up: F64) -> F64:
    """Return the rotation (3, 3) by a quarter or half turn that takes the axis nearest to `up` (3,) to z.
    Mocap worlds with y up are common, too far from z for a small tilt."""
    k = int(np.abs(up).argmax())
    axis = np.sign(up[k]) * np.eye(3)[k]
    if k == 2:
        return np.eye(3) if up[2] > 0 else se3.so3_exp(np.array([np.pi, 0.0, 0.0]))
    return se3.so3_exp(np.cross(axis, _UP) * np.pi / 2)


def tilt_from_up(up: F64) -> F64:
    """Return the tilt (2,) with Exp(tilt_x, tilt_y, 0) taking z to `up` (3,), of any length."""
    axis = np.array([-up[1], up[0]])  # z x up
    sine = float(np.linalg.norm(axis))
    return axis / sine * np.arctan2(sine, up[2]) if sine > 1e-12 else np.zeros(2)


def _propagate_by_gyro(T: F64, is_known: np.ndarray, imu: ImuBatch, stamps_ns: I64, bias: F64) -> None:
    """Fill in rotations of T (N, 4, 4) that are unknown, from the node before each; in place."""
    unknown = np.flatnonzero(~is_known[1:]) + 1
    inc = preintegrate(imu, stamps_ns[unknown - 1], stamps_ns[unknown], bias[unknown], 0 * bias[unknown])
    for i, dR in zip(unknown, inc.dR, strict=True):
        T[i, :3, :3] = T[i - 1, :3, :3] @ dR
