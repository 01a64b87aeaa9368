"""Plan the motion of all agents in a room: from specs to paths that touch neither the room nor each other.

specs -> recorded motions are placed, obstacles to them are removed -> simulated ones keep clear of them

`paper:1` .. `paper:5` are the three agents of the paper's five experiments, 60 s in 9 x 6 x 4 m. Path
lengths: SHARE (IMWUT 10(3) 97, 2026). The recordings are not public; these are other paths of the same
lengths.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path as File

import numpy as np

from share.errors import UsageError
from share.geometry.camera import ImuNoise
from share.lab.emulate.motion import board, recorded
from share.lab.emulate.motion.crowd import (
    PEOPLE_M,
    FixedPath,
    FloorGraphs,
    MotionPreferences,
    SimulatedAgent,
    fixed_path,
    plan_crowd,
)
from share.lab.emulate.motion.placement import MIN_DISTANCE_M, PathToPlace, place_paths
from share.lab.emulate.motion.robot import INITIAL_STILL_S
from share.lab.emulate.motion.route import Floor, floor_from_occupancy
from share.lab.emulate.motion.spec import (
    PAPER_S,
    BoardSpec,
    EurocSpec,
    PaperSpec,
    RecordedSpec,
    RobotSpec,
    Spec,
    TumSpec,
    VisitSpec,
    WalkSpec,
    parse_motion,
)
from share.lab.emulate.motion.spline import read_tum_path
from share.lab.emulate.motion.visits import visiting_paths
from share.lab.emulate.types import MotionPath
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.occupancy import Occupancy
from share.types import F64, AgentKind

PAPER_NAMES = ("user1", "user2", "robot")
PAPER_LENGTHS_M: dict[int, tuple[float, float, float]] = {
    1: (82.56, 17.21, 10.06),
    2: (33.39, 43.87, 10.88),
    3: (28.48, 35.66, 8.16),
    4: (54.02, 40.77, 23.91),
    5: (37.67, 34.17, 23.09),
}
_HEIGHTS_M = (1.70, 1.62, 0.35)
_MIN_WALK_SPEED, _MIN_DRIVE_SPEED = 0.80, 0.32  # m/s; agents with shorter paths pause more instead
# times the mean speed, which makes up for slowing down in bends
_BEND_FACTORS = {"person": 1.1, "robot": 1.3}
_START_DELAY_S = 2.4


def paper_agents(number: int) -> list[SimulatedAgent]:
    """Return the three agents of one experiment. Raises KeyError for a number outside 1 .. 5."""
    return [
        _paper_agent(name, length, height)
        for name, length, height in zip(PAPER_NAMES, PAPER_LENGTHS_M[number], _HEIGHTS_M, strict=True)
    ]


def _paper_agent(name: str, length: float, height: float) -> SimulatedAgent:
    body_kind = "robot" if name == "robot" else "person"
    mean = _BEND_FACTORS[body_kind] * length / (PAPER_S - INITIAL_STILL_S - _START_DELAY_S)
    preferences = MotionPreferences(
        body_kind, max(mean, _MIN_DRIVE_SPEED if body_kind == "robot" else _MIN_WALK_SPEED), 0.0
    )
    return SimulatedAgent(name, preferences, height, length=length)


_GAZE_TARGETS = 150
_GAZE_TARGET_HEIGHTS_M = (0.3, 2.3)
_EYE_HEIGHTS_M = (1.60, 1.75)
_PAPER_SPACE_M = (9.0, 6.0)


@dataclass(frozen=True, eq=False)
class PlannedAgent:
    """One agent. body_kind: its looks, `person`, `robot` or `drone`.

    T_body_cam0 (4, 4): the camera's pose on the body, where a recorded motion has its own rig, else None:
    that of the sensor's profile (a simulated body is the profile's IMU). imu: noise of the
    recorded IMU. spec: as given by the user. notes: text for the
    user. has_camera_axes: the body has camera axes, x right, y down, z ahead.
    """

    name: str
    kind: AgentKind
    body_kind: str
    path: MotionPath
    spec: str
    T_body_cam0: F64 | None = None
    imu: ImuNoise | None = None
    notes: tuple[str, ...] = ()
    has_camera_axes: bool = False


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """layout: the room without obstacles to recorded motions. All paths begin together: each start_ns is the
    session's first instant, in the path's own clock. notes: text for the user."""

    layout: Layout
    agents: tuple[PlannedAgent, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _NamedSpec:
    """A spec with the agent's name and the user's text."""

    name: str
    spec: Spec
    text: str


def plan_motions(specs: Sequence[str], layout: Layout, seconds: float, seed: int) -> MotionPlan:
    """Return paths of the agents of `specs` (`[NAME=]SPEC`) in the room for `seconds`. Deterministic for a
    given seed.

    Raises UsageError for an invalid spec, a name given twice, or paths that do not fit into the room,
    DataError for a damaged recording.
    """
    requests = _named_specs(specs)
    recorded_agents = [_recorded_agent(a, seconds) for a in requests if isinstance(a.spec, RecordedSpec)]
    paths_to_place = [PathToPlace(agent.name, agent.body_kind, agent.path) for agent in recorded_agents]
    layout, paths, notes = (
        place_paths(layout, paths_to_place, (seed, 71)) if paths_to_place else (layout, [], [])
    )
    agents = [replace(agent, path=path) for agent, path in zip(recorded_agents, paths, strict=True)]
    agents += [
        _board_agent(a, a.spec, layout, seconds, seed) for a in requests if isinstance(a.spec, BoardSpec)
    ]
    agents += _visiting_agents(requests, layout, [_fixed_path(agent) for agent in agents], seconds, seed)
    agents += _simulated_agents(requests, layout, [_fixed_path(agent) for agent in agents], seconds, seed)
    order = [name for a in requests for name in _agent_names(a)]
    if any(isinstance(a.spec, PaperSpec) for a in requests) and seconds != PAPER_S:
        part = f"; the session has its first {seconds:g} s" if seconds < PAPER_S else ""
        notes = [*notes, f"an experiment of the paper lasts {PAPER_S:g} s{part}"]
    return MotionPlan(layout, tuple(sorted(agents, key=lambda a: order.index(a.name))), tuple(notes))


def _named_specs(specs: Sequence[str]) -> list[_NamedSpec]:
    """Return specs with names: the user's, else the kind's with a number. Raises UsageError."""
    if not specs:
        raise UsageError("no agent is given; give at least one --motion, for example walk:")
    requests: list[_NamedSpec] = []
    for text in specs:
        name, spec = parse_motion(text)
        if isinstance(spec, PaperSpec) and (name or len(specs) > 1):
            raise UsageError(
                f"'{text}': paper:N brings its own three agents; give it alone and without a name"
            )
        requests.append(_NamedSpec(name or _free_name(text.partition(":")[0], requests), spec, text))
    names = [name for a in requests for name in _agent_names(a)]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"two agents are named '{name}'; give each its own name")
    return requests


def _agent_names(request: _NamedSpec) -> tuple[str, ...]:
    return PAPER_NAMES if isinstance(request.spec, PaperSpec) else (request.name,)


def _free_name(kind: str, requests: Sequence[_NamedSpec]) -> str:
    used = {a.name for a in requests}
    return next(name for k in range(1, len(used) + 2) if (name := f"{kind}{k}") not in used)


def _recorded_agent(request: _NamedSpec, seconds: float) -> PlannedAgent:
    """Return a recording's motion where it was recorded, at most as long as the session."""
    spec = request.spec
    assert isinstance(spec, RecordedSpec)
    longest = min(seconds, spec.seconds or seconds)
    kind = AgentKind(spec.kind)
    if isinstance(spec, TumSpec):
        path: MotionPath = read_tum_path(File(spec.path), spec.start, longest)
        return PlannedAgent(
            request.name, kind, spec.look, path, request.text, notes=_short_note(path, seconds)
        )
    options = recorded.EUROC_OPTIONS if isinstance(spec, EurocSpec) else recorded.TUMVI_OPTIONS
    recording = recorded.open_recorded_motion(File(spec.path), options, spec.start, longest)
    notes = (*recording.notes, *_short_note(recording.path, seconds))
    mount, noise = recording.T_body_cam0, recording.noise
    return PlannedAgent(request.name, kind, spec.look, recording.path, request.text, mount, noise, notes)


