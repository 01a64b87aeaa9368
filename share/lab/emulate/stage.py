"""A room with its agents, ready to be recorded: poses of all at any time, and views of cameras.

`prepare_session` makes it from a recipe: furnish the room, plan the paths, set up the devices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from share.errors import UsageError
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.lab.emulate.motion.avatars import Avatar, avatar_shapes
from share.lab.emulate.motion.motion_plan import MotionPlan, PlannedAgent, plan_motions
from share.lab.emulate.motion.spec import EurocSpec, parse_motion
from share.lab.emulate.motion.spline import SplinePath
from share.lab.emulate.recipe import Progress, SessionRecipe
from share.lab.emulate.render import context
from share.lab.emulate.sensor.device import EmulatedDevice, PictureTimes
from share.lab.emulate.types import MotionPath, SceneInstant
from share.lab.emulate.types import MotionPath as Motion
from share.lab.emulate.world import room_files
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.mesh import Shape
from share.lab.emulate.world.room_files import PLAIN
from share.sensors.profile import load_profile
from share.sensors.profile_types import Profile
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
        others = self._other_parts(actor_index, times - actor.path.start_ns)
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
        return image_motion_px(actor.rig, first, last)

    def _other_parts(self, actor_index: int, session_ns: I64) -> dict[str, F64]:
        """Return parts (N, P, 4, 4) of all other agents; they stand still before and after their paths."""
        out = {}
        for k, actor in enumerate(self.actors):
            if k != actor_index:
                own_ns = session_ns + actor.path.start_ns
                out[actor.name] = actor.avatar.part_poses(
                    np.clip(own_ns, actor.path.start_ns, actor.path.end_ns)
                )
        return out


def image_motion_px(rig: Rig, first: F64, last: F64) -> F64:
    """Return the image motion (N,) px of things at _BLUR_DISTANCE_M between poses (N, 4, 4) of the body."""
    turned = se3.rotation_angle(np.swapaxes(first[:, :3, :3], 1, 2) @ last[:, :3, :3])
    moved: F64 = np.linalg.norm(last[:, :3, 3] - first[:, :3, 3], axis=1)
    return rig.cam0.focal * (turned + moved / _BLUR_DISTANCE_M)


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


_GLTF_SUFFIXES = (".glb", ".gltf")
_RESERVED_NAMES = ("truth",)  # a folder of the session has this name
_PROFILE, _EUROC_PROFILE = "d435i", "euroc"
_DEPTH, _MONO = "rgbd", "mono"


@dataclass(frozen=True, eq=False)
class PreparedSession:
    """layout: of the room. notes: text for the user."""

    stage: RoomStage
    layout: Layout
    notes: tuple[str, ...]


def prepare_session(recipe: SessionRecipe, room: Path, progress: Progress) -> PreparedSession:
    """Return the stage, with `room` as the folder for its room. Writes nothing.

    Raises UsageError, ConfigError or DataError for an invalid recipe.
    """
    progress("planning", 0, 1)
    _check_first(recipe)
    motion_plan = plan_motions(recipe.motions, make_layout(recipe), recipe.seconds, recipe.motion_seed)
    _check_names(recipe, motion_plan)
    actors = tuple(_make_actor(agent, k, recipe) for k, agent in enumerate(motion_plan.agents))
    _check_lenses(recipe, actors)
    notes = motion_plan.notes + tuple(f"{a.name}: {note}" for a in motion_plan.agents for note in a.notes)
    progress("planning", 1, 1)
    return PreparedSession(RoomStage(room, actors), motion_plan.layout, notes)


def keep_room(prepared: PreparedSession, progress: Progress) -> None:
    """Draw the room's pictures and bake its light into the stage's folder, unless they are there."""
    progress("making the room", 0, 1)
    stage = prepared.stage
    room_files.save_room_once(
        prepared.layout, {actor.name: actor.shapes for actor in stage.actors}, stage.room
    )
    progress("making the room", 1, 1)


def make_layout(recipe: SessionRecipe) -> Layout:
    """Return the room's layout. Raises UsageError for an unknown scene or an unsupported size."""
    if recipe.day and (recipe.scene == PLAIN or recipe.scene.lower().endswith(_GLTF_SUFFIXES)):
        raise UsageError(f"{recipe.scene}: what is loose in it is not known; leave out --day")
    if recipe.scene == PLAIN:
        from share.lab.emulate.plain.render import plain_layout

        return plain_layout(recipe.seed, recipe.size)
    if recipe.scene.lower().endswith(_GLTF_SUFFIXES):
        return _gltf_layout(recipe)
    from share.lab.emulate.world.another_day import another_day
    from share.lab.emulate.world.scenes import make_scene_layout

    return another_day(make_scene_layout(recipe.scene, recipe.seed, recipe.size), recipe.day)


