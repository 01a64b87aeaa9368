"""What the cameras should see of the features, and how that depends on every part of the state.

A feature at inverse depth rho on the ray f of its host is q = f + rho p in any frame's homogeneous
coordinates: nothing here divides by rho, so a feature may be infinitely far (Civera et al. 2008).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.columns import Columns
from share.estimator.inertial.state import State
from share.geometry import se3
from share.geometry.camera import rays
from share.types import F64, I64

_NEAREST = 0.02  # homogeneous depth below which nothing is seen


@dataclass(frozen=True, eq=False)
class Prediction(Columns):
    """Of N features: uv (N, 2) normalised coordinates, NaN behind the camera; and its derivatives by the
    body's pose (N, 2, 6), the extrinsic (N, 2, 6), inverse depth (N, 2). That by the host's pose is the
    negative of that by the body's: only their difference is ever seen."""

    uv: F64
    by_pose: F64
    by_extrinsic: F64
    by_rho: F64


def predict(state: State, which: I64, T_right_left: F64 | None = None) -> Prediction:
    """What cam0, or with T_right_left (4, 4) cam1, should see of the features at indices `which` (N,)."""
    f, rho = rays(state.ray[which]), state.rho[which]
    T_odom_host = state.poses[state.host[which]] @ state.T_body_cam
    R_odom_host, t_odom_host = T_odom_host[:, :3, :3], T_odom_host[:, :3, 3]
    T_cam_odom = se3.inverse(state.T @ state.T_body_cam)
    R, t = T_cam_odom[:3, :3], T_cam_odom[:3, 3]
    q_odom = (R_odom_host @ f[:, :, None])[:, :, 0] + rho[:, None] * t_odom_host
    q = q_odom @ R.T + rho[:, None] * t
    by_pose = -lever(R, q_odom, rho)
    by_extrinsic = lever(R @ R_odom_host, f, rho) - lever(np.eye(3), q, rho)
    by_rho = t_odom_host @ R.T + t
    if T_right_left is not None:
        turn, shift = T_right_left[:3, :3], T_right_left[:3, 3]
        q, by_rho = q @ turn.T + rho[:, None] * shift, by_rho @ turn.T + shift
        by_pose, by_extrinsic = turn @ by_pose, turn @ by_extrinsic
    uv, D = _projected(q)
    return Prediction(uv, D @ by_pose, D @ by_extrinsic, (D @ by_rho[:, :, None])[:, :, 0])


def warp(state: State, which: I64, spread: F64, slant: F64, T_right_left: F64 | None = None) -> F64:
    """(N, 2, 2) how normalised coordinates change with the pixel of the host: what a patch round a feature
    looks like. spread (N, 2, 2): d ray / d px of the host. slant (N, 2): d rho / d px, of the surface."""
    T = hosts_in_camera(state, which)
    if T_right_left is not None:
        T = T_right_left @ T
    R, t = T[:, :3, :3], T[:, :3, 3]
    q = (R @ rays(state.ray[which])[:, :, None])[:, :, 0] + state.rho[which, None] * t
    _, D = _projected(q)
    out: F64 = D @ (R[:, :, :2] @ spread + t[:, :, None] * slant[:, None, :])
    return out


def hosts_in_camera(state: State, which: I64 | slice = slice(None)) -> F64:
    """T_cam_host (N, 4, 4): from cam0 of the hosts of features `which` (N,), all by default, to cam0 now."""
    return se3.inverse(state.T @ state.T_body_cam) @ state.poses[state.host[which]] @ state.T_body_cam


def lever(R: F64, q: F64, rho: F64) -> F64:
    """R [-hat(q) | rho I], (N, 3, 6): what Exp(xi) does to q (N, 3), seen through R (3, 3) or (N, 3, 3)."""
    return np.concatenate([-R @ se3.hat(q), R * rho[:, None, None]], axis=2)


def _projected(q: F64) -> tuple[F64, F64]:
    """(x, y) / z of (N, 3) and the derivative (N, 2, 3)."""
    z = np.where(q[:, 2] > _NEAREST, q[:, 2], np.nan)
    uv = q[:, :2] / z[:, None]
    D = np.zeros((len(q), 2, 3))
    D[:, 0, 0] = D[:, 1, 1] = 1 / z
    D[:, :, 2] = -uv / z[:, None]
    return uv, D
