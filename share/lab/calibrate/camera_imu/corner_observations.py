"""Target corners in the images of a calibrated rig, and their residuals and normal equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera
from share.lab.calibrate.camera_bundle import BoardView, intrinsic_slices, shared_size
from share.lab.calibrate.camera_initialisation import project_with_jacobians, transform_with_jacobian
from share.lab.calibrate.target import Target
from share.lab.least_squares import huber
from share.types import F64, I64


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of one camera: frame (C,) rising, points (C, 3) m on the target, px (C, 2)."""

    frame: I64
    points: F64
    px: F64


@dataclass(frozen=True, eq=False)
class CornerObservations:
    """Frames at stamps_ns (F,) of the cameras' clock; of each camera its model, T_cam_cam0 and corners."""

    stamps_ns: I64
    cameras: tuple[Camera, ...]
    mounts: tuple[F64, ...]
    corners: tuple[Corners, ...]

    def take(self, keep: np.ndarray) -> CornerObservations:
        """Return only the frames of a mask (F,)."""
        place = np.cumsum(keep) - 1
        parts = [(one, keep[one.frame]) for one in self.corners]
        corners = tuple(Corners(place[one.frame[k]], one.points[k], one.px[k]) for one, k in parts)
        return CornerObservations(self.stamps_ns[keep], self.cameras, self.mounts, corners)


def corner_observations(
    stamps_ns: I64,
    views: Sequence[BoardView],
    target: Target,
    cameras: Sequence[Camera],
    T_cam1_cam0: F64 | None,
) -> CornerObservations:
    """Return the corners of views at stamps (F,). T_cam1_cam0: needed with two cameras."""
    corners = []
    for cam in range(len(cameras)):
        detections = [view.detections[cam] for view in views]
        frame = np.repeat(np.arange(len(views)), [len(one) for one in detections])
        ids = np.concatenate([one.ids for one in detections]).astype(np.int64)
        px = np.concatenate([one.px.reshape(-1, 2) for one in detections])
        corners.append(Corners(frame, target.corners[ids], px))
    mounts = (np.eye(4), T_cam1_cam0)[: len(cameras)]
    return CornerObservations(stamps_ns, tuple(cameras), tuple(np.asarray(T) for T in mounts), tuple(corners))


def corner_residuals(observations: CornerObservations, cam: int, T_target_cam0: F64) -> tuple[F64, F64]:
    """Return a camera's residuals (C, 2) px, measured minus predicted, and the derivatives (C, 2, 6) of
    the prediction by eta of T_target_cam0 Exp(eta). NaN behind the camera."""
    corners, mount = observations.corners[cam], observations.mounts[cam]
    points = _points_in_cam0(observations, cam, T_target_cam0)
    shifted = np.concatenate([se3.hat(points), np.broadcast_to(-np.eye(3), (len(points), 3, 3))], axis=2)
    px, _, by = project_with_jacobians(observations.cameras[cam], se3.transform(mount, points))
    return corners.px - px, by @ (mount[:3, :3] @ shifted)


def rig_jacobian(observations: CornerObservations, cam: int, T_target_cam0: F64) -> F64:
    """Return derivatives (C, 2, S) of the prediction of `corner_residuals` by the rig's parameters:
    intrinsics of each camera and, with two, xi of T_cam1_cam0 Exp(xi), in the order of
    `CameraBundleSolution`."""
    points, by_mount = transform_with_jacobian(
        observations.mounts[cam], _points_in_cam0(observations, cam, T_target_cam0)
    )
    _, by_intrinsics, by = project_with_jacobians(observations.cameras[cam], points)
    out = np.zeros((len(points), 2, shared_size(observations.cameras)))
    out[:, :, intrinsic_slices(observations.cameras)[cam]] = by_intrinsics
    if cam == 1:
        out[:, :, -6:] = by @ by_mount
    return out


def _points_in_cam0(observations: CornerObservations, cam: int, T_target_cam0: F64) -> F64:
    """Return a camera's corner points (C, 3) in the cam0 frame."""
    one = observations.corners[cam]
    T = se3.inverse(T_target_cam0)[one.frame]
    points: F64 = (T[:, :3, :3] @ one.points[..., None])[..., 0] + T[:, :3, 3]
    return points


@dataclass(frozen=True, eq=False)
class PoseNormals:
    """Normal equations of each frame's eta, H (F, 6, 6), g (F, 6), and the cost."""

    H: F64
    g: F64
    cost: float


def pose_normals(
    observations: CornerObservations, T_target_cam0: F64, sigma_px: float, limit: float
) -> PoseNormals:
    """Return the normal equations of all corners, whitened by sigma_px, with Huber weights beyond `limit`
    sigmas."""
    H, g, cost = np.zeros((len(T_target_cam0), 6, 6)), np.zeros((len(T_target_cam0), 6)), 0.0
    for cam, one in enumerate(observations.corners):
        if len(one.frame) == 0:
            continue
        r, J = corner_residuals(observations, cam, T_target_cam0)
        camera_cost, root = huber(np.linalg.norm(r, axis=1) / sigma_px, limit)
        cost += camera_cost
        if not np.isfinite(cost):
            break
        root = root[:, None] / sigma_px
        A, b = J * root[..., None], r * root
        first = np.flatnonzero(np.diff(one.frame, prepend=-1))
        H[one.frame[first]] += np.add.reduceat(A.swapaxes(1, 2) @ A, first)
        g[one.frame[first]] += np.add.reduceat((A.swapaxes(1, 2) @ b[..., None])[..., 0], first)
    return PoseNormals(H, g, cost)


def rig_cross_terms(
    observations: CornerObservations, T_target_cam0: F64, sigma_px: float, limit: float
) -> F64:
    """Return the cross terms (F, 6, S) of the normal equations between each frame's eta and the rig's
    parameters, with the weights of `pose_normals`."""
    out = np.zeros((len(T_target_cam0), 6, shared_size(observations.cameras)))
    for cam, one in enumerate(observations.corners):
        r, J = corner_residuals(observations, cam, T_target_cam0)
        weight = (huber(np.linalg.norm(r, axis=1) / sigma_px, limit)[1] / sigma_px) ** 2
        crossed = J.swapaxes(1, 2) @ (rig_jacobian(observations, cam, T_target_cam0) * weight[:, None, None])
        np.add.at(out, one.frame, crossed)
    return out