def _gltf_layout(recipe: SessionRecipe) -> Layout:
    from share.lab.emulate.world.gltf import load_gltf

    if recipe.size is not None:
        raise UsageError(f"{recipe.scene}: a room file has a fixed size; leave out --size")
    return load_gltf(Path(recipe.scene))


def _make_actor(agent: PlannedAgent, number: int, recipe: SessionRecipe) -> Actor:
    sensors = _option_for(recipe.sensors, agent.name) or _default_sensors(agent)
    device_profile = _profile(agent, recipe)
    rig = _recorded_rig(device_profile.rig(depth=sensors == _DEPTH), agent)
    if sensors == _MONO:
        rig = replace(rig, cam1=None, T_cam1_cam0=None)
    seed = (recipe.motion_seed, 7, number)
    path = _imu_path(agent, rig)
    device = EmulatedDevice(
        device_profile, recipe.effects, seed, agent.path.start_ns, (recipe.motion_seed, 8)
    )
    pictures = _without_gaps(device.picture_times(agent.path.start_ns, agent.path.end_ns), agent.path.gaps)
    if len(pictures) < 2:
        raise UsageError(f"{agent.name}: {agent.spec} leaves {len(pictures)} pictures; give it more time")
    avatar = Avatar(agent.body_kind, agent.path, agent.T_body_cam0)
    body_shapes = avatar_shapes(agent.body_kind, agent.path, (recipe.seed, 9, number))
    return Actor(agent.name, agent.kind, rig, path, device, avatar, body_shapes, pictures)


def _profile(agent: PlannedAgent, recipe: SessionRecipe) -> Profile:
    """Return the profile asked for (`NAME` or `NAME:MODE`), else the usual one of the motion."""
    _, spec = parse_motion(agent.spec)
    usual = _EUROC_PROFILE if isinstance(spec, EurocSpec) else _PROFILE
    return _read_profile(_option_for(recipe.profiles, agent.name) or usual)


def _read_profile(spec: str) -> Profile:
    name, _, mode = spec.partition(":")
    return load_profile(name, mode or None)


def _default_sensors(agent: PlannedAgent) -> str:
    """Return depth for a simulated robot, else stereo."""
    simulated = agent.path.recorded is None
    return _DEPTH if agent.kind is AgentKind.ROBOT and simulated else "stereo"


def _recorded_rig(rig: Rig, agent: PlannedAgent) -> Rig:
    """Return the rig with the recording's camera mount and IMU noise, if any."""
    if agent.T_body_cam0 is not None:
        rig = replace(rig, T_body_cam0=agent.T_body_cam0)
    return rig if agent.imu is None else replace(rig, imu=agent.imu)


def _imu_path(agent: PlannedAgent, rig: Rig) -> Motion:
    """Return the path of the rig's IMU, with its axes; the cameras' path is the same."""
    if agent.has_camera_axes and isinstance(agent.path, SplinePath):
        return agent.path.with_axes(rig.T_body_cam0[:3, :3].T)
    return agent.path


def _without_gaps(pictures: PictureTimes, gaps: I64) -> PictureTimes:
    """Return the pictures with ground truth."""
    known = ~in_gaps(gaps, pictures.true_ns)
    return PictureTimes(pictures.index[known], pictures.true_ns[known], pictures.stamp_ns[known])


def _option_for(table: dict[str, str], name: str) -> str | None:
    return table.get(name, table.get(""))


def _check_first(recipe: SessionRecipe) -> None:
    """Check what needs no plan. Raises ConfigError; RenderError where this machine cannot draw."""
    for words in recipe.profiles.values():
        _read_profile(words)
    if recipe.scene != PLAIN:
        context.create_context().release()


def _check_lenses(recipe: SessionRecipe, actors: tuple[Actor, ...]) -> None:
    for actor in actors:
        if recipe.scene == PLAIN and actor.rig.cam0.distortion:
            raise UsageError(
                f"{actor.name}: scene 'plain' has no lens distortion; "
                f"give --profile {actor.name}=d435i, or another scene"
            )


def _check_names(recipe: SessionRecipe, motion_plan: MotionPlan) -> None:
    known = {agent.name for agent in motion_plan.agents}
    if reserved := known.intersection(_RESERVED_NAMES):
        raise UsageError(
            f"an agent cannot be named '{reserved.pop()}': a folder of the session has that name"
        )
    for table in (recipe.sensors, recipe.profiles):
        for name in table:
            if name and name not in known:
                raise UsageError(f"'{name}' is not one of the agents: {', '.join(sorted(known))}")
