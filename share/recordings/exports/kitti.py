"""KITTI odometry poses: for each agent NAME.txt, a row of T (3, 4) of cam0 for each pose, and NAME.times.txt.

As in KITTI's own files the world is the first camera: here the first agent's, for all of them, so that agents
of one map stay in one frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from share.files.writing import atomic_write
from share.geometry import se3
from share.recordings.exports.names import plain_names
from share.recordings.exports.scene import Progress, Scene


def write_kitti(scene: Scene, folder: Path, progress: Progress) -> None:
    """Write the poses of `scene` to the existing `folder`. progress: called with 1 for each agent's."""
    names = plain_names(list(scene.agents))
    T_first_world: np.ndarray | None = None
    for name, agent in scene.agents.items():
        T_body_cam0 = np.eye(4) if agent.rig is None else agent.rig.T_body_cam0
        T_world_cam0 = agent.trajectory.T @ T_body_cam0
        if T_first_world is None and len(T_world_cam0):
            T_first_world = se3.inverse(T_world_cam0[0])
        T = T_world_cam0 if T_first_world is None else T_first_world @ T_world_cam0
        rows = (" ".join(f"{value:.9e}" for value in pose[:3].ravel()) for pose in T)
        atomic_write(folder / f"{names[name]}.txt", "".join(f"{row}\n" for row in rows))
        since_ns = agent.trajectory.stamps_ns - agent.trajectory.stamps_ns[:1]
        atomic_write(folder / f"{names[name]}.times.txt", "".join(f"{ns * 1e-9:.9f}\n" for ns in since_ns))
        progress(1)
