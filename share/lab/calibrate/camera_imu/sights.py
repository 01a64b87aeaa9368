"""Corners of a target in pictures of a rig of cameras that is known, and what they tell of its pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera
from share.lab.calibrate.camera_bundle import View, parts, shared
from share.lab.calibrate.camera_start import moved, project
from share.lab.calibrate.target import Target
from share.types import F64, I64


@dataclass(frozen=True, eq=False)
class Corners:
    """Of one camera: frame (C,) rising, points (C, 3) m on the target, px (C, 2)."""

    frame: I64
    points: F64
    px: F64


@dataclass(frozen=True, eq=False)
class Sights:
    """stamps_ns (F,), camera's clock; of each camera what it is, T_cam_cam0 and its corners."""

    stamps_ns: I64
    cameras: tuple[Camera, ...]
    mounts: tuple[F64, ...]
    corners: tuple[Corners, ...]

    def take(self, keep: np.ndarray) -> Sights:
        """Only frames of a mask (F,)."""
        place = np.cumsum(keep) - 1
        parts = [(one, keep[one.frame]) for one in self.corners]
        left = tuple(Corners(place[one.frame[k]], one.points[k], one.px[k]) for one, k in parts)
        return Sights(self.stamps_ns[keep], self.cameras, self.mounts, left)


def sights(
    stamps_ns: I64, views: Sequence[View], target: Target, cameras: Sequence[Camera], T_cam1_cam0: F64 | None
) -> Sights:
    """Of views at stamps (F,). T_cam1_cam0: needed with two cameras."""
    corners = []
    for eye in range(len(cameras)):
        seen = [view.seen[eye] for view in views]
        frame = np.repeat(np.arange(len(views)), [len(one) for one in seen])
        ids = np.concatenate([one.ids for one in seen]).astype(np.int64)
        px = np.concatenate([one.px.reshape(-1, 2) for one in seen])
        corners.append(Corners(frame, target.corners[ids], px))
    mounts = (np.eye(4), T_cam1_cam0)[: len(cameras)]
    return Sights(stamps_ns, tuple(cameras), tuple(np.asarray(T) for T in mounts), tuple(corners))


def seen(sights: Sights, eye: int, T_target_cam0: F64) -> tuple[F64, F64]:
    """Residuals (C, 2) px of a camera, seen less predicted, and the derivatives (C, 2, 6) of what is
    predicted by eta of T_target_cam0 Exp(eta). Behind the camera it is NaN."""
    one, mount, at = sights.corners[eye], sights.mounts[eye], _in_cam0(sights, eye, T_target_cam0)
    shifted = np.concatenate([se3.hat(at), np.broadcast_to(-np.eye(3), (len(at), 3, 3))], axis=2)
    px, _, by = project(sights.cameras[eye], se3.transform(mount, at))
    return one.px - px, by @ (mount[:3, :3] @ shifted)


def by_rig(sights: Sights, eye: int, T_target_cam0: F64) -> F64:
    """Derivatives (C, 2, S) of what `seen` predicts, by the intrinsics of each camera and, of two, xi of
    T_cam1_cam0 Exp(xi): the order of `bundle.Solution`."""
    points, by_mount = moved(sights.mounts[eye], _in_cam0(sights, eye, T_target_cam0))
    _, by_intrinsics, by = project(sights.cameras[eye], points)
    out = np.zeros((len(points), 2, shared(sights.cameras)))
    out[:, :, parts(sights.cameras)[eye]] = by_intrinsics
    if eye == 1:
        out[:, :, -6:] = by @ by_mount
    return out


def _in_cam0(sights: Sights, eye: int, T_target_cam0: F64) -> F64:
    """The points (C, 3) of a camera's corners."""
    one = sights.corners[eye]
    T = se3.inverse(T_target_cam0)[one.frame]
    at: F64 = (T[:, :3, :3] @ one.points[..., None])[..., 0] + T[:, :3, 3]
    return at


@dataclass(frozen=True, eq=False)
class PoseNormal:
    """Normal equations of each frame's eta: H (F, 6, 6), g (F, 6); and the cost."""

    H: F64
    g: F64
    cost: float


def pose_normal(sights: Sights, T_target_cam0: F64, sigma_px: float, huber: float) -> PoseNormal:
    """All corners, in units of sigma_px, with Huber's weights beyond `huber` of these."""
    H, g, cost = np.zeros((len(T_target_cam0), 6, 6)), np.zeros((len(T_target_cam0), 6)), 0.0
    for eye, one in enumerate(sights.corners):
        if len(one.frame) == 0:
            continue
        r, J = seen(sights, eye, T_target_cam0)
        d = np.linalg.norm(r, axis=1) / sigma_px
        if np.isnan(d).any():
            return PoseNormal(H, g, np.inf)
        root = _roots(d, huber)[:, None] / sigma_px
        A, b = J * root[..., None], r * root
        first = np.flatnonzero(np.diff(one.frame, prepend=-1))
        H[one.frame[first]] += np.add.reduceat(A.swapaxes(1, 2) @ A, first)
        g[one.frame[first]] += np.add.reduceat((A.swapaxes(1, 2) @ b[..., None])[..., 0], first)
        cost += float(np.where(d <= huber, d * d / 2, huber * (d - huber / 2)).sum())
    return PoseNormal(H, g, cost)


def rig_normal(sights: Sights, T_target_cam0: F64, sigma_px: float, huber: float) -> F64:
    """What the normal equations have between each frame's eta and the rig's own parameters, (F, 6, S), by
    the weights of `pose_normal`."""
    out = np.zeros((len(T_target_cam0), 6, shared(sights.cameras)))
    for eye, one in enumerate(sights.corners):
        r, J = seen(sights, eye, T_target_cam0)
        weight = (_roots(np.linalg.norm(r, axis=1) / sigma_px, huber) / sigma_px) ** 2
        crossed = J.swapaxes(1, 2) @ (by_rig(sights, eye, T_target_cam0) * weight[:, None, None])
        np.add.at(out, one.frame, crossed)
    return out


def _roots(d: F64, huber: float) -> F64:
    """Of Huber's weights (C,) of corners that miss by d (C,) sigmas."""
    return np.sqrt(np.minimum(1, huber / np.maximum(d, 1e-12)))
