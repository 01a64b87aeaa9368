"""A room in virtual time: real agents, a real edge and mapper, and between them networks, queues and costs.

What is decided is decided by the machines themselves; how long it takes is drawn from what was measured. So
a run says what latency would be on machines that nobody else uses, and the same seed gives the same run.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any, Protocol

import numpy as np

from share.config import Config
from share.mapping.changes import Change
from share.mapping.graph.solver import Solver
from share.mapping.loops import Key
from share.mapping.mapper import Mapper
from share.mapping.recognition.verification import Verified
from share.mapping.steps import Finding
from share.metrics.frame_log import RunLog
from share.net.channel import Channel, Network
from share.protocol import agent_events as ev
from share.protocol import edge_events as ed
from share.protocol.agent import Agent
from share.protocol.edge import Edge
from share.types import F64, Candidate, Keyframe, TrackState
from share.wire.codec import Bytes, size
from share.wire.messages import Hello, peer_id

_MS = 1_000_000
_TICK_MS = 50
_AT_ONCE = 1000  # random numbers


@dataclass(frozen=True)
class Cost:
    """ms, lognormal: half of all take less than `p50`, 95 % less than `p95`."""

    p50: float
    p95: float

    def draw_ns(self, normal: float) -> int:
        """normal: drawn from a standard normal distribution."""
        sigma = math.log(max(1.0, self.p95 / self.p50)) / 1.645
        return round(self.p50 * math.exp(sigma * normal) * _MS)


@dataclass(frozen=True)
class Sampled:
    """ms, as they were measured: the least, the most, and what so many equal parts lie between."""

    ms: tuple[float, ...]

    def draw_ns(self, normal: float) -> int:
        """normal: drawn from a standard normal distribution."""
        below = 0.5 * (1 + math.erf(normal / math.sqrt(2)))
        return round(float(np.interp(below * (len(self.ms) - 1), range(len(self.ms)), self.ms)) * _MS)


# Of keyframes' work after a frame, none after half of them: 1,301 frames of four recordings.
_SLICES = Sampled((*[0.0] * 11, 0.45, 2.2, 2.7, 3.5, 4.0, 4.7, 5.3, 5.6, 5.9, 8.2))


@dataclass(frozen=True)
class Costs:
    """Of a frame at the agent until its pose is out, of a keyframe from then until it may be sent, and of the
    slice of keyframes' work that may come after any frame; of a message at the edge's front; of what its
    mapper and its solver do. Defaults: docs/scheduling-figures.md."""

    frame: Cost = Cost(4.3, 5.4)
    keyframe: Cost = Cost(3.9, 4.7)
    settle: Cost | Sampled = _SLICES
    front: Cost = Cost(0.3, 1.0)
    add: Cost = Cost(0.4, 0.8)
    query: Cost = Cost(3.0, 5.0)
    accepted: Cost = Cost(4.0, 6.0)
    refused: Cost = Cost(2.0, 5.0)
    judge: Cost = Cost(1.3, 10.0)
    solve: Cost = Cost(14.0, 32.0)
    apply: Cost = Cost(2.2, 4.0)


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame: when it comes in, where odometry says it is, how wrong that is, and what it shows others, if
    it is offered as a keyframe. stamp_ns: of its sensor; None: as at_ns. breaks: odometry began anew."""

    at_ns: int
    T_odom_body: F64 | None
    error_cm: float | None = None
    candidate: Candidate | None = None
    stamp_ns: int | None = None
    state: TrackState = TrackState.OK
    breaks: bool = False


class AnyMapper(Protocol):
    """`share.mapping.mapper.Mapper`, or `share.lab.evaluate.modelled_mapper.ModelledMapper`."""

    def join(self, agent: str, hello: Hello) -> None: ...
    def present(self, agent: str, here: bool) -> None: ...
    def add(self, agent: str, keyframe: Keyframe, is_extra: bool = False) -> list[Finding]: ...
    def next_look(self) -> Any: ...
    def next_solve(self) -> Any: ...
    def done(self, step: Any, result: Any, ms: float) -> list[Finding]: ...
    def take_changes(self) -> tuple[Change, ...]: ...
    def report(self) -> dict[str, Any]: ...


