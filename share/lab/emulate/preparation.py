"""From a recipe to a stage: the room is furnished, paths are found in it, devices are set up."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace
from pathlib import Path

from share.errors import UsageError
from share.geometry.camera import Rig
from share.lab.emulate import room_file
from share.lab.emulate.motion.avatars import Avatar, avatar_shapes
from share.lab.emulate.motion.motion_plan import MotionPlan, PlannedAgent, plan_motions
from share.lab.emulate.motion.spec import EurocSpec, parse_motion
from share.lab.emulate.motion.spline import SplinePath
from share.lab.emulate.progress import Progress
from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.render import context
from share.lab.emulate.sensor.device import EmulatedDevice, PictureTimes
from share.lab.emulate.stage import Actor, RoomStage, in_gaps
from share.lab.emulate.types import MotionPath as Motion
from share.lab.emulate.world.layout import Layout
from share.sensors.profile import load_profile
from share.sensors.profile_types import Profile
from share.types import I64, AgentKind

_GLTF_SUFFIXES = (".glb", ".gltf")
_RESERVED_NAMES = ("truth",)  # the name of a folder of the session
_PROFILE, _EUROC_PROFILE = "d435i", "euroc"
_DEPTH, _MONO = "rgbd", "mono"


@dataclass(frozen=True, eq=False)
class PreparedSession:
    """layout: what stands in the room. notes: for a person."""

    stage: RoomStage
    layout: Layout
    notes: tuple[str, ...]


def prepare_session(recipe: SessionRecipe, room: Path, progress: Progress) -> PreparedSession:
    """The stage, whose room is to be kept in the folder `room`. Nothing is written.

    Raises UsageError, ConfigError or DataError for what cannot be made."""
    progress("planning", 0, 1)
    _check_first(recipe)
    motion_plan = plan_motions(recipe.motions, make_layout(recipe), recipe.seconds, recipe.seed)
    _check_names(recipe, motion_plan)
    actors = tuple(_make_actor(agent, k, recipe) for k, agent in enumerate(motion_plan.agents))
    _check_lenses(recipe, actors)
    notes = motion_plan.notes + tuple(f"{a.name}: {note}" for a in motion_plan.agents for note in a.notes)
    progress("planning", 1, 1)
    return PreparedSession(RoomStage(room, actors), motion_plan.layout, notes)


def keep_room(prepared: PreparedSession, progress: Progress) -> None:
    """Draw the room's pictures and bake its light where the stage expects them, if they are not there yet."""
    progress("making the room", 0, 1)
    stage = prepared.stage
    room_file.save_room_once(
        prepared.layout, {actor.name: actor.shapes for actor in stage.actors}, stage.room
    )
    progress("making the room", 1, 1)


def make_layout(recipe: SessionRecipe) -> Layout:
    """What stands where. Raises UsageError for an unknown scene or a size that it cannot have."""
    if recipe.scene == room_file.PLAIN:
        from share.lab.emulate.plain.scene import plain_layout

        return plain_layout(recipe.seed, recipe.size)
    if recipe.scene.lower().endswith(_GLTF_SUFFIXES):
        return _gltf_layout(recipe)
    from share.lab.emulate.world.scenes import SCENES, make_scene_layout

    if recipe.scene not in SCENES:
        known = (*SCENES, room_file.PLAIN)
        near = difflib.get_close_matches(recipe.scene, known, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}, or give a .glb file"
        raise UsageError(f"scene '{recipe.scene}' is not known; {hint}")
    return make_scene_layout(recipe.scene, recipe.seed, recipe.size)


def _gltf_layout(recipe: SessionRecipe) -> Layout:
    from share.lab.emulate.world.gltf import load_gltf

    if recipe.size is not None:
        raise UsageError(f"{recipe.scene}: the room in a file has a size of its own; leave --size out")
    return load_gltf(Path(recipe.scene))


