"""Views of real recordings with their true poses, through the product's own readers."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from share.geometry import se3
from share.mapping.recognition.verification import CameraView
from share.recordings.recording import FolderSource
from share.runtime.source import open_source
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.types import F64, Frame
from share.vision.orb import make_view


class Seen(NamedTuple):
    """Sights, and the true poses of their bodies T_world_body (N, 4, 4) and cameras T_world_cam0."""

    sights: list[CameraView]
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
    sights, poses = [], []
    second = {stamp: image for name in (CAM1, DEPTH) for stamp, image in source.images.get(name, [])}
    for stamp, image in source.images[CAM0][::step]:
        image1 = second[stamp].load() if CAM1 in source.images else None
        depth = second[stamp].load() if DEPTH in source.images else None
        view = make_view(Frame(stamp, 0, image.load(), image1, depth), source.rig)
        T = truth.T[np.abs(truth.stamps_ns - stamp).argmin()]
        up = T[:3, :3].T @ (0.0, 0.0, 1.0) if upright else np.zeros(3)
        sights.append(CameraView(view, source.rig.cam0.focal, source.rig.T_body_cam0, up))
        poses.append(T)
    bodies = np.array(poses)
    return Seen(sights, bodies, bodies @ source.rig.T_body_cam0)
