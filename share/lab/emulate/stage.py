"""A room with its agents, ready to be recorded: poses of all at any time, and views of cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.lab.emulate.motion.avatars import Avatar
from share.lab.emulate.sensor.device import EmulatedDevice, PictureTimes
from share.lab.emulate.types import MotionPath, SceneInstant
from share.lab.emulate.world.mesh import Shape
from share.types import F64, I64, AgentKind

# distance for which motion blur is sampled; nearer things blur more than their samples show
_BLUR_DISTANCE_M = 1.5


@dataclass(frozen=True, eq=False)
class Actor:
    """One agent of the session. avatar, shapes: its body for others, poses and parts. pictures: all frames
    that it records, in true time (that of its path)."""

    name: str
    kind: AgentKind
    rig: Rig
    path: MotionPath
    device: EmulatedDevice
    avatar: Avatar
    shapes: tuple[Shape, ...]
    pictures: PictureTimes

    @property
    def clock_offset_ns(self) -> int:
        """Return the path's first instant, at which the session begins."""
        return self.path.start_ns

    def in_gap(self, true_ns: I64) -> NDArray[np.bool_]:
        """Return at which of the times (N,) there is no ground truth."""
        return in_gaps(self.path.gaps, true_ns)


@dataclass(frozen=True, eq=False)
class ActorView:
    """One instant: T_world_body (4, 4), and parts of all other agents (P, 4, 4) by name."""

    T_world_body: F64
    part_poses: dict[str, F64]

    def camera_view(self, T_body_cam: F64) -> SceneInstant:
        """Return the view of one of the body's cameras."""
        return SceneInstant(self.T_world_body @ T_body_cam, self.part_poses)


@dataclass(frozen=True, eq=False)
class RoomStage:
    """room: folder that `share.lab.emulate.drawing` opens."""

    room: FilePath
    actors: tuple[Actor, ...]

    def views(self, actor_index: int, true_ns: I64) -> list[ActorView]:
        """Return what actor number `actor_index` may see at true times (N,), clipped to its path. Most of the
        cost is per call, so ask for many at once."""
        actor = self.actors[actor_index]
        times = np.clip(true_ns, actor.path.start_ns, actor.path.end_ns)
        others = self._other_parts(actor_index, times - actor.clock_offset_ns)
        return [
            ActorView(T, {name: parts[k] for name, parts in others.items()})
            for k, T in enumerate(actor.path.poses(times))
        ]

    def motion_px(self, actor_index: int, true_ns: I64, exposure_ms: F64) -> F64:
        """Return the image motion (N,) px of things at _BLUR_DISTANCE_M during the exposure of each
        picture."""
        actor = self.actors[actor_index]
        half = (exposure_ms * 5e5).astype(np.int64)
        first, last = (
            actor.path.poses(np.clip(times, actor.path.start_ns, actor.path.end_ns))
            for times in (true_ns - half, true_ns + half)
        )
        turned = se3.rotation_angle(np.swapaxes(first[:, :3, :3], 1, 2) @ last[:, :3, :3])
        moved: F64 = np.linalg.norm(last[:, :3, 3] - first[:, :3, 3], axis=1)
        return actor.rig.cam0.focal * (turned + moved / _BLUR_DISTANCE_M)

    def _other_parts(self, actor_index: int, session_ns: I64) -> dict[str, F64]:
        """Return parts (N, P, 4, 4) of all other agents; they stand still before and after their paths."""
        out = {}
        for k, actor in enumerate(self.actors):
            if k != actor_index:
                own_ns = session_ns + actor.clock_offset_ns
                out[actor.name] = actor.avatar.part_poses(
                    np.clip(own_ns, actor.path.start_ns, actor.path.end_ns)
                )
        return out


def in_gaps(gaps: I64, true_ns: I64) -> NDArray[np.bool_]:
    """Return which of the times (N,) lie inside one of the gaps (G, 2), ends excluded."""
    t = true_ns[:, None]
    out: NDArray[np.bool_] = np.any((t > gaps[:, 0]) & (t < gaps[:, 1]), axis=1)
    return out


def T_body_camera(rig: Rig, camera: str) -> F64:
    """Return T_body_camera (4, 4) of cam0, cam1 or depth."""
    T_camera_cam0 = {"cam0": np.eye(4), "cam1": rig.T_cam1_cam0, "depth": rig.T_depth_cam0}[camera]
    assert T_camera_cam0 is not None
    return rig.T_body_cam0 @ se3.inverse(T_camera_cam0)


def downsized(camera: Camera, factor: int) -> Camera:
    """Return the same view with `factor` times fewer pixels both ways."""
    return replace(
        camera,
        width=camera.width // factor,
        height=camera.height // factor,
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=(camera.cx + 0.5) / factor - 0.5,
        cy=(camera.cy + 0.5) / factor - 0.5,
    )
