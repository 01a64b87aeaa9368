"""From a recipe to a stage: the room is furnished, paths are found in it, devices are set up."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace
from pathlib import Path

from share.errors import UsageError
from share.geometry.camera import Rig
from share.lab.emulate import room_file
from share.lab.emulate.motion.avatars import Avatar, shapes
from share.lab.emulate.motion.plan import Agent, Plan, plan
from share.lab.emulate.motion.spec import EurocSpec, parse
from share.lab.emulate.motion.spline import SplinePath
from share.lab.emulate.progress import Progress
from share.lab.emulate.recipe import Recipe
from share.lab.emulate.render import context
from share.lab.emulate.sensor.device import Device, Pictures
from share.lab.emulate.stage import Actor, Stage, within
from share.lab.emulate.types import Path as Motion
from share.lab.emulate.world.layout import Layout
from share.sensors.profile import profile
from share.sensors.profile_types import Profile
from share.types import I64, AgentKind

_GLTF = (".glb", ".gltf")
_TAKEN = ("truth",)  # the name of a folder of the session
_PROFILE, _EUROC_PROFILE = "d435i", "euroc"
_DEPTH, _MONO = "rgbd", "mono"


@dataclass(frozen=True, eq=False)
class Prepared:
    """layout: what stands in the room. notes: for a person."""

    stage: Stage
    layout: Layout
    notes: tuple[str, ...]


def prepare(recipe: Recipe, room: Path, progress: Progress) -> Prepared:
    """The stage, whose room is to be kept in the folder `room`. Nothing is written.

    Raises UsageError, ConfigError or DataError for what cannot be made."""
    progress("planning", 0, 1)
    _check_first(recipe)
    planned = plan(recipe.motions, furnish(recipe), recipe.seconds, recipe.seed)
    _check_names(recipe, planned)
    actors = tuple(_actor(agent, k, recipe) for k, agent in enumerate(planned.agents))
    _check_lenses(recipe, actors)
    notes = planned.notes + tuple(f"{a.name}: {note}" for a in planned.agents for note in a.notes)
    progress("planning", 1, 1)
    return Prepared(Stage(room, actors), planned.layout, notes)


def keep_room(prepared: Prepared, progress: Progress) -> None:
    """Draw the room's pictures and bake its light where the stage expects them, if they are not there yet."""
    progress("making the room", 0, 1)
    stage = prepared.stage
    room_file.keep(prepared.layout, {actor.name: actor.shapes for actor in stage.actors}, stage.room)
    progress("making the room", 1, 1)


def furnish(recipe: Recipe) -> Layout:
    """What stands where. Raises UsageError for an unknown scene or a size that it cannot have."""
    if recipe.scene == room_file.PLAIN:
        from share.lab.emulate.plain.scene import layout as plain_layout

        return plain_layout(recipe.seed, recipe.size)
    if recipe.scene.lower().endswith(_GLTF):
        return _own_room(recipe)
    from share.lab.emulate.world.scenes import SCENES, layout

    if recipe.scene not in SCENES:
        known = (*SCENES, room_file.PLAIN)
        near = difflib.get_close_matches(recipe.scene, known, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}, or give a .glb file"
        raise UsageError(f"scene '{recipe.scene}' is not known; {hint}")
    return layout(recipe.scene, recipe.seed, recipe.size)


def _own_room(recipe: Recipe) -> Layout:
    from share.lab.emulate.world.gltf import load_gltf

    if recipe.size is not None:
        raise UsageError(f"{recipe.scene}: the room in a file has a size of its own; leave --size out")
    return load_gltf(Path(recipe.scene))


def _actor(agent: Agent, number: int, recipe: Recipe) -> Actor:
    sensors = _chosen(recipe.sensors, agent.name) or _usual_sensors(agent)
    made = _profile(agent, recipe)
    rig = _mounted(made.rig(depth=sensors == _DEPTH), agent)
    if sensors == _MONO:
        rig = replace(rig, cam1=None, T_cam1_cam0=None)
    seed = (recipe.seed, 7, number)
    path = _of_imu(agent, rig)
    device = Device(made, recipe.effects, seed, agent.path.start_ns, (recipe.seed, 8))
    pictures = _outside(device.pictures(agent.path.start_ns, agent.path.end_ns), agent.path.gaps)
    if len(pictures) < 2:
        raise UsageError(f"{agent.name}: {agent.spec} leaves {len(pictures)} pictures; give it more time")
    avatar = Avatar(agent.look, agent.path, agent.T_body_cam0)
    look = shapes(agent.look, agent.path, (recipe.seed, 9, number))
    return Actor(agent.name, agent.kind, rig, path, device, avatar, look, pictures)


def _profile(agent: Agent, recipe: Recipe) -> Profile:
    """`NAME` or `NAME:MODE`, as asked for, or what the motion was recorded with."""
    _, spec = parse(agent.spec)
    usual = _EUROC_PROFILE if isinstance(spec, EurocSpec) else _PROFILE
    return _opened(_chosen(recipe.profiles, agent.name) or usual)


def _opened(words: str) -> Profile:
    name, _, mode = words.partition(":")
    return profile(name, mode or None)


def _usual_sensors(agent: Agent) -> str:
    """Depth helps a robot not to bump into things; a headset has the infrared pair."""
    simulated = agent.path.recorded is None
    return _DEPTH if agent.kind is AgentKind.ROBOT and simulated else "stereo"


def _mounted(rig: Rig, agent: Agent) -> Rig:
    """The cameras where the recorded rig had them, and its IMU's noise."""
    if agent.T_body_cam0 is not None:
        rig = replace(rig, T_body_cam0=agent.T_body_cam0)
    return rig if agent.imu is None else replace(rig, imu=agent.imu)


def _of_imu(agent: Agent, rig: Rig) -> Motion:
    """The path of the rig's IMU: where it sits otherwise than a simulated body, the camera still does not."""
    if agent.like_camera and isinstance(agent.path, SplinePath):
        return agent.path.turned(rig.T_body_cam0[:3, :3].T)
    return agent.path


def _outside(pictures: Pictures, gaps: I64) -> Pictures:
    """Without those taken where nobody knows the truth."""
    known = ~within(gaps, pictures.true_ns)
    return Pictures(pictures.index[known], pictures.true_ns[known], pictures.stamp_ns[known])


def _chosen(table: dict[str, str], name: str) -> str | None:
    return table.get(name, table.get(""))


def _check_first(recipe: Recipe) -> None:
    """What can be found wrong without a plan. Raises ConfigError; RenderError where nothing can be drawn."""
    for words in recipe.profiles.values():
        _opened(words)
    if recipe.scene != room_file.PLAIN:
        context.create().release()


def _check_lenses(recipe: Recipe, actors: tuple[Actor, ...]) -> None:
    for actor in actors:
        if recipe.scene == room_file.PLAIN and actor.rig.cam0.distortion:
            raise UsageError(
                f"{actor.name}: scene 'plain' has no lens distortion; "
                f"give --profile {actor.name}=d435i, or another scene"
            )


def _check_names(recipe: Recipe, planned: Plan) -> None:
    known = {agent.name for agent in planned.agents}
    if taken := known.intersection(_TAKEN):
        raise UsageError(
            f"an agent cannot be named '{taken.pop()}': the session's truth is in a folder of that name"
        )
    for table in (recipe.sensors, recipe.profiles):
        for name in table:
            if name and name not in known:
                raise UsageError(f"'{name}' is not one of the agents: {', '.join(sorted(known))}")
