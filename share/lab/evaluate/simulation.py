"""Discrete-event simulation of a room: real agents, edge and mapper with simulated networks, queues and
delays.

The state machines make all decisions; how long each step takes is drawn from measured distributions.
Latencies are thus those of otherwise idle machines, and a run is deterministic for a given seed.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any

import numpy as np

from share.config import Config
from share.lab.evaluate.emulated_network import Channel, NetworkModel
from share.lab.evaluate.processing_delays import MS_NS, Delay, MeasuredDelay, ProcessingDelays
from share.lab.evaluate.shared_air import SharedAir
from share.mapping.corrections import MapEvent
from share.mapping.graph.solver import PoseGraphSolver
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import StoredMap
from share.mapping.mapper import Mapper
from share.mapping.recognition.verification import Verification
from share.mapping.steps import AlignStep, DescribeStep, IndexStep, QueryStep, VerifyStep
from share.metrics.frame_log import RunLog
from share.protocol import agent_events as ev
from share.protocol import edge_events as ed
from share.protocol.agent import AgentProtocol
from share.protocol.common_events import EdgeMessageReceived, SendToEdge, Tick
from share.protocol.edge import EdgeProtocol
from share.protocol.peer import restored_runs
from share.store.keyframe_archive import KeyframeArchive
from share.store.map_store import MapStore
from share.types import F64, OdometryKeyframe, TrackState
from share.wire.codec import message_bytes
from share.wire.layouts import Bytes
from share.wire.messages import Hello, peer_id

_TICK_MS = 50
_RANDOM_BATCH = 1000
_ACCESS_POINT = ""  # a station beside the agents, which go by name


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A tracked frame: its arrival time, odometry pose and tracking error, and its keyframe candidate, if
    any.

    `stamp_ns`: the sensor's stamp, None for `arrival_ns`. `new_segment`: odometry began anew with this frame.
    `cov`: of the pose, as in `TrackResult`.
    """

    arrival_ns: int
    T_odom_body: F64 | None
    error_cm: float | None = None
    candidate: OdometryKeyframe | None = None
    stamp_ns: int | None = None
    state: TrackState = TrackState.OK
    new_segment: bool = False
    cov: F64 | None = None


