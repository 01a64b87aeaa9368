"""What the cameras should see of the features, and how that depends on every part of the state.

A feature at inverse depth rho on the ray f of its host is q = f + rho p in any frame's homogeneous
coordinates: nothing here divides by rho, so a feature may be infinitely far (Civera et al. 2008).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.columns import Columns
from share.estimator.inertial.state import State
from share.geometry import se3
from share.geometry.camera import Camera, rays
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


def predict(
    state: State, which: I64, T_right_left: F64 | None = None, right: NDArray[np.bool_] | None = None
) -> Prediction:
    """What cam0 should see of the features at indices `which` (N,). With T_right_left (4, 4) cam1, or only of
    those that are `right` (N,)."""
    f, rho, host = rays(state.ray[which]), state.rho[which], state.host[which]
    T_odom_host = state.poses @ state.T_body_cam
    T_cam_odom = se3.inverse(state.T @ state.T_body_cam)
    R_odom_host, t_odom_host = T_odom_host[host, :3, :3], T_odom_host[host, :3, 3]
    R, t = T_cam_odom[:3, :3], T_cam_odom[:3, 3]
    q_odom = (R_odom_host @ f[:, :, None])[:, :, 0] + rho[:, None] * t_odom_host
    q = q_odom @ R.T + rho[:, None] * t
    by_rho = t_odom_host @ R.T + t
    uv, D, by_rho = _in_camera(q, rho, by_rho, T_right_left, right)
    DR = D @ R
    by_extrinsic = lever(DR @ R_odom_host, f, rho) - lever(D, q, rho)
    return Prediction(uv, -lever(DR, q_odom, rho), by_extrinsic, by_rho)


def evened(seen: Prediction, camera: Camera, mine: NDArray[np.bool_]) -> Prediction:
    """Those that are `mine` (N,), a fisheye camera's, in its image plane: see `Camera.evened`."""
    uv, by_pose, by_extrinsic, by_rho = (
        part.copy() for part in (seen.uv, seen.by_pose, seen.by_extrinsic, seen.by_rho)
    )
    J = camera.jacobian(uv[mine]) / np.array([[camera.fx], [camera.fy]])
    uv[mine] = camera.evened(uv[mine])
    by_pose[mine], by_extrinsic[mine] = J @ by_pose[mine], J @ by_extrinsic[mine]
    by_rho[mine] = (J @ by_rho[mine, :, None])[:, :, 0]
    return Prediction(uv, by_pose, by_extrinsic, by_rho)


@dataclass(frozen=True, eq=False)
class Aim(Columns):
    """Where to look for N features, and as what: uv (N, 2) normalised coordinates, NaN behind the camera;
    warp (N, 2, 2), how these change with the pixel of the host: what a patch looks like; by_rho (N, 2), with
    inverse depth."""

    uv: F64
    warp: F64
    by_rho: F64


def aim(
    state: State,
    which: I64,
    spread: F64,
    slant: F64,
    T_right_left: F64 | None = None,
    right: NDArray[np.bool_] | None = None,
) -> Aim:
    """As `predict`. spread (N, 2, 2): d ray / d px of the host. slant (N, 2): d rho / d px, of the
    surface."""
    rho, T = state.rho[which], hosts_in_camera(state, which)
    R, t = T[:, :3, :3], T[:, :3, 3]
    q = (R @ rays(state.ray[which])[:, :, None])[:, :, 0] + rho[:, None] * t
    uv, D, by_rho = _in_camera(q, rho, t, T_right_left, right)
    return Aim(uv, (D @ R)[:, :, :2] @ spread + by_rho[:, :, None] * slant[:, None, :], by_rho)


def _in_camera(
    q: F64, rho: F64, by_rho: F64, T_right_left: F64 | None, right: NDArray[np.bool_] | None
) -> tuple[F64, F64, F64]:
    """Of points q (N, 3) in cam0, which inverse depth moves by by_rho (N, 3): uv (N, 2), its derivative
    (N, 2, 3) by q, and (N, 2) by inverse depth."""
    if T_right_left is None:
        uv, D = _projected(q)
        return uv, D, (D @ by_rho[:, :, None])[:, :, 0]
    turn, shift = T_right_left[:3, :3], T_right_left[:3, 3]
    if right is None:
        uv, D = _projected(q @ turn.T + rho[:, None] * shift)
        D_q = D @ turn
        return uv, D_q, (D_q @ by_rho[:, :, None])[:, :, 0] + D @ shift
    there = q.copy()
    there[right] = q[right] @ turn.T + rho[right, None] * shift
    uv, D = _projected(there)
    by = D[right] @ shift
    D[right] = D[right] @ turn
    moved = (D @ by_rho[:, :, None])[:, :, 0]
    moved[right] += by
    return uv, D, moved


def in_view(state: State, camera: Camera, keyframe: int, ray: F64, rho: F64) -> NDArray[np.bool_]:
    """Which of what keyframe number `keyframe` sees on rays (N, 2), inverse depth rho (N,), cam0 has in
    view."""
    T = se3.inverse(state.T @ state.T_body_cam) @ state.poses[keyframe] @ state.T_body_cam
    uv, _ = _projected(rays(ray) @ T[:3, :3].T + rho[:, None] * T[:3, 3])
    return np.asarray(camera.inside(np.nan_to_num(camera.distort(uv), nan=-1e6)), bool)


def hosts_in_camera(state: State, which: I64 | slice = slice(None)) -> F64:
    """T_cam_host (N, 4, 4): from cam0 of the hosts of features `which` (N,), all by default, to cam0 now."""
    T_cam_host = se3.inverse(state.T @ state.T_body_cam) @ state.poses @ state.T_body_cam
    out: F64 = T_cam_host[state.host[which]]
    return out


def lever(D: F64, q: F64, rho: F64) -> F64:
    """D [-hat(q) | rho I], (N, K, 6): what Exp(xi) does to q (N, 3), seen through D (N, K, 3) or (K, 3)."""
    out = np.empty((len(q), D.shape[-2], 6))
    x, y, z = q[:, 0, None], q[:, 1, None], q[:, 2, None]
    a, b, c = D[..., 0], D[..., 1], D[..., 2]
    out[:, :, 0], out[:, :, 1], out[:, :, 2] = y * c - z * b, z * a - x * c, x * b - y * a
    np.multiply(D, rho[:, None, None], out=out[:, :, 3:])
    return out


def _projected(q: F64) -> tuple[F64, F64]:
    """(x, y) / z of (N, 3) and the derivative (N, 2, 3)."""
    z = np.where(q[:, 2] > _NEAREST, q[:, 2], np.nan)
    uv = q[:, :2] / z[:, None]
    D = np.zeros((len(q), 2, 3))
    D[:, 0, 0] = D[:, 1, 1] = 1 / z
    D[:, :, 2] = -uv / z[:, None]
    return uv, D
