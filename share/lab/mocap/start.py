"""A first guess for the fit, in closed form: how the mocap body sits, where up is, where the nodes are."""

from __future__ import annotations

import numpy as np

from share.errors import DataError
from share.geometry import se3
from share.geometry.se3 import umeyama
from share.lab.mocap.factors import preintegrate, sampled
from share.lab.mocap.mocap import Mocap
from share.lab.mocap.offset import WINDOW_NS, imu_turning, mocap_turning
from share.lab.mocap.state import State
from share.types import F64, I64, ImuBatch

_UP = np.array([0.0, 0.0, 1.0])
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
    tilt = tilt_of(_forces(T_world_body[:, :3, :3], imu, nodes_ns).mean(0))
    R_level = se3.so3_exp(np.append(tilt, 0.0)).T
    middle = int(nodes_ns[0] + (nodes_ns[-1] - nodes_ns[0]) // 2)
    p = T_world_body[:, :3, 3] @ R_level.T
    v = np.gradient(p, (nodes_ns - nodes_ns[0]) * 1e-9, axis=0)
    R = R_level @ T_world_body[:, :3, :3]
    return State(nodes_ns, R, p, v, bias, np.zeros((n, 3)), tilt, T_body_mocap, middle)


def up_in(mocap: Mocap, imu: ImuBatch, T_body_mocap: F64) -> F64:
    """(3,) in the mocap's world: the usual specific force, m/s^2, whatever outliers there are."""
    R_world_body = mocap.T[:, :3, :3] @ T_body_mocap[:3, :3].T
    return np.asarray(np.median(_forces(R_world_body, imu, mocap.stamps_ns), axis=0), np.float64)


def _forces(R_world_body: F64, imu: ImuBatch, stamps_ns: I64) -> F64:
    """Specific force (N, 3) in the world, m/s^2."""
    force = sampled(imu, stamps_ns, imu.accel)
    return np.asarray((R_world_body @ force[..., None])[..., 0], np.float64)


def standing(up: F64) -> F64:
    """(3, 3), the turn by a quarter or a half that makes of the axis nearest to `up` (3,) the z axis. Motion
    captures with y up are usual, and so far from it a tilt is no small turn."""
    k = int(np.abs(up).argmax())
    axis = np.sign(up[k]) * np.eye(3)[k]
    if k == 2:
        return np.eye(3) if up[2] > 0 else se3.so3_exp(np.array([np.pi, 0.0, 0.0]))
    return se3.so3_exp(np.cross(axis, _UP) * np.pi / 2)


def tilt_of(up: F64) -> F64:
    """(2,) with Exp(tilt_x, tilt_y, 0) taking z to `up` (3,), of any length."""
    axis = np.array([-up[1], up[0]])  # z x up
    sine = float(np.linalg.norm(axis))
    return axis / sine * np.arctan2(sine, up[2]) if sine > 1e-12 else np.zeros(2)


def _turn_by_gyro(T: F64, known: np.ndarray, imu: ImuBatch, stamps_ns: I64, bias: F64) -> None:
    """Rotations of T (N, 4, 4) that are not known, from the node before each; in place."""
    after = np.flatnonzero(~known[1:]) + 1
    inc = preintegrate(imu, stamps_ns[after - 1], stamps_ns[after], bias[after], 0 * bias[after])
    for i, dR in zip(after, inc.dR, strict=True):
        T[i, :3, :3] = T[i - 1, :3, :3] @ dR
