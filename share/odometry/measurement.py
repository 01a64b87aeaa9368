"""Features of the state in the images of a frame: expected where the filter says, found by their patches."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from share.columns import Columns
from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import Camera, Rig, rays
from share.odometry.features import Looks, seen_twice
from share.odometry.state import State
from share.types import F32, F64, I64, U8, Frame
from share.vision import optical_flow, patches

_BORDER_PX = 6.0
_AGREE_PX = 1.5  # how far the way by the image before may be from what the first patch says
_MANY = 0.15  # of the features in view that are not found: then they are followed from the image before


@dataclass(frozen=True, eq=False)
class Right:
    """Features number which (M,) in cam1, and where each was found: at (M, 2), normalised."""

    which: I64
    at: F64


@dataclass(frozen=True, eq=False)
class Sought:
    """Of all N features in cam0: where each was found, px (N, 2) and at (N, 2) normalised, NaN elsewhere, and
    whether it was, and, for others to say, went its own way; expected (N, 2) px and uv (N, 2) normalised, NaN
    behind the camera; what patches look like there,
    warp (N, 2, 2) px by px, and by how many px of its first image a feature moves for one unit more of
    inverse depth, along (N, 2). samples (N, S): see `patches.Found`. right: in cam1."""

    px: F32
    at: F64
    found: NDArray[np.bool_]
    astray: NDArray[np.bool_]
    expected: F64
    uv: F64
    warp: F64
    along: F64
    samples: F32
    right: Right | None = None

    def due(self, camera: Camera) -> int:
        """How many should be in view."""
        return int(camera.inside(self.expected, 0.0).sum())


def seek(
    frame: Frame, rig: Rig, state: State, looks: Looks, config: InertialConfig, fresh: int = 0
) -> Sought:
    """Those from number `fresh` on in the images of a frame, both in one pass; in cam1 only those whose turn
    it is."""
    n = len(state.ids)
    which = np.arange(fresh, n)
    images: tuple[U8, ...] = (frame.image0,)
    cameras, first = [rig.cam0], len(which)
    if frame.image1 is not None and rig.cam1 is not None and not fresh:
        images, cameras = (frame.image0, frame.image1), [rig.cam0, rig.cam1]
        which = np.concatenate([which, np.flatnonzero(seen_twice(looks))])
    right = np.arange(len(which)) >= first
    T = rig.T_cam1_cam0 if len(cameras) > 1 else None
    aim = aim_of(state, which, looks.spread[which], looks.slant[which], T, right)
    parts = [slice(0, first), slice(first, None)][: len(cameras)]
    expected = np.concatenate([c.distort(aim.uv[part]) for c, part in zip(cameras, parts, strict=True)])
    jacobian = np.concatenate([c.jacobian(aim.uv[part]) for c, part in zip(cameras, parts, strict=True)])
    warp = jacobian @ aim.warp
    inside = np.concatenate(
        [c.inside(expected[part], _BORDER_PX) for c, part in zip(cameras, parts, strict=True)]
    )
    todo = np.flatnonzero(inside)
    left = Aim(aim.uv[:first], aim.warp[:first], aim.by_rho[:first])
    out = _nothing(n, which[:first], expected[:first], left, warp[:first])
    if len(todo) == 0:
        return out
    ahead = int(np.searchsorted(todo, first))
    px = expected[todo]
    found = patches.align(images, ahead, looks.patch.probe[which[todo]], px, warp[todo])
    good = _good(found, px, config, config.reach_px)
    at = aim.uv[todo] + _solved(jacobian[todo], found.px - px)
    for camera, part in zip(cameras, (slice(0, ahead), slice(ahead, None)), strict=False):
        if camera.fisheye:  # whose pixels are not as much of (x/z, y/z) a few px on
            at[part] = camera.normalise(found.px[part].astype(np.float64), aim.uv[todo[part]])
        elif camera.distortion:
            at[part] += _solved(jacobian[todo[part]], found.px[part] - camera.distort(at[part]))
        if camera.bounded:  # it may have strayed to where there is no ray
            good[part] &= camera.knows(found.px[part].astype(np.float64))
    _put(out, which[todo[:ahead]], found, at[:ahead], good[:ahead], slice(0, ahead))
    if len(cameras) == 1:
        return out
    number = which[todo[ahead:]]
    where = np.flatnonzero(good[ahead:] & out.found[number])
    return replace(out, right=Right(number[where], at[ahead:][where]))


def rescue(
    before: U8, image: U8, camera: Camera, looks: Looks, sought: Sought, config: InertialConfig
) -> None:
    """Where many of cam0 were not found, these are followed from the image before to wherever they went."""
    inside = camera.inside(sought.expected, _BORDER_PX)
    todo = np.flatnonzero(~sought.found & inside)
    if len(todo) <= _MANY * inside.sum():
        return
    guess = sought.expected[todo].astype(np.float32)
    px, ok = optical_flow.follow(before, image, looks.px[todo], guess, window=15, levels=2, back_check_px=1.0)
    todo, about = todo[ok], px[ok].astype(np.float64)
    if len(todo) == 0:
        return
    found = patches.align((image,), len(todo), looks.patch.probe[todo], about, sought.warp[todo])
    at = camera.normalise(found.px.astype(np.float64))
    good = _good(found, about, config, _AGREE_PX) & np.isfinite(at).all(axis=1)
    _put(sought, todo, found, at, good, slice(None))


def _nothing(n: int, which: I64, expected: F64, aim: Aim, warp: F64) -> Sought:
    """Of n features, where `which` (M,) are to be looked for."""
    where, uv, along = expected, aim.uv, _along(aim)
    if len(which) < n:
        where, uv, along = (_spread(value, which, np.full((n, 2), np.nan)) for value in (where, uv, along))
        warp = _spread(warp, which, np.zeros((n, 2, 2)))
    no, samples = np.zeros(n, bool), np.zeros((n, len(patches.OFFSETS)), np.float32)
    px = np.where(np.isnan(where), -1e6, where).astype(np.float32)
    return Sought(px, np.full((n, 2), np.nan), no, no.copy(), where, uv, warp, along, samples)


def _spread(values: F64, which: I64, into: F64) -> F64:
    into[which] = values
    return into


def _solved(J: F64, b: F64) -> F64:
    """x (N, 2) with J x = b of (N, 2, 2) and (N, 2); not finite where J has no inverse."""
    (p, q), (r, s) = np.moveaxis(J, 0, 2)
    x, y = b.T
    with np.errstate(divide="ignore", invalid="ignore"):
        out: F64 = np.stack([s * x - q * y, p * y - r * x], axis=1) / (p * s - q * r)[:, None]
    return out


def _along(aim: Aim) -> F64:
    """px (N, 2) of the first image by which a feature moves for one unit more of inverse depth."""
    out = _solved(aim.warp, aim.by_rho)
    return np.where(np.isfinite(out), out, 0.0)


def _good(found: patches.Found, px: F64, config: InertialConfig, reach_px: float) -> NDArray[np.bool_]:
    """Which are what was looked for, near px (N, 2)."""
    strayed = np.hypot(*(found.px - px).T)
    near = (found.step < config.settled_px) & (strayed < reach_px)
    out: NDArray[np.bool_] = near & (found.alike > config.alike)
    return out


def _put(
    out: Sought, which: I64, found: patches.Found, at: F64, good: NDArray[np.bool_], part: slice
) -> None:
    out.px[which], out.found[which], out.samples[which] = found.px[part], good, found.samples[part]
    out.at[which[good]] = at[good]


# ---- What the cameras should see of the features, and how that depends on every part of the state.
#
# A feature at inverse depth rho on the ray f of its host is q = f + rho p in any frame's homogeneous
# coordinates: nothing here divides by rho, so a feature may be infinitely far (Civera et al. 2008).

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


def aim_of(
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
