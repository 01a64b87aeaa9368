"""What the cameras should see of the features, and how that depends on every part of the state.

A feature at inverse depth rho on the ray f of its host is q = f + rho p in any frame's homogeneous
coordinates: nothing here divides by rho, so a feature may be infinitely far (Civera et al. 2008).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.estimator.inertial.state import State
from share.geometry import se3
from share.geometry.camera import rays
from share.types import F64, I64

_NEAREST = 0.02  # homogeneous depth below which nothing is seen


@dataclass(frozen=True, eq=False)
class Prediction:
    """Of N features: uv (N, 2) normalised coordinates, NaN behind the camera; and its derivatives by the
    body's pose (N, 2, 6), the extrinsic (N, 2, 6), inverse depth (N, 2). That by the host's pose is the
    negative of that by the body's: only their difference is ever seen."""

    uv: F64
    by_pose: F64
    by_extrinsic: F64
    by_rho: F64


def predict(state: State, which: I64, T_right_left: F64 | None = None) -> Prediction:
    """What cam0, or with T_right_left (4, 4) cam1, should see of the features at indices `which` (N,)."""
    host, rho = state.host[which], state.rho[which]
    f = rays(state.ray[which])
    T_odom_host = state.poses[host] @ state.T_body_cam
    T_cam_odom = se3.inverse(state.T @ state.T_body_cam)
    q_odom = _moved(T_odom_host[:, :3, :3], T_odom_host[:, :3, 3], f, rho)
    R, t = T_cam_odom[:3, :3], T_cam_odom[:3, 3]
    q_cam = q_odom @ R.T + rho[:, None] * t
    R_cam_host = R @ T_odom_host[:, :3, :3]
    t_cam_host = T_odom_host[:, :3, 3] @ R.T + t
    own = _lever(R_cam_host, f, rho) - _lever(np.broadcast_to(np.eye(3), R_cam_host.shape), q_cam, rho)
    by_pose = -_lever(np.broadcast_to(R, R_cam_host.shape), q_odom, rho)
    q, by_rho = q_cam, t_cam_host
    if T_right_left is not None:
        turn, shift = T_right_left[:3, :3], T_right_left[:3, 3]
        q = q @ turn.T + rho[:, None] * shift
        by_rho = by_rho @ turn.T + shift
        own, by_pose = turn @ own, turn @ by_pose
    uv, D = _projected(q)
    return Prediction(uv, D @ by_pose, D @ own, (D @ by_rho[:, :, None])[:, :, 0])


def _moved(R: F64, t: F64, q: F64, rho: F64) -> F64:
    """Homogeneous points (N, 3) by transforms of their own."""
    out: F64 = (R @ q[:, :, None])[:, :, 0] + rho[:, None] * t
    return out


def _lever(R: F64, q: F64, rho: F64) -> F64:
    """R [-hat(q) | rho I], (N, 3, 6): what Exp(xi) does to q, seen through R."""
    return np.concatenate([-R @ se3.hat(q), R * rho[:, None, None]], axis=2)


def _projected(q: F64) -> tuple[F64, F64]:
    """(x, y) / z of (N, 3) and the derivative (N, 2, 3)."""
    z = np.where(q[:, 2] > _NEAREST, q[:, 2], np.nan)
    uv = q[:, :2] / z[:, None]
    D = np.zeros((len(q), 2, 3))
    D[:, 0, 0] = D[:, 1, 1] = 1 / z
    D[:, :, 2] = -uv / z[:, None]
    return uv, D
