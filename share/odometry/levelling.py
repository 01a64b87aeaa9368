"""Level a state that does not know which way is up, because it began without IMU samples.

All that it has estimated turns together, about the place where it began: its poses relative to one another
stay as the images gave them.
"""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.geometry.camera import ImuBias
from share.odometry import initialisation
from share.odometry.state import ACCEL_BIAS, GYRO_BIAS, KEYFRAMES_START, ORIGIN, POSE, VELOCITY, FilterState
from share.types import F64, ImuBatch

_MAX_GAP_NS = 100_000_000  # between samples that are averaged


def level(state: FilterState, imu: ImuBatch, bias: ImuBias, gravity: float) -> F64 | None:
    """Turn odom until z is up by the newest samples, with the tilt sigma that they allow, and begin with this
    bias. Return T_new_old (4, 4) of odom; None, and change nothing, while the samples do not show up.
    """
    gaps = np.flatnonzero(np.diff(imu.stamps_ns) > _MAX_GAP_NS)
    force = initialisation.mean_force(state.stamp_ns, imu.take(slice(gaps[-1] + 1 if len(gaps) else 0, None)))
    if force is None:
        return None
    R = _shortest_turn(state.T[:3, :3] @ (force - bias.accel))
    start = state.T_origin[:3, 3].copy()
    T_new_old = se3.from_rt(R, start - R @ start)
    _turn(state, T_new_old)
    _forget_bias(state, bias)
    _add_tilt(state, start)
    initialisation.update_with_force_in_motion(state, force, gravity)
    return T_new_old


def _shortest_turn(up: F64) -> F64:
    """Return the smallest rotation (3, 3) that takes `up` (3,) to z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9 * np.linalg.norm(up):  # up already, or upside down
        return np.diag([1.0, 1.0, 1.0] if up[2] > 0 else [1.0, -1.0, -1.0])
    out: F64 = se3.so3_exp(axis * (np.arctan2(sine, up[2]) / sine))
    return out


def _turn(state: FilterState, T_new_old: F64) -> None:
    """Give poses, velocity and their errors in another odom."""
    Ad = se3.adjoint(T_new_old)
    J = np.eye(state.size)
    for columns in _pose_columns(state):
        J[columns, columns] = Ad
    J[VELOCITY, VELOCITY] = T_new_old[:3, :3]
    state.T, state.T_origin = T_new_old @ state.T, T_new_old @ state.T_origin
    state.keyframe_poses, state.v = T_new_old @ state.keyframe_poses, T_new_old[:3, :3] @ state.v
    state.cov = J @ state.cov @ J.T


def _forget_bias(state: FilterState, bias: ImuBias) -> None:
    both = np.r_[GYRO_BIAS, ACCEL_BIAS]
    state.bg, state.ba = bias.gyro.copy(), bias.accel.copy()
    state.cov[both], state.cov[:, both] = 0.0, 0.0
    state.cov[both, both] = np.repeat([bias.gyro_sigma**2, bias.accel_sigma**2], 3)


def _add_tilt(state: FilterState, start: F64) -> None:
    """Add an unknown tilt that all poses share, about a place (3,) in odom."""
    J = np.zeros((state.size, 2))
    for columns in _pose_columns(state):
        J[columns][:3], J[columns][3:] = np.eye(3)[:, :2], se3.hat(start)[:, :2]
    state.cov += initialisation.UNKNOWN_TILT_RAD**2 * J @ J.T
    state.cov = (state.cov + state.cov.T) / 2


def _pose_columns(state: FilterState) -> list[slice]:
    keyframes = range(KEYFRAMES_START, state.features_start, 6)
    return [POSE, ORIGIN, *(slice(start, start + 6) for start in keyframes)]