def _make_actor(agent: PlannedAgent, number: int, recipe: SessionRecipe) -> Actor:
    sensors = _option_for(recipe.sensors, agent.name) or _default_sensors(agent)
    device_profile = _profile(agent, recipe)
    rig = _recorded_rig(device_profile.rig(depth=sensors == _DEPTH), agent)
    if sensors == _MONO:
        rig = replace(rig, cam1=None, T_cam1_cam0=None)
    seed = (recipe.seed, 7, number)
    path = _imu_path(agent, rig)
    device = EmulatedDevice(device_profile, recipe.effects, seed, agent.path.start_ns, (recipe.seed, 8))
    pictures = _without_gaps(device.picture_times(agent.path.start_ns, agent.path.end_ns), agent.path.gaps)
    if len(pictures) < 2:
        raise UsageError(f"{agent.name}: {agent.spec} leaves {len(pictures)} pictures; give it more time")
    avatar = Avatar(agent.body_kind, agent.path, agent.T_body_cam0)
    body_shapes = avatar_shapes(agent.body_kind, agent.path, (recipe.seed, 9, number))
    return Actor(agent.name, agent.kind, rig, path, device, avatar, body_shapes, pictures)


def _profile(agent: PlannedAgent, recipe: SessionRecipe) -> Profile:
    """`NAME` or `NAME:MODE`, as asked for, or what the motion was recorded with."""
    _, spec = parse_motion(agent.spec)
    usual = _EUROC_PROFILE if isinstance(spec, EurocSpec) else _PROFILE
    return _read_profile(_option_for(recipe.profiles, agent.name) or usual)


def _read_profile(spec: str) -> Profile:
    name, _, mode = spec.partition(":")
    return load_profile(name, mode or None)


def _default_sensors(agent: PlannedAgent) -> str:
    """Depth helps a robot not to bump into things; a headset has the infrared pair."""
    simulated = agent.path.recorded is None
    return _DEPTH if agent.kind is AgentKind.ROBOT and simulated else "stereo"


def _recorded_rig(rig: Rig, agent: PlannedAgent) -> Rig:
    """The cameras where the recorded rig had them, and its IMU's noise."""
    if agent.T_body_cam0 is not None:
        rig = replace(rig, T_body_cam0=agent.T_body_cam0)
    return rig if agent.imu is None else replace(rig, imu=agent.imu)


def _imu_path(agent: PlannedAgent, rig: Rig) -> Motion:
    """The path of the rig's IMU: where it sits otherwise than a simulated body, the camera still does not."""
    if agent.has_camera_axes and isinstance(agent.path, SplinePath):
        return agent.path.with_axes(rig.T_body_cam0[:3, :3].T)
    return agent.path


def _without_gaps(pictures: PictureTimes, gaps: I64) -> PictureTimes:
    """Without those taken where nobody knows the truth."""
    known = ~in_gaps(gaps, pictures.true_ns)
    return PictureTimes(pictures.index[known], pictures.true_ns[known], pictures.stamp_ns[known])


def _option_for(table: dict[str, str], name: str) -> str | None:
    return table.get(name, table.get(""))


def _check_first(recipe: SessionRecipe) -> None:
    """What can be found wrong without a plan. Raises ConfigError; RenderError where nothing can be drawn."""
    for words in recipe.profiles.values():
        _read_profile(words)
    if recipe.scene != room_file.PLAIN:
        context.create_context().release()


def _check_lenses(recipe: SessionRecipe, actors: tuple[Actor, ...]) -> None:
    for actor in actors:
        if recipe.scene == room_file.PLAIN and actor.rig.cam0.distortion:
            raise UsageError(
                f"{actor.name}: scene 'plain' has no lens distortion; "
                f"give --profile {actor.name}=d435i, or another scene"
            )


def _check_names(recipe: SessionRecipe, motion_plan: MotionPlan) -> None:
    known = {agent.name for agent in motion_plan.agents}
    if reserved := known.intersection(_RESERVED_NAMES):
        raise UsageError(
            f"an agent cannot be named '{reserved.pop()}': the session's truth is in a folder of that name"
        )
    for table in (recipe.sensors, recipe.profiles):
        for name in table:
            if name and name not in known:
                raise UsageError(f"'{name}' is not one of the agents: {', '.join(sorted(known))}")