class Simulation:
    """A simulated room. All agents share the simulation's clock."""

    def __init__(
        self,
        config: Config,
        agents: Sequence[tuple[Hello, Iterator[TrackedFrame], NetworkModel]],
        delays: ProcessingDelays,
        seed: int,
        mapper: Mapper | None = None,
        on_effect: Callable[[str, ev.AgentEffect], None] = lambda name, effect: None,
        on_record: Callable[[dict[str, Any]], None] = lambda fields: None,
        store: MapStore | None = None,
    ) -> None:
        """Take each agent's hello, frames and network. `mapper`: a real one by default, or a
        model with its interface. `store`: a map that the edge continues and keeps, as with `--map`; writing
        takes no time.

        `on_effect(name, effect)` is called for every effect of an agent, `on_record(fields)` for every event
        that the edge records.
        """
        self.now_ns = 0
        self.stamps_ns: dict[KeyframeKey, int] = {}  # of keyframes that reached the mapper
        self.mapper_busy_ns = self.solver_busy_ns = 0
        self.logs = {hello.name: RunLog() for hello, *_ in agents}
        self.localised: dict[str, list[ev.LocalisedPose]] = {hello.name: [] for hello, *_ in agents}
        self._on_effect, self._on_record, self._config = on_effect, on_record, config
        rng = np.random.default_rng(seed)
        self._delays, self._random_normals = delays, _random_normals(rng)
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = count()
        self._members: dict[bytes, SimulatedRun] = {}
        for hello, frames, network in agents:
            self._add_member(hello, frames, network, rng.spawn(2))
        self.airs: dict[NetworkModel, SharedAir] = {}  # of the access points
        for network in dict.fromkeys(network for *_, network in agents):
            if network.air is not None:
                self.airs[network] = SharedAir(network.air, rng.spawn(1)[0], self.schedule)
        self._store = store
        self._start_edge(1, mapper)
        self.schedule(0, self._tick)

    def _start_edge(self, session: int, mapper: Mapper | None = None) -> None:
        """Start edge and mapper with what the store keeps, or empty."""
        kept = StoredMap() if self._store is None else self._store.load()
        restored = restored_runs(kept, self._config.merge.enter_m)
        self.edge = EdgeProtocol(
            self._config,
            session,
            has_store=self._store is not None,
            restored=restored,
            forgotten=kept.forgotten,
        )
        archive = None if self._store is None else KeyframeArchive(self._store.path)
        self.mapper = Mapper(self._config, archive) if mapper is None else mapper
        if kept.runs:
            self.mapper.restore(kept)
        self._solver = PoseGraphSolver()
        self._inbox: deque[tuple[Delay, Callable[[], list[MapEvent]]]] = deque()  # of the mapper process
        self._is_busy = False  # the mapper process

    def run(self, until_s: float) -> None:
        """Process all events until `until_s`."""
        end_ns = round(until_s * 1e9)
        while self._events and self._events[0][0] <= end_ns:
            self.now_ns, _, action = heapq.heappop(self._events)
            action()

    def reports(self) -> dict[str, dict[str, Any]]:
        """Return each agent's protocol report, by name."""
        return {member.name: member.machine.report() for member in self._members.values()}

    def schedule(self, delay_ns: int, action: Callable[[], None]) -> None:
        """Call `action` after a delay."""
        heapq.heappush(self._events, (self.now_ns + delay_ns, next(self._order), action))

    def _draw(self, cost: Delay | MeasuredDelay) -> int:
        return cost.draw_ns(next(self._random_normals))

    def _tick(self) -> None:
        for member in self._members.values():
            self._to_agent(member, ev.AgentTick())
        self._to_edge(Tick())
        self.schedule(_TICK_MS * MS_NS, self._tick)

    # Agents.

    def _add_member(
        self,
        hello: Hello,
        frames: Iterator[TrackedFrame],
        network: NetworkModel,
        rngs: list[np.random.Generator],
    ) -> None:
        member = SimulatedRun(hello, AgentProtocol(hello, self._config), frames, network, rngs)
        self._members[member.peer] = member
        self._schedule_next_frame(member)

    def _schedule_next_frame(self, member: SimulatedRun) -> None:
        if (frame := next(member.incoming, None)) is not None:
            self.schedule(max(0, frame.arrival_ns - self.now_ns), lambda: self._frame_arrived(member, frame))

    def _frame_arrived(self, member: SimulatedRun, tracked: TrackedFrame) -> None:
        """Schedule the results of a frame, which waits until earlier frames are done, as in the agent's
        tracking thread."""
        begin_ns = max(self.now_ns, member.busy_until_ns)
        done_ns = begin_ns + self._draw(self._delays.frame)
        member.busy_until_ns = done_ns
        frame = ev.FrameTracked(
            index=member.frames_count,
            stamp_ns=tracked.arrival_ns if tracked.stamp_ns is None else tracked.stamp_ns,
            arrived_ns=tracked.arrival_ns,
            done_ns=done_ns,
            state=tracked.state,
            T_odom_body=tracked.T_odom_body,
            is_keyframe=tracked.candidate is not None,
            new_segment=tracked.new_segment or member.frames_count == 0,
            error_cm=tracked.error_cm,
            cov=tracked.cov,
        )
        member.frames_count += 1
        self.schedule(done_ns - self.now_ns, lambda: self._to_agent(member, frame))
        if (candidate := tracked.candidate) is not None:
            member.busy_until_ns += self._draw(self._delays.keyframe)
            keyframe_event = ev.KeyframeMade(frame, candidate)
            self.schedule(member.busy_until_ns - self.now_ns, lambda: self._to_agent(member, keyframe_event))
        member.busy_until_ns += self._draw(self._delays.finish_keyframe)
        self._schedule_next_frame(member)

    def _to_agent(self, member: SimulatedRun, event: ev.AgentEvent) -> None:
        log = self.logs[member.name]
        for effect in member.machine.handle(event, self.now_ns):
            self._on_effect(member.name, effect)
            match effect:
                case SendToEdge():
                    self._send_up(member, effect.frames)
                case ev.LocalisedPose() if effect.T_map_odom is not None:
                    self.localised[member.name].append(effect)
                case ev.FrameDone():
                    log.add(
                        effect.stamp_ns, effect.track_ms, effect.state, effect.is_keyframe, effect.is_sent
                    )
                case ev.CorrectionApplied():
                    if effect.stamp_ns is not None and effect.corrected_ms is not None:
                        log.add_correction(effect.stamp_ns, effect.corrected_ms)

    def _send_up(self, member: SimulatedRun, frames: Sequence[Bytes]) -> None:
        size = message_bytes(frames)

        def on_air_done() -> None:
            arrival_ns = member.up.arrival_ns(size, self.now_ns) + self._draw(self._delays.receive)
            member.received_ns = max(member.received_ns, arrival_ns)  # in the order of the link
            self.schedule(
                member.received_ns - self.now_ns,
                lambda: self._to_edge(ed.PeerMessageReceived(member.peer, frames)),
            )

        self._over_the_air(member, member.name, size, on_air_done)

    def _over_the_air(self, member: SimulatedRun, station: str, size: int, done: Callable[[], None]) -> None:
        """Call `done` when a message has passed the shared air of this member, at once without one."""
        if (air := self.airs.get(member.network)) is None:
            done()
        else:
            air.send(station, member.name, size, done)

    # The edge.

    def _to_edge(self, event: ed.EdgeEvent) -> None:
        for effect in self.edge.handle(event, self.now_ns):
            self._on_edge_effect(effect)
            match effect:
                case ed.SendToPeer():
                    self._send_down(effect)
                case ed.AddRun() | ed.SetPresence() | ed.AddKeyframe() | ed.DropRun():
                    self._send_to_mapper(self._delays.add, partial(self._apply_to_mapper, effect))
                case ed.SaveChanges() if self._store is not None:
                    self._store.write(effect.changes)
                    self._to_edge(ed.ChangesSaved(effect.ticket))
                case ed.WriteEvent():
                    self._on_record(effect.fields)

    def _on_edge_effect(self, effect: ed.EdgeEffect) -> None:
        """Hook for observers of the edge's effects."""

    def _send_down(self, effect: ed.SendToPeer) -> None:
        member, frames = self._members[effect.peer_id], effect.frames
        size = message_bytes(frames)

        def on_air_done() -> None:
            arrival_ns = member.down.arrival_ns(size, self.now_ns)
            self.schedule(
                arrival_ns - self.now_ns, lambda: self._to_agent(member, EdgeMessageReceived(frames))
            )

        self._over_the_air(member, _ACCESS_POINT, size, on_air_done)

    def _apply_to_mapper(
        self, message: ed.AddRun | ed.SetPresence | ed.AddKeyframe | ed.DropRun
    ) -> list[MapEvent]:
        if isinstance(message, ed.AddKeyframe):
            self.stamps_ns[KeyframeKey(message.key, message.keyframe.id)] = message.keyframe.stamp_ns
            return self.mapper.add_keyframe(message.key, message.keyframe, message.is_over_rate)
        if isinstance(message, ed.SetPresence):
            self.mapper.set_present(message.key, message.is_present)
        elif isinstance(message, ed.DropRun):
            self.mapper.remove_run(message.key)
        else:
            self.mapper.add_run(message.key, message.hello)
        return []

    # The mapper process, as in share.runtime.mapper_process.

    def _schedule_mapper(self, delay_ns: int, action: Callable[[], None]) -> None:
        self.schedule(delay_ns, action)

    def _send_to_mapper(self, delay: Delay, action: Callable[[], list[MapEvent]]) -> None:
        self._inbox.append((delay, action))
        if not self._is_busy:
            self._run_mapper_round()

    def _run_mapper_round(self) -> None:
        """Run one round: apply all messages, start a solve, send the results, do one lookup step."""
        self._is_busy = True
        map_events, spent_ns = list[MapEvent](), 0
        while self._inbox:
            delay, action = self._inbox.popleft()
            map_events += action()
            spent_ns += self._draw(delay)
        self.mapper_busy_ns += spent_ns
        self._start_solving(spent_ns)
        self._schedule_mapper(spent_ns, lambda: self._send_map_events(map_events))
        step = self.mapper.next_lookup()
        if step is None:
            self._schedule_mapper(spent_ns, self._mapper_idle)
            return
        result = _result_or_error(partial(self._run_step, step))
        step_ns = self._draw(self.delay_of(step, result))
        self.mapper_busy_ns += step_ns
        self._schedule_mapper(spent_ns + step_ns, lambda: self._step_done(step, result))

    def _run_step(self, step: Any) -> object:
        """Run a step of a look-up; one whose result is known from before need not be run."""
        return step.run()

    def _step_done(self, step: Any, result: object) -> None:
        self._send_map_events(self.mapper.finish_step(step, result, 0.0))
        self._run_mapper_round()

    def _mapper_idle(self) -> None:
        self._is_busy = False
        if self._inbox:
            self._run_mapper_round()

    def _start_solving(self, after_ns: int) -> None:
        if (step := self.mapper.next_solve()) is not None:
            result = _result_or_error(partial(step.run, self._solver))
            apply_result = partial(self.mapper.finish_step, step, result, 0.0)
            solve_ns = self._draw(self._delays.solve)
            self.solver_busy_ns += solve_ns
            self._schedule_mapper(
                after_ns + solve_ns, lambda: self._send_to_mapper(self._delays.apply_solution, apply_result)
            )

    def delay_of(self, step: Any, result: object) -> Delay:
        delays = self._delays
        if step.kind == QueryStep.kind:
            return delays.query
        if step.kind == DescribeStep.kind:
            return delays.describe
        if step.kind == IndexStep.kind:
            return delays.index
        verified, refused = delays.verify_accepted, delays.verify_refused
        if step.kind == AlignStep.kind:
            verified, refused = delays.align_accepted, delays.align_refused
        elif isinstance(step, VerifyStep) and step.query_image and step.candidate_image:
            verified, refused = delays.verify_images_accepted, delays.verify_images_refused
        if not isinstance(result, Verification):
            return refused
        checked = delays.check_loop
        return Delay(verified.p50 + checked.p50, verified.p95 + checked.p95)

    def _send_map_events(self, map_events: list[MapEvent]) -> None:
        map_events, changes = [*map_events, *self.mapper.take_events()], self.mapper.take_changes()
        if map_events or changes:
            self._to_edge(ed.MapperResult(tuple(map_events), changes))


def _random_normals(rng: np.random.Generator) -> Iterator[float]:
    """Yield standard normal numbers one by one, drawn in batches."""
    while True:
        yield from rng.standard_normal(_RANDOM_BATCH).tolist()


def _result_or_error(action: Callable[[], object]) -> object:
    """Return the result of `action`, or its exception, as the mapper process does."""
    try:
        return action()
    except Exception as error:
        return error


class SimulatedRun:
    """A run of an agent, its remaining frames and its network. `busy_until_ns`: when it has tracked all
    frames that arrived so far. `received_ns`: when the edge has received all that it sent so far."""

    def __init__(
        self,
        hello: Hello,
        machine: AgentProtocol,
        incoming: Iterator[TrackedFrame],
        network: NetworkModel,
        rngs: list[np.random.Generator],
    ) -> None:
        self.name, self.peer = hello.name, peer_id(hello.run_id)
        self.machine, self.incoming, self.network = machine, incoming, network
        self.up = Channel(network.up, network.round_trip_ms, rngs[0])
        self.down = Channel(network.down, network.round_trip_ms, rngs[1])
        self.busy_until_ns = self.received_ns = self.frames_count = 0
