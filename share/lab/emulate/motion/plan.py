"""Who moves where in a room: from what a user asks for to paths that touch neither it nor each other.

specs -> recorded motions are placed, what stands in their way leaves -> simulated ones go around them
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path as File

import numpy as np

from share.errors import UsageError
from share.geometry.camera import ImuNoise
from share.lab.emulate.motion import board, paper
from share.lab.emulate.motion.crowd import Member, Present, crowd, present_of
from share.lab.emulate.motion.floor import Floor, floor_of
from share.lab.emulate.motion.place import APART_M, Guest, place
from share.lab.emulate.motion.spec import (
    BoardSpec,
    EurocSpec,
    PaperSpec,
    RecordedSpec,
    RobotSpec,
    Spec,
    TumSpec,
    WalkSpec,
    parse,
)
from share.lab.emulate.motion.together import PEOPLE_M, Ground, Wish
from share.lab.emulate.motion.tum import read_path
from share.lab.emulate.types import Path
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.occupancy import Occupancy
from share.types import F64, I64, AgentKind

_SHORTEST_S, _LONGEST_S = 3.0, 3600.0
_THINGS = 150  # to look at
_THING_HEIGHTS_M = (0.3, 2.3)
_EYES_M = (1.60, 1.75)
_PAPER_SPACE_M = (9.0, 6.0)


@dataclass(frozen=True, eq=False)
class Agent:
    """One who moves. look: what the others see of it, `person`, `robot` or `drone`.

    T_body_cam0 (4, 4): how the camera sits on the body, where a recorded motion brings its own rig, else
    None: the sensor's profile says (a simulated body is the profile's IMU). images_ns (M,): stamps of
    the recorded images, where there are any; imu: noise of the recorded IMU. spec: what the user asked
    for. notes: for a person. like_camera: the body has a camera's axes, x right, y down, z ahead.
    """

    name: str
    kind: AgentKind
    look: str
    path: Path
    spec: str
    T_body_cam0: F64 | None = None
    images_ns: I64 | None = None
    imu: ImuNoise | None = None
    notes: tuple[str, ...] = ()
    like_camera: bool = False


@dataclass(frozen=True, eq=False)
class Plan:
    """layout: the room, less what stood in the way of recorded flights. Paths begin together: each
    one's start_ns is the session's first instant, in a clock of its own. notes: for a person."""

    layout: Layout
    agents: tuple[Agent, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Asked:
    """One spec with the name of its agent and how the user wrote it."""

    name: str
    spec: Spec
    text: str


def plan(specs: Sequence[str], layout: Layout, seconds: float, seed: int) -> Plan:
    """The agents of `specs` (`[NAME=]SPEC`) in the room, for `seconds`; the same every time for a seed.

    Raises UsageError for a spec that cannot be understood, a name given twice, or paths for which the
    room has no place, DataError for a recording that is damaged.
    """
    if not _SHORTEST_S <= seconds <= _LONGEST_S:
        raise UsageError(f"{seconds:g} seconds: a session lasts {_SHORTEST_S:g} to {_LONGEST_S:g} seconds")
    asked = _named(specs)
    recorded = [_recorded(a, seconds) for a in asked if isinstance(a.spec, RecordedSpec)]
    guests = [Guest(agent.name, agent.look, agent.path) for agent in recorded]
    layout, paths, notes = place(layout, guests, (seed, 71)) if guests else (layout, [], [])
    agents = [replace(agent, path=path) for agent, path in zip(recorded, paths, strict=True)]
    agents += [_at_board(a, a.spec, layout, seconds, seed) for a in asked if isinstance(a.spec, BoardSpec)]
    agents += _simulated(asked, layout, [_present(agent) for agent in agents], seconds, seed)
    order = [name for a in asked for name in _names(a)]
    if any(isinstance(a.spec, PaperSpec) for a in asked) and seconds != paper.SECONDS:
        notes = [*notes, f"an experiment of the paper lasts {paper.SECONDS:g} s"]
    return Plan(layout, tuple(sorted(agents, key=lambda a: order.index(a.name))), tuple(notes))


def _named(specs: Sequence[str]) -> list[_Asked]:
    """Specs with names: the user's, else the kind's with a number. Raises UsageError."""
    if not specs:
        raise UsageError("nobody moves; give at least one --motion, for example walk:")
    asked: list[_Asked] = []
    for text in specs:
        name, spec = parse(text)
        if isinstance(spec, PaperSpec) and (name or len(specs) > 1):
            raise UsageError(
                f"'{text}': paper:N brings its own three agents; give it alone and without a name"
            )
        asked.append(_Asked(name or _free_name(text.partition(":")[0], asked), spec, text))
    names = [name for a in asked for name in _names(a)]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"two agents are named '{name}'; give each its own name")
    return asked


def _names(asked: _Asked) -> tuple[str, ...]:
    return paper.NAMES if isinstance(asked.spec, PaperSpec) else (asked.name,)


def _free_name(kind: str, asked: Sequence[_Asked]) -> str:
    taken = {a.name for a in asked}
    return next(name for k in range(1, len(taken) + 2) if (name := f"{kind}{k}") not in taken)


def _recorded(asked: _Asked, seconds: float) -> Agent:
    """A recording's motion where it was recorded, no longer than the session."""
    spec = asked.spec
    assert isinstance(spec, RecordedSpec)
    longest = min(seconds, spec.seconds or seconds)
    kind = AgentKind(spec.kind)
    if isinstance(spec, TumSpec):
        path: Path = read_path(File(spec.path), spec.start, longest)
        return Agent(asked.name, kind, spec.look, path, asked.text, notes=_short(path, seconds))
    from share.lab.emulate.motion import sources

    options = sources.EUROC if isinstance(spec, EurocSpec) else sources.TUMVI
    found = sources.open_recording(File(spec.path), options, spec.start, longest)
    notes = (*found.notes, *_short(found.path, seconds))
    mount, stamps = found.T_body_cam0, found.images_ns
    return Agent(asked.name, kind, spec.look, found.path, asked.text, mount, stamps, found.noise, notes)


