"""Target corners in the images of one or two cameras: residuals, derivatives, normal equations.

A rig has S parameters: intrinsics of each camera (`camera_initialisation.parameter_names`) and, with two, xi
of T_cam1_cam0 Exp(xi).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from share.geometry.camera import Camera
from share.lab.calibrate.camera_initialisation import (
    parameter_names,
    project_with_jacobians,
    transform_with_jacobian,
)
from share.lab.calibrate.corners import Detection
from share.lab.calibrate.target import Target
from share.lab.least_squares import huber
from share.types import F64, I64


@dataclass(frozen=True, eq=False)
class BoardView:
    """One view of the target: the corners of each camera, in the order of the cameras, empty where it sees
    none."""

    name: str
    detections: tuple[Detection, ...]


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of one camera: frame (C,) rising, points (C, 3) m on the target, px (C, 2)."""

    frame: I64
    points: F64
    px: F64


@dataclass(frozen=True, eq=False)
class CornerObservations:
    """Each camera's model, T_cam_cam0 and the corners that it sees in F frames."""

    frames: int
    cameras: tuple[Camera, ...]
    mounts: tuple[F64, ...]
    corners: tuple[Corners, ...]

    def take(self, keep: np.ndarray) -> CornerObservations:
        """Return only the frames of a mask (F,)."""
        place = np.cumsum(keep) - 1
        parts = [(one, keep[one.frame]) for one in self.corners]
        corners = tuple(Corners(place[one.frame[k]], one.points[k], one.px[k]) for one, k in parts)
        return replace(self, frames=int(keep.sum()), corners=corners)

    def with_rig(self, cameras: tuple[Camera, ...], T_cam1_cam0: F64 | None) -> CornerObservations:
        """Return the same corners, seen by another rig. T_cam1_cam0 (4, 4): needed with two cameras."""
        mounts = (np.eye(4), T_cam1_cam0)[: len(cameras)]
        return replace(self, cameras=cameras, mounts=tuple(np.asarray(T) for T in mounts))

    def linearise(self, cam: int, T_cam0_target: F64, by_rig: bool = False) -> tuple[F64, F64]:
        """Return a camera's residuals (C, 2) px, measured minus predicted, and derivatives (C, 2, [S +] 6) of
        the prediction: by the rig, if asked for, and by xi of T_cam0_target Exp(xi), (F, 4, 4).

        NaN behind the camera.
        """
        one, mount = self.corners[cam], self.mounts[cam]
        points, by_pose = transform_with_jacobian(T_cam0_target[one.frame], one.points)
        points, by_mount = transform_with_jacobian(mount, points)
        px, by_intrinsics, by_point = project_with_jacobians(self.cameras[cam], points)
        by_pose = by_point @ (mount[:3, :3] @ by_pose)
        if not by_rig:
            return one.px - px, by_pose
        S = rig_size(self.cameras)
        J = np.zeros((len(points), 2, S + 6))
        J[:, :, intrinsic_slices(self.cameras)[cam]] = by_intrinsics
        if cam == 1:
            J[:, :, S - 6 : S] = by_point @ by_mount
        J[:, :, S:] = by_pose
        return one.px - px, J

    def residuals(self, T_cam0_target: F64) -> tuple[F64, ...]:
        """Return the residuals (C, 2) px of each camera, measured minus predicted."""
        return tuple(self.linearise(cam, T_cam0_target)[0] for cam in range(len(self.cameras)))

    def normals(
        self, T_cam0_target: F64, limit: float, sigma_px: float = 1.0, by_rig: bool = False
    ) -> FrameNormals:
        """Return the normal equations of each frame, whitened by sigma_px, with Huber's loss beyond `limit`
        sigmas. The cost is infinite where a corner lies behind its camera."""
        size = 6 + by_rig * rig_size(self.cameras)
        H, g, cost = np.zeros((self.frames, size, size)), np.zeros((self.frames, size)), 0.0
        for cam, one in enumerate(self.corners):
            r, J = self.linearise(cam, T_cam0_target, by_rig)
            camera_cost, root = huber(np.linalg.norm(r, axis=1) / sigma_px, limit)
            cost += camera_cost
            root = root[:, None] / sigma_px
            J, r = J * root[..., None], r * root
            ends = np.searchsorted(one.frame, np.arange(self.frames + 1))
            for k, (first, last) in enumerate(pairwise(ends)):
                A = J[first:last].reshape(-1, size)
                H[k] += A.T @ A
                g[k] += A.T @ r[first:last].reshape(-1)
        return FrameNormals(H, g, cost)


@dataclass(frozen=True, eq=False)
class FrameNormals:
    """Normal equations of F frames, H (F, [S +] 6, [S +] 6) and g (F, [S +] 6), and the cost of all."""

    H: F64
    g: F64
    cost: float


def corner_observations(
    views: Sequence[BoardView], target: Target, cameras: Sequence[Camera], T_cam1_cam0: F64 | None = None
) -> CornerObservations:
    """Return the corners of views. T_cam1_cam0: needed with two cameras."""
    corners = []
    for cam in range(len(cameras)):
        detections = [view.detections[cam] for view in views]
        frame = np.repeat(np.arange(len(views)), [len(one) for one in detections])
        ids = np.concatenate([one.ids for one in detections]).astype(np.int64)
        px = np.concatenate([one.px.reshape(-1, 2) for one in detections])
        corners.append(Corners(frame, target.corners[ids], px))
    return CornerObservations(len(views), (), (), tuple(corners)).with_rig(tuple(cameras), T_cam1_cam0)


def intrinsic_slices(cameras: Sequence[Camera]) -> tuple[slice, ...]:
    """Return where each camera's intrinsics are among the rig's parameters."""
    ends = np.cumsum([0, *(len(parameter_names(camera)) for camera in cameras)]).tolist()
    return tuple(slice(a, b) for a, b in pairwise(ends))


def rig_size(cameras: Sequence[Camera]) -> int:
    """Return S."""
    return int(intrinsic_slices(cameras)[-1].stop) + 6 * (len(cameras) - 1)