def _visiting_agents(
    requests: Sequence[_NamedSpec], layout: Layout, fixed: Sequence[FixedPath], seconds: float, seed: int
) -> list[PlannedAgent]:
    """Return the people who walk to given places."""
    visitors = [(a, a.spec) for a in requests if isinstance(a.spec, VisitSpec)]
    if not visitors:
        return []
    rng = np.random.default_rng((seed, 75))
    heights = [spec.height or float(rng.uniform(*_EYE_HEIGHTS_M)) for _, spec in visitors]
    ground = FloorGraphs(floor_from_occupancy(Occupancy.from_layout(layout)))
    specs = [spec for _, spec in visitors]
    paths = visiting_paths(ground, specs, heights, fixed, _gaze_targets(layout, rng), seconds, (seed, 76))
    return [
        PlannedAgent(a.name, AgentKind.AR, "person", path, a.text, has_camera_axes=True)
        for (a, _), path in zip(visitors, paths, strict=True)
    ]


def _board_agent(
    request: _NamedSpec, spec: BoardSpec, layout: Layout, seconds: float, seed: int
) -> PlannedAgent:
    """Return a hand-held device before the room's board; the motion depends on the agent's name."""
    rng = np.random.default_rng((seed, 74, zlib.crc32(request.name.encode())))
    path = board.board_path(layout, spec, min(seconds, spec.seconds or seconds), rng)
    notes = _short_note(path, seconds)
    return PlannedAgent(
        request.name, AgentKind.AR, "drone", path, request.text, notes=notes, has_camera_axes=True
    )


