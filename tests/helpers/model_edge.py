"""An edge reduced to its promises, and a bad network, both in virtual time."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np
from helpers.hellos import hello_of

from share.geometry import se3
from share.protocol import agent_events as ev
from share.protocol.agent import AgentProtocol
from share.protocol.common_events import EdgeMessageReceived, SendToEdge
from share.protocol.keyframe_intake import ReorderBuffer
from share.types import Correction, Keyframe, OdometryKeyframe, TrackState, View
from share.wire import messages as m
from share.wire.codec import decode, encode

S = 1_000_000_000
MS = 1_000_000
EMPTY = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32)))
UP = np.array([0, 0, 1.0])
COV = np.eye(6) * 1e-6
HELLO = hello_of("ann", 5, focal=460.0)


def tracked(
    k: int, T: np.ndarray | None = None, candidate: bool = False, new_stretch: bool = False, ms: float = 4.0
) -> ev.FrameTracked:
    """Frame k, that arrived at k * 50 ms and took `ms`."""
    at = k * 50 * MS
    T = np.eye(4) if T is None else T
    return ev.FrameTracked(k, 10**15 + at, at, at + round(ms * MS), TrackState.OK, T, candidate, new_stretch)


_T_LAST: WeakKeyDictionary[AgentProtocol, np.ndarray] = WeakKeyDictionary()  # of its last candidate


def handle(
    agent: AgentProtocol, event: ev.AgentEvent, now_ns: int, view: View = EMPTY
) -> list[ev.AgentEffect]:
    """Gives the agent the event, and after a keyframe's pose the keyframe, as a tracker does."""
    effects = agent.handle(event, now_ns)
    if isinstance(event, ev.FrameTracked) and event.is_keyframe:
        assert event.T_odom_body is not None
        T = event.T_odom_body
        T_last_body = se3.inverse(_T_LAST.get(agent, np.eye(4))) @ T
        _T_LAST[agent] = T
        candidate = OdometryKeyframe(T, T_last_body, COV, UP, 0.01, view, event.new_segment)
        effects = effects + agent.handle(ev.KeyframeMade(event, candidate), now_ns)
    return effects


@dataclass
class ModelEdge:
    """One life of an edge, for one agent. `next_keyframe` is what it remembers of earlier lives."""

    session: int
    next_keyframe: int = 0
    applied: list[Keyframe] = field(default_factory=list)
    inorder: ReorderBuffer = field(init=False)
    known: bool = False
    revision: int = 0

    def __post_init__(self) -> None:
        self.inorder = ReorderBuffer(self.next_keyframe)

    def receive(self, message: m.Message, now_ns: int) -> list[m.Message]:
        match message:
            case m.Ping():
                return [m.Pong(message.sequence, message.sent_ns, now_ns, now_ns, self.session)]
            case m.Hello():
                self.known = True
                return [m.Welcome(self.session, self.inorder.next_keyframe)]
            case Keyframe() if self.known:
                ready = self.inorder.push(message)
                self.applied += ready
                return [self.inorder.ack(), *(self._correct(k) for k in ready)]
        return []

    def _correct(self, keyframe: Keyframe) -> m.Message:
        self.revision += 1
        T = se3.exp(np.array([0, 0, 0.001, 0.01, 0, 0]) * self.revision)
        return Correction(T, COV, f"map-{self.session}", self.revision, keyframe.id, keyframe.id)


@dataclass
class Network:
    """Delivers late, twice, out of order or not at all, as its seed says."""

    rng: np.random.Generator
    loss: float = 0.0
    twice: float = 0.0
    delay_ms: float = 1.0
    _queue: list[tuple[int, int, list[bytes]]] = field(default_factory=list)
    _count: int = 0

    def send(self, frames: list[bytes], now_ns: int) -> None:
        for _ in range(1 + (self.rng.random() < self.twice)):
            if self.rng.random() >= self.loss:
                at = now_ns + round(self.rng.uniform(0, self.delay_ms) * MS)
                heapq.heappush(self._queue, (at, self._count, frames))
                self._count += 1

    def arrived(self, now_ns: int) -> list[list[bytes]]:
        out = []
        while self._queue and self._queue[0][0] <= now_ns:
            out.append(heapq.heappop(self._queue)[2])
        return out

    def cut(self) -> None:
        self._queue.clear()


class World:
    """One agent, perhaps an edge, and the network between them."""

    def __init__(self, agent: AgentProtocol, edge: ModelEdge | None, network: Callable[[], Network]) -> None:
        self.agent, self.edge = agent, edge
        self.up, self.down = network(), network()
        self.effects: list[ev.AgentEffect] = []
        self.now_ns = 0

    def replace_edge(self, edge: ModelEdge | None) -> None:
        """Kills the edge; its connection and all that was under way die with it."""
        self.edge = edge
        self.up.cut()
        self.down.cut()

    def step(self, now_ns: int, *events: ev.AgentEvent) -> None:
        self.now_ns = now_ns
        for frames in self.up.arrived(now_ns):
            for answer in self.edge.receive(decode(frames), now_ns) if self.edge else ():
                self.down.send([bytes(f) for f in encode(answer)], now_ns)
        received = [EdgeMessageReceived(frames) for frames in self.down.arrived(now_ns)]
        for event in (*received, *events, ev.AgentTick()):
            effects = handle(self.agent, event, now_ns)
            self.effects += effects
            for effect in effects:
                if isinstance(effect, SendToEdge) and self.edge:
                    self.up.send([bytes(f) for f in effect.frames], now_ns)

    @property
    def stopped(self) -> bool:
        return any(isinstance(effect, ev.CloseLink) for effect in self.effects)