def _at_board(asked: _Asked, spec: BoardSpec, layout: Layout, seconds: float, seed: int) -> Agent:
    """A device in a hand before the room's board; each name's motion is its own."""
    rng = np.random.default_rng((seed, 74, zlib.crc32(asked.name.encode())))
    path = board.exercise(layout, spec, min(seconds, spec.seconds or seconds), rng)
    notes = _short(path, seconds)
    return Agent(asked.name, AgentKind.AR, "drone", path, asked.text, notes=notes, like_camera=True)


def _short(path: Path, seconds: float) -> tuple[str, ...]:
    lasts = (path.end_ns - path.start_ns) / 1e9
    return (f"ends after {lasts:.1f} s",) if lasts < seconds - 0.5 else ()


def _present(agent: Agent) -> Present:
    return present_of(agent.path, PEOPLE_M if agent.look == "person" else APART_M)


def _simulated(
    asked: Sequence[_Asked], layout: Layout, present: Sequence[Present], seconds: float, seed: int
) -> list[Agent]:
    """People and robots, and the paper's three."""
    members: list[Member] = []
    texts: list[str] = []
    rng = np.random.default_rng((seed, 72))
    for a in asked:
        own = _members(a, rng)
        members += own
        texts += [a.text] * len(own)
    if not members:
        return []
    floor = floor_of(Occupancy.of(layout))
    if any(isinstance(a.spec, PaperSpec) for a in asked):
        floor, seconds = _inside(floor, _PAPER_SPACE_M), paper.SECONDS
    paths = crowd(Ground(floor), members, present, _things(layout, rng), seconds, (seed, 73))
    kinds = {"person": AgentKind.AR, "robot": AgentKind.ROBOT}
    return [
        Agent(m.name, kinds[m.wish.look], m.wish.look, path, text, like_camera=True)
        for m, path, text in zip(members, paths, texts, strict=True)
    ]


def _members(asked: _Asked, rng: np.random.Generator) -> list[Member]:
    spec = asked.spec
    if isinstance(spec, PaperSpec):
        return paper.members(spec.number)
    if isinstance(spec, WalkSpec):
        height = spec.height or float(rng.uniform(*_EYES_M))
        return [Member(asked.name, Wish("person", spec.speed, spec.pauses), height, turns=spec.turns)]
    if isinstance(spec, RobotSpec):
        wish = Wish("robot", spec.speed, spec.pauses)
        return [Member(asked.name, wish, spec.height, vibration=spec.vibration)]
    return []


def _inside(floor: Floor, size: tuple[float, float]) -> Floor:
    """The part of a floor within `size` m of its corner: what lies beyond is as a wall."""
    shape = np.array(floor.clearance.shape)
    there = [floor.origin + np.arange(n) * floor.step for n in shape]
    beyond = np.minimum(size[0] - there[0][:, None], size[1] - there[1][None, :])
    return replace(floor, clearance=np.minimum(floor.clearance, beyond.clip(0)))


def _things(layout: Layout, rng: np.random.Generator) -> F64:
    """Points (K, 3) m of the furniture that draw a look."""
    pieces = [p for p in layout.pieces if p.bounds[1, 2] > _THING_HEIGHTS_M[0]]
    if not pieces:
        return rng.uniform((0, 0, 1.0), (*layout.size[:2], 1.8), (_THINGS, 3))
    chosen = [pieces[i].shape.mesh.vertices for i in rng.integers(len(pieces), size=_THINGS)]
    points = np.array([v[rng.integers(len(v))] for v in chosen], np.float64)
    points[:, 2] = points[:, 2].clip(*_THING_HEIGHTS_M)
    return points
