"""The content of an export: agents that move in one frame, and their pictures with points."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.recordings.recording import Source
from share.recordings.trajectory import Trajectory
from share.types import F32, F64

Progress = Callable[[int], None]


@dataclass(frozen=True, eq=False)
class SceneAgent:
    """An agent: its poses T_world_body, and its rig where that is known. source: of all its images and
    samples; None where there are only the pictures of `SceneView`."""

    trajectory: Trajectory
    rig: Rig | None = None
    source: Source | None = None


@dataclass(frozen=True, eq=False)
class SceneView:
    """A keyframe. points (N, 3): in the camera cam0, m, and all known.

    jpeg: reads its picture, of the camera's size; empty where there is none.
    """

    agent: str
    number: int
    stamp_ns: int
    T_world_body: F64
    points: F64
    jpeg: Callable[[], bytes]


@dataclass(frozen=True, eq=False)
class Scene:
    """name: of the map, or the recording. frame: of all poses, such as `map` or `odom`. agents: by name."""

    name: str
    frame: str
    agents: Mapping[str, SceneAgent]
    views: Sequence[SceneView] = field(default_factory=tuple)

    def camera(self, view: SceneView) -> Camera | None:
        """Return the camera of a view."""
        rig = self.agents[view.agent].rig
        return None if rig is None else rig.cam0

    def T_world_cam0(self, view: SceneView) -> F64:
        rig = self.agents[view.agent].rig
        return view.T_world_body if rig is None else view.T_world_body @ rig.T_body_cam0

    def world_points(self, view: SceneView) -> F64:
        """Return the points (N, 3) of a view in the frame of the scene."""
        return se3.transform(self.T_world_cam0(view), view.points)


def known_points(points: F32) -> F64:
    """Return the rows of (N, 3) without NaN."""
    return points[~np.isnan(points).any(axis=1)].astype(np.float64)
