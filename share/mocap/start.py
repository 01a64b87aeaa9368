"""A first guess for the fit, in closed form: how the mocap body sits, where up is, where the nodes are."""

from __future__ import annotations

import numpy as np

from share.errors import DataError
from share.geometry import se3
from share.geometry.align import umeyama
from share.mocap.mocap import Mocap
from share.mocap.offset import WINDOW_NS, imu_turning, mocap_turning
from share.mocap.preintegrate import preintegrate, sampled
from share.mocap.state import State
from share.types import F64, I64, ImuBatch

_LEAST_TURN = 0.05  # rad/s rms about the second axis


def hand_eye(imu: ImuBatch, mocap: Mocap) -> tuple[F64, F64]:
    """R_body_mocap (3, 3) and gyro bias (3,) rad/s: what takes the mocap's turns to the gyro's
    (Park and Martin, *Robot sensor calibration*, IEEE TRA 10(5), 1994, with the bias as the shift).

    Raises DataError if the body turned about one axis only.
    """
    times, seen = mocap_turning(mocap)
    own, felt = imu_turning(imu)
    keep = (times >= own[0]) & (times <= own[-1])
    felt = sampled(ImuBatch(own, felt, felt), times[keep], felt)
    seen = seen[keep]
    spread = np.linalg.svd(felt - felt.mean(0), compute_uv=False) / np.sqrt(max(len(felt), 1))
    if spread[1] < _LEAST_TURN * WINDOW_NS * 1e-9:
        raise DataError(
            "mocap and IMU: the body turned about one axis only, so how the mocap's body sits on it cannot "
            "be found; turn it about two axes, or give T_body_mocap (share dataset align: --mounting)"
        )
    like = np.abs(np.linalg.norm(seen, axis=1) - np.linalg.norm(felt, axis=1))
    like = like <= 3 * np.median(like)  # an outlier of the mocap turns by something else
    T = umeyama(seen[like], felt[like])
    return T[:3, :3], T[:3, 3] / (WINDOW_NS * 1e-9)


def first_state(nodes_ns: I64, imu: ImuBatch, mocap: Mocap, T_body_mocap: F64, gyro_bias: F64) -> State:
    """Nodes on the mocap's path, turned by the gyro where the mocap has a hole. up is the mean specific
    force: over a recording that ends at the speed at which it began, nothing else is left of it."""
    n = len(nodes_ns)
    T_world_body = mocap.at(nodes_ns) @ se3.inverse(T_body_mocap)
    bias = np.tile(gyro_bias, (n, 1))
    _turn_by_gyro(T_world_body, mocap.known(nodes_ns), imu, nodes_ns, bias)
    tilt = _tilt(T_world_body[:, :3, :3], sampled(imu, nodes_ns, imu.accel))
    R_level = se3.so3_exp(np.append(tilt, 0.0)).T
    middle = int(nodes_ns[0] + (nodes_ns[-1] - nodes_ns[0]) // 2)
    p = T_world_body[:, :3, 3] @ R_level.T
    v = np.gradient(p, (nodes_ns - nodes_ns[0]) * 1e-9, axis=0)
    R = R_level @ T_world_body[:, :3, :3]
    return State(nodes_ns, R, p, v, bias, np.zeros((n, 3)), tilt, T_body_mocap, middle)


def _tilt(R_world_body: F64, force: F64) -> F64:
    """(2,) with Exp(tilt_x, tilt_y, 0) taking z to the mean specific force."""
    up = (R_world_body @ force[..., None])[..., 0].mean(0)
    up /= np.linalg.norm(up)
    axis = np.array([-up[1], up[0]])  # z x up
    sine = float(np.linalg.norm(axis))
    return axis / sine * np.arctan2(sine, up[2]) if sine > 1e-12 else np.zeros(2)


def _turn_by_gyro(T: F64, known: np.ndarray, imu: ImuBatch, stamps_ns: I64, bias: F64) -> None:
    """Rotations of T (N, 4, 4) that are not known, from the node before each; in place."""
    after = np.flatnonzero(~known[1:]) + 1
    inc = preintegrate(imu, stamps_ns[after - 1], stamps_ns[after], bias[after], 0 * bias[after])
    for i, dR in zip(after, inc.dR, strict=True):
        T[i, :3, :3] = T[i - 1, :3, :3] @ dR