class World:
    """Everybody in one room. agents: what each says of itself and sees, and its network. The clock of all
    is the world's."""

    def __init__(
        self,
        config: Config,
        agents: Sequence[tuple[Hello, Iterator[Seen], Network]],
        costs: Costs,
        seed: int,
        mapper: AnyMapper | None = None,
        watch: Callable[[str, ev.AgentEffect], None] = lambda name, effect: None,
        record: Callable[[dict[str, Any]], None] = lambda fields: None,
    ) -> None:
        """mapper: by default a real one. watch: is told what every agent does, by name; record: what the edge
        decides."""
        self.now_ns = 0
        self.stamps_ns: dict[Key, int] = {}  # of the keyframes that the mapper has had
        self.mapping_ns = self.solving_ns = 0  # that the mapper and the solver have worked
        self.logs = {hello.name: RunLog() for hello, *_ in agents}
        self.placed: dict[str, list[ev.Localised]] = {hello.name: [] for hello, *_ in agents}  # in a map
        self._watch, self._record = watch, record
        rng = np.random.default_rng(seed)
        self._costs, self._normals = costs, _normals(rng)
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = count()
        self._members: dict[bytes, _Member] = {}
        for hello, looks, network in agents:
            member = _Member(hello, Agent(hello, config), looks, network, rng.spawn(2))
            self._members[member.peer] = member
            self._next_look(member)
        self.edge = Edge(config, session=1)
        self.mapper: AnyMapper = Mapper(config) if mapper is None else mapper
        self._solver = Solver(config.graph)
        self._inbox: deque[tuple[Cost, Callable[[], list[Finding]]]] = deque()  # the mapper's
        self._is_busy = False  # the mapper's process
        self._in(0, self._tick)

    def run(self, until_s: float) -> None:
        """Everything until then."""
        end_ns = round(until_s * 1e9)
        while self._events and self._events[0][0] <= end_ns:
            self.now_ns, _, act = heapq.heappop(self._events)
            act()

    def reports(self) -> dict[str, dict[str, Any]]:
        """What each agent's machine has counted, by name."""
        return {member.name: member.machine.report() for member in self._members.values()}

    def _in(self, ns: int, act: Callable[[], None]) -> None:
        heapq.heappush(self._events, (self.now_ns + ns, next(self._order), act))

    def _draw(self, cost: Cost | Sampled) -> int:
        return cost.draw_ns(next(self._normals))

    def _tick(self) -> None:
        for member in self._members.values():
            self._to_agent(member, ev.Tick())
        self._to_edge(ed.Tick())
        self._in(_TICK_MS * _MS, self._tick)

    # ------------------------------------------------------------------ agents

    def _next_look(self, member: _Member) -> None:
        if (look := next(member.looks, None)) is not None:
            self._in(max(0, look.at_ns - self.now_ns), lambda: self._arrive(member, look))

    def _arrive(self, member: _Member, look: Seen) -> None:
        """A frame waits until those before it are done, as in the agent's tracking thread."""
        begin_ns = max(self.now_ns, member.busy_ns)
        done_ns = begin_ns + self._draw(self._costs.frame)
        member.busy_ns = done_ns
        frame = ev.FrameTracked(
            index=member.frames,
            stamp_ns=look.at_ns if look.stamp_ns is None else look.stamp_ns,
            arrived_ns=look.at_ns,
            done_ns=done_ns,
            state=look.state,
            T_odom_body=look.T_odom_body,
            keyframe=look.candidate is not None,
            new_stretch=look.breaks or member.frames == 0,
            error_cm=look.error_cm,
        )
        member.frames += 1
        self._in(done_ns - self.now_ns, lambda: self._to_agent(member, frame))
        if (candidate := look.candidate) is not None:
            member.busy_ns += self._draw(self._costs.keyframe)
            made = ev.KeyframeMade(frame, candidate)
            self._in(member.busy_ns - self.now_ns, lambda: self._to_agent(member, made))
        member.busy_ns += self._draw(self._costs.settle)
        self._next_look(member)

    def _to_agent(self, member: _Member, event: ev.AgentEvent) -> None:
        log = self.logs[member.name]
        for effect in member.machine.handle(event, self.now_ns):
            self._watch(member.name, effect)
            match effect:
                case ev.Send():
                    self._send_up(member, effect.frames)
                case ev.Localised() if effect.T_map_odom is not None:
                    self.placed[member.name].append(effect)
                case ev.FrameDone():
                    log.add(effect.stamp_ns, effect.track_ms, effect.state, effect.keyframe, effect.sent)
                case ev.CorrectionApplied():
                    if effect.stamp_ns is not None and effect.corrected_ms is not None:
                        log.mark_corrected(effect.stamp_ns, effect.corrected_ms)

    def _send_up(self, member: _Member, frames: Sequence[Bytes]) -> None:
        arrival_ns = member.up.arrival_ns(size(frames), self.now_ns) + self._draw(self._costs.front)
        self._in(arrival_ns - self.now_ns, lambda: self._to_edge(ed.Received(member.peer, frames)))

    # ------------------------------------------------------------------ the edge

    def _to_edge(self, event: ed.Event) -> None:
        for effect in self.edge.handle(event, self.now_ns):
            match effect:
                case ed.Send():
                    self._send_down(effect)
                case ed.Join() | ed.Present() | ed.Add():
                    self._tell_mapper(self._costs.add, partial(self._hear, effect))
                case ed.Record():
                    self._record(effect.fields)

    def _send_down(self, effect: ed.Send) -> None:
        member, frames = self._members[effect.peer], effect.frames
        arrival_ns = member.down.arrival_ns(size(frames), self.now_ns)
        self._in(arrival_ns - self.now_ns, lambda: self._to_agent(member, ev.Received(frames)))

    def _hear(self, message: ed.Join | ed.Present | ed.Add) -> list[Finding]:
        if isinstance(message, ed.Add):
            self.stamps_ns[Key(message.key, message.keyframe.id)] = message.keyframe.stamp_ns
            return self.mapper.add(message.key, message.keyframe, message.is_extra)
        if isinstance(message, ed.Present):
            self.mapper.present(message.key, message.here)
        else:
            self.mapper.join(message.key, message.hello)
        return []

    # ---------------------------------------------------------------- the mapper, as in share.runtime.mapper

    def _tell_mapper(self, cost: Cost, what: Callable[[], list[Finding]]) -> None:
        self._inbox.append((cost, what))
        if not self._is_busy:
            self._turn()

    def _turn(self) -> None:
        """One round: hear everything, hand a map to the solver, say what came of it, look something up."""
        self._is_busy = True
        findings, spent_ns = list[Finding](), 0
        while self._inbox:
            cost, what = self._inbox.popleft()
            findings += what()
            spent_ns += self._draw(cost)
        self.mapping_ns += spent_ns
        self._begin_solving(spent_ns)
        self._in(spent_ns, lambda: self._tell_front(findings))
        look = self.mapper.next_look()
        if look is None:
            self._in(spent_ns, self._rest)
            return
        seen = _result(look.run)
        look_ns = self._draw(self._cost_of(look, seen))
        self.mapping_ns += look_ns
        self._in(spent_ns + look_ns, lambda: self._looked(look, seen))

    def _looked(self, look: Any, seen: object) -> None:
        self._tell_front(self.mapper.done(look, seen, 0.0))
        self._turn()

    def _rest(self) -> None:
        self._is_busy = False
        if self._inbox:
            self._turn()

    def _begin_solving(self, after_ns: int) -> None:
        if (step := self.mapper.next_solve()) is not None:
            result = _result(partial(step.run, self._solver))
            taken_in = partial(self.mapper.done, step, result, 0.0)
            solve_ns = self._draw(self._costs.solve)
            self.solving_ns += solve_ns
            self._in(after_ns + solve_ns, lambda: self._tell_mapper(self._costs.apply, taken_in))

    def _cost_of(self, look: Any, seen: object) -> Cost:
        if look.kind == "place":
            return self._costs.query
        found, judged = self._costs.accepted, self._costs.judge
        if isinstance(seen, Verified):
            return Cost(found.p50 + judged.p50, found.p95 + judged.p95)
        return self._costs.refused

    def _tell_front(self, findings: list[Finding]) -> None:
        changes = self.mapper.take_changes()
        if findings or changes:
            self._to_edge(ed.Found(tuple(findings), changes))


def _normals(rng: np.random.Generator) -> Iterator[float]:
    """One by one, drawn many at a time."""
    while True:
        yield from rng.standard_normal(_AT_ONCE).tolist()


def _result(work: Callable[[], object]) -> object:
    """An exception is a result, as in the mapper's process."""
    try:
        return work()
    except Exception as error:
        return error


class _Member:
    """An agent, what it still has to see, and its network. busy_ns: until when it tracks what came so far."""

    def __init__(
        self,
        hello: Hello,
        machine: Agent,
        looks: Iterator[Seen],
        network: Network,
        rngs: list[np.random.Generator],
    ) -> None:
        self.name, self.peer = hello.name, peer_id(hello.run_id)
        self.machine, self.looks = machine, looks
        self.up = Channel(network.up, network.round_trip_ms, rngs[0])
        self.down = Channel(network.down, network.round_trip_ms, rngs[1])
        self.busy_ns = self.frames = 0