def _short_note(path: MotionPath, seconds: float) -> tuple[str, ...]:
    lasts = (path.end_ns - path.start_ns) / 1e9
    return (f"ends after {lasts:.1f} s",) if lasts < seconds - 0.5 else ()


def _fixed_path(agent: PlannedAgent) -> FixedPath:
    return fixed_path(agent.path, PEOPLE_M if agent.body_kind == "person" else MIN_DISTANCE_M)


def _simulated_agents(
    requests: Sequence[_NamedSpec], layout: Layout, fixed: Sequence[FixedPath], seconds: float, seed: int
) -> list[PlannedAgent]:
    """Return people and robots, also the paper's three."""
    members: list[SimulatedAgent] = []
    texts: list[str] = []
    rng = np.random.default_rng((seed, 72))
    for a in requests:
        own = _crowd_members(a, rng)
        members += own
        texts += [a.text] * len(own)
    if not members:
        return []
    floor, planned_s = floor_from_occupancy(Occupancy.from_layout(layout)), seconds
    if any(isinstance(a.spec, PaperSpec) for a in requests):
        floor = _floor_within(floor, _PAPER_SPACE_M)
        planned_s = PAPER_S
    paths = plan_crowd(FloorGraphs(floor), members, fixed, _gaze_targets(layout, rng), planned_s, (seed, 73))
    paths = [replace(p, end_ns=min(p.end_ns, p.start_ns + round(seconds * 1e9))) for p in paths]
    kinds = {"person": AgentKind.AR, "robot": AgentKind.ROBOT}
    return [
        PlannedAgent(
            m.name, kinds[m.preferences.body_kind], m.preferences.body_kind, path, text, has_camera_axes=True
        )
        for m, path, text in zip(members, paths, texts, strict=True)
    ]


def _crowd_members(request: _NamedSpec, rng: np.random.Generator) -> list[SimulatedAgent]:
    spec = request.spec
    if isinstance(spec, PaperSpec):
        return paper_agents(spec.number)
    if isinstance(spec, WalkSpec):
        height = spec.height or float(rng.uniform(*_EYE_HEIGHTS_M))
        return [
            SimulatedAgent(
                request.name,
                MotionPreferences("person", spec.speed, spec.pauses),
                height,
                max_head_rate=spec.turns,
            )
        ]
    if isinstance(spec, RobotSpec):
        preferences = MotionPreferences("robot", spec.speed, spec.pauses)
        return [SimulatedAgent(request.name, preferences, spec.height, vibration=spec.vibration)]
    return []


def _floor_within(floor: Floor, size: tuple[float, float]) -> Floor:
    """Return the floor with walls around the part within `size` m of its corner."""
    shape = np.array(floor.clearance.shape)
    positions = [floor.origin + np.arange(n) * floor.step for n in shape]
    beyond = np.minimum(size[0] - positions[0][:, None], size[1] - positions[1][None, :])
    return replace(floor, clearance=np.minimum(floor.clearance, beyond.clip(0)))


def _gaze_targets(layout: Layout, rng: np.random.Generator) -> F64:
    """Return points (K, 3) m of the furniture as gaze targets."""
    pieces = [p for p in layout.pieces if p.bounding_box[1, 2] > _GAZE_TARGET_HEIGHTS_M[0]]
    if not pieces:
        return rng.uniform((0, 0, 1.0), (*layout.size[:2], 1.8), (_GAZE_TARGETS, 3))
    vertices_of = [pieces[i].shape.mesh.vertices for i in rng.integers(len(pieces), size=_GAZE_TARGETS)]
    points = np.array([v[rng.integers(len(v))] for v in vertices_of], np.float64)
    points[:, 2] = points[:, 2].clip(*_GAZE_TARGET_HEIGHTS_M)
    return points
