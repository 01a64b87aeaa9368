"""A real edge and real agents in virtual time, in a room of points; only cameras and sockets are missing."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from helpers.hellos import hello_of

from share.config import Config, EdgeConfig
from share.geometry import se3
from share.geometry.se3 import umeyama
from share.mapping.corrections import MapEvent
from share.mapping.graph.solver import PoseGraphSolver
from share.mapping.mapper import Mapper
from share.mapping.steps import SolveStep, Step
from share.protocol import agent_events as ev
from share.protocol import edge_events as ed
from share.protocol.agent import AgentProtocol
from share.protocol.common_events import EdgeMessageReceived, SendToEdge, Tick
from share.protocol.edge import EdgeProtocol
from share.types import F64, U8, AgentKind, Keyframe, OdometryKeyframe, TrackState, View
from share.wire.codec import decode
from share.wire.messages import Hello, peer_id

MS = 1_000_000
FOCAL = 400.0
_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # camera axes in (ahead, left, up)


@dataclass(frozen=True)
class Walls:
    """Points (n, 3) on the walls of an 8 x 6 x 3 m room, each with a descriptor of its own."""

    points: F64
    descriptors: U8


def walls(seed: int, n: int = 4000) -> Walls:
    rng = np.random.default_rng(seed)
    size = np.array([8.0, 6.0, 3.0])
    points = rng.uniform(0, size, (n, 3))
    axis = rng.integers(0, 2, n)
    points[np.arange(n), axis] = size[axis] * rng.integers(0, 2, n)
    return Walls(points, rng.integers(0, 256, (n, 32), np.uint8))


def look(place: Walls, T_world_cam: F64, rng: np.random.Generator) -> View:
    """Up to 300 of the points in view, as stereo sees them: 0.5 px, and 1 % of inverse depth."""
    seen = se3.transform(se3.inverse(T_world_cam), place.points)
    uv = seen[:, :2] / np.where(seen[:, 2:] > 0.3, seen[:, 2:], np.nan)
    visible = np.flatnonzero((np.abs(uv) < (0.8, 0.6)).all(axis=1))[:300]
    uv = uv[visible] + rng.normal(0, 0.5 / FOCAL, (len(visible), 2))
    rho = 1 / seen[visible, 2] + rng.normal(0, 0.003, len(visible))
    flips = np.packbits(rng.random((len(visible), 256)) < 0.04, axis=1)
    return View(
        uv, np.column_stack([uv, np.ones(len(uv))]) / rho[:, None], place.descriptors[visible] ^ flips
    )


@dataclass
class Weather:
    """What a network does to messages: lost, doubled, late by `delay_ms` (from, to), but some `at_once`."""

    seed: int
    loss: float = 0.0
    twice: float = 0.0
    at_once: float = 0.0
    delay_ms: tuple[float, float] = (2.0, 2.0)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)

    def delays_ns(self) -> list[int]:
        """Return the delay of each copy that arrives."""
        rng, (least, most) = self._rng, self.delay_ms
        out = []
        for _ in range(1 + int(self.twice > 0 and rng.random() < self.twice)):
            if rng.random() >= self.loss:
                late = most > least and rng.random() >= self.at_once
                out.append(round((rng.uniform(least, most) if late else least) * MS))
        return out


@dataclass
class Person:
    """Walks round the room; body = camera. Odometry starts where it stands, and drifts a little."""

    name: str
    place: Walls
    start: float
    run_id: int
    kind: AgentKind = AgentKind.AR
    cov: F64 = field(default_factory=lambda: 4e-6 * np.eye(6))
    T_world_body: list[F64] = field(default_factory=list)
    T_odom_body: list[F64] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.run_id)

    @property
    def hello(self) -> Hello:
        return hello_of(self.name, self.run_id, self.kind, focal=FOCAL)

    def stamp_ns(self, now_ns: int) -> int:
        return now_ns

    def step(self) -> tuple[F64, View]:
        """0.2 m on along a ring, looking at the wall outside. Returns T_odom_body and the view."""
        angle = self.start + 0.1 * len(self.T_world_body)
        R = se3.so3_exp(np.array([0, 0, angle])) @ _FORWARD
        T = se3.from_rt(R, np.array([4 + 1.5 * np.cos(angle), 3 + 1.0 * np.sin(angle), 1.5]))
        if self.T_world_body:
            moved = se3.inverse(self.T_world_body[-1]) @ T @ se3.exp(self.rng.normal(0, 1, 6) * 0.002)
            self.T_odom_body.append(self.T_odom_body[-1] @ moved)
        else:
            self.T_odom_body.append(se3.from_rt(_FORWARD, np.zeros(3)))
        self.T_world_body.append(T)
        return self.T_odom_body[-1], look(self.place, T, self.rng)


class ModelRun:
    """One life of the edge: both machines, as `share.runtime.served_room` has them, without processes."""

    def __init__(self, config: Config, session: int) -> None:
        self.machine = EdgeProtocol(config, session)
        self.mapper = Mapper(config)
        self.solver = PoseGraphSolver()

    def report(self) -> dict[str, Any]:
        return self.machine.report(self.mapper.report())


class Town:
    """Everybody, their edge, and 2 ms between them. `job_ms` is how long the worker takes."""

    def __init__(
        self,
        people: list[Person],
        session: int = 1,
        job_ms: float = 5,
        config: Config | None = None,
        weather: Weather | None = None,
    ):
        self.config = config or Config(edge=EdgeConfig(policy="covins-g"))  # everything is sent and merged
        self.weather = weather or Weather(0)
        self.people: dict[bytes, Person] = {}
        self.agents: dict[bytes, AgentProtocol] = {}
        self.agent_effects: dict[bytes, list[ev.AgentEffect]] = {}
        for person in people:
            self.arrive(person)
        self.edge: ModelRun | None = ModelRun(self.config, session)
        self.records: list[dict[str, object]] = []
        self.now_ns = 0
        self._job_ns = round(job_ms * MS)
        self._later: deque[tuple[int, Callable[[], None]]] = deque()

    def arrive(self, person: Person) -> None:
        peer = peer_id(person.run_id)
        self.people[peer], self.agents[peer] = person, AgentProtocol(person.hello, self.config)
        self.agent_effects[peer] = []

    def vanish(self, name: str) -> None:
        """As a process that is killed."""
        peer = self.peer(name)
        del self.people[peer], self.agents[peer]

    def keyframes(self, name: str) -> list[Keyframe]:
        """Those that the agent sent, in order."""
        messages = [decode([bytes(f) for f in e.frames]) for e in self.event(SendToEdge, name)]
        return [message for message in messages if isinstance(message, Keyframe)]

    def event(self, effect_type: type, name: str) -> list:
        return [e for e in self.agent_effects[self.peer(name)] if isinstance(e, effect_type)]

    def peer(self, name: str) -> bytes:
        return next(peer for peer, p in self.people.items() if p.name == name)

    def walk(self, frames: int, who: list[str] | None = None) -> None:
        """`frames` steps of 250 ms, every one of them a keyframe."""
        for _ in range(frames):
            for peer, person in self.people.items():
                if who is None or person.name in who:
                    self._frame(peer, person)
            self.run(250)

    def run(self, ms: float) -> None:
        until = self.now_ns + round(ms * MS)
        while self.now_ns < until:
            self.now_ns += MS
            due = [act for at, act in self._later if at <= self.now_ns]
            self._later = deque((at, act) for at, act in self._later if at > self.now_ns)
            for act in due:
                act()
            if self.now_ns % (50 * MS) == 0:
                self.to_edge(Tick())
                for peer in list(self.agents):
                    self.to_agent(peer, ev.AgentTick())

    def to_edge(self, event: ed.EdgeEvent) -> None:
        edge = self.edge
        for effect in edge.machine.handle(event, self.now_ns) if edge else ():
            match effect:
                case ed.SendToPeer(peer, frames):
                    copy = [bytes(f) for f in frames]
                    for late in self.weather.delays_ns():
                        self._in(
                            late,
                            lambda peer=peer, copy=copy: self.to_agent(peer, EdgeMessageReceived(copy)),
                        )
                case ed.AddRun(key, hello):
                    edge.mapper.add_run(key, hello)
                case ed.SetPresence(key, here):
                    edge.mapper.set_present(key, here)
                    self._mapped(edge, [])
                case ed.AddKeyframe(key, keyframe, is_extra):
                    self._mapped(edge, edge.mapper.add_keyframe(key, keyframe, is_extra))
                case ed.DropRun(key):
                    edge.mapper.remove_run(key)
                case ed.SaveChanges():
                    self.save(edge, effect)
                case ed.WriteEvent(fields):
                    self.records.append(fields)

    def save(self, edge: ModelRun, effect: ed.SaveChanges) -> None:
        """This edge has no map file."""

    def _mapped(self, edge: ModelRun, map_events: list[MapEvent]) -> None:
        """The mapper has decided something, and goes on to its next steps, each in its own time."""
        if self.edge is not edge:
            return
        if found := ed.MapperResult(
            tuple(map_events), edge.mapper.take_changes(), edge.mapper.take_empty_runs()
        ):
            self._in(0, lambda: self.to_edge(found) if self.edge is edge else None)
        for step in (edge.mapper.next_lookup(), edge.mapper.next_solve()):
            if step is not None:
                result = step.run(edge.solver) if isinstance(step, SolveStep) else step.run()
                self._in(self._job_ns, lambda step=step, result=result: self._done(edge, step, result))

    def _done(self, edge: ModelRun, step: Step, result: object) -> None:
        self._mapped(edge, edge.mapper.finish_step(step, result, self._job_ns / MS))

    def to_agent(self, peer: bytes, event: ev.AgentEvent) -> None:
        agent = self.agents.get(peer)
        for effect in agent.handle(event, self.now_ns) if agent else ():
            self.agent_effects[peer].append(effect)
            if isinstance(effect, SendToEdge):
                frames = [bytes(f) for f in effect.frames]
                for late in self.weather.delays_ns():
                    self._in(late, lambda frames=frames: self.to_edge(ed.PeerMessageReceived(peer, frames)))

    def map_error_m(self, name: str, T_world_map: F64) -> float:
        """How far the agent's last pose in the map lies from the truth."""
        last = self.event(ev.LocalisedPose, name)[-1]
        assert last.T_map_odom is not None
        found = T_world_map @ last.T_map_odom @ last.T_odom_body
        return float(np.linalg.norm(found[:3, 3] - self.people[self.peer(name)].T_world_body[-1][:3, 3]))

    def map_error(self, names: Collection[str]) -> float:
        """Return the RMSE, m, of all keyframes of these agents, aligned as one; inf unless in one map."""
        assert self.edge is not None
        kept = self.edge.mapper.current_poses()
        reported = {p.name: p.T_world_body for p in self.people.values() if p.name in names}
        owners = {key.agent: key.agent.rpartition("-")[0] for key in kept.keys}  # a run: name-tag
        truth = {run: reported[name] for run, name in owners.items() if name in reported}
        which = [i for i, key in enumerate(kept.keys) if key.agent in truth]
        if len({kept.map_ids[i] for i in which}) > 1:
            return float("inf")
        found = kept.T_map_body[which, :3, 3]
        true = np.array([truth[kept.keys[i].agent][kept.keys[i].id][:3, 3] for i in which])
        gap = se3.transform(umeyama(found, true), found) - true
        return float(np.sqrt((gap**2).sum(axis=1).mean()))

    def _frame(self, peer: bytes, person: Person) -> None:
        T, view = person.step()
        k = len(person.T_world_body) - 1
        at = self.now_ns
        tracked = ev.FrameTracked(k, person.stamp_ns(at), at, at + 4 * MS, TrackState.OK, T, True, k == 0)
        self.to_agent(peer, tracked)
        T_last_body = T if k == 0 else se3.inverse(person.T_odom_body[-2]) @ T
        candidate = OdometryKeyframe(T, T_last_body, person.cov, np.zeros(3), 0.0, view, k == 0)
        self.to_agent(peer, ev.KeyframeMade(tracked, candidate))

    def _in(self, ns: int, act: Callable[[], None]) -> None:
        self._later.append((self.now_ns + ns, act))
