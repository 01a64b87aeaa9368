"""Views of real recordings with their true poses, through the product's own readers."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from helpers.frame_keyframe import frame_image

from share.geometry import se3
from share.mapping.recognition.patch_alignment import ImageView
from share.mapping.recognition.verification import CameraView
from share.recordings.recording import FolderSource
from share.runtime.source import open_source
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.types import F64, Frame


class Seen(NamedTuple):
    """Sights with the ORB features that the edge finds in their images, and the true poses of their bodies
    T_world_body (N, 4, 4) and cameras T_world_cam0. Surfaces have the depth that the frame measures."""

    sights: list[CameraView]
    images: list[ImageView]
    T_world_body: F64
    T_world_cam0: F64

    def relative(self) -> tuple[F64, F64]:
        """Distance [m] and angle [deg] (N, N) between cameras."""
        rel = se3.inverse(self.T_world_cam0)[:, None] @ self.T_world_cam0[None]
        return np.linalg.norm(rel[..., :3, 3], axis=-1), np.degrees(se3.rotation_angle(rel))


def load(path: Path, step: int = 1, upright: bool = True) -> Seen:
    """Every `step`-th frame. upright: the true "up" stands in for the agent's (its world is z up)."""
    source = open_source(str(path))
    assert isinstance(source, FolderSource)
    truth = source.truth()
    assert truth is not None
    sights, images, poses = [], [], []
    second = {stamp: image for name in (CAM1, DEPTH) for stamp, image in source.images.get(name, [])}
    for stamp, image in source.images[CAM0][::step]:
        image1 = second[stamp].load() if CAM1 in source.images else None
        depth = second[stamp].load() if DEPTH in source.images else None
        frame, rig = Frame(stamp, 0, image.load(), image1, depth), source.rig
        images.append(ImageView(frame_image(frame, rig), rig.cam0, rig.T_body_cam0))
        T = truth.T[np.abs(truth.stamps_ns - stamp).argmin()]
        up = T[:3, :3].T @ (0.0, 0.0, 1.0) if upright else np.zeros(3)
        sights.append(CameraView(images[-1].describe(), rig.cam0.focal, rig.T_body_cam0, up))
        poses.append(T)
    bodies = np.array(poses)
    return Seen(sights, images, bodies, bodies @ source.rig.T_body_cam0)
