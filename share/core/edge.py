"""The edge as a state machine: who speaks to it, what it answers, and in what order keyframes count.

It sees no socket, thread or clock: `handle(event, now_ns)` answers effects, `share.run.edge` carries
them out. Heavy work is given away as jobs (`share.core.mapper`), one at a time, and comes back as an
event; so the same code runs under test without threads.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from share import __version__
from share.config import Config, to_mapping
from share.core.inorder import InOrder
from share.core.mapper import Finding, Job, Mapper
from share.core.rate import seconds
from share.errors import WireError
from share.types import Keyframe, TrackState
from share.wire import messages as wire
from share.wire.codec import Bytes, decode, encode

# ---------------------------------------------------------------- events


@dataclass(frozen=True)
class Received:
    """A message, still bytes, from the peer that the transport knows by this id."""

    peer: bytes
    frames: Sequence[Bytes]


@dataclass(frozen=True)
class Done:
    """A job that `Work` asked for: what it came to, and how long it took."""

    job: Job
    result: Any
    ms: float


@dataclass(frozen=True)
class Tick:
    """Time has passed."""


Event = Received | Done | Tick

# ---------------------------------------------------------------- effects


@dataclass(frozen=True)
class Send:
    peer: bytes
    frames: Sequence[Bytes]


@dataclass(frozen=True)
class Work:
    """Run `job.run()` off the receive path and answer with `Done`."""

    job: Job


@dataclass(frozen=True)
class Record:
    """A decision with its reason: one line of events.jsonl."""

    fields: dict[str, Any]


Effect = Send | Work | Record


@dataclass
class _Peer:
    """One run of one agent."""

    hello: wire.Hello
    key: str  # names this run: the name, and some of the run id
    heard_ns: int
    inorder: InOrder
    state: TrackState = TrackState.INITIALISING
    counts: Counter[str] = field(default_factory=Counter)
    revision: int = 0
    gone: bool = False
    missed: Finding | None = None  # the newest correction while it was gone


class Edge:
    """All agents of one room. `session` names this life of the edge, so that agents notice a new one."""

    def __init__(self, config: Config, session: int) -> None:
        self._config, self._session = config, session
        self._mapper = Mapper(config)
        self._peers: dict[bytes, _Peer] = {}
        self._by_key: dict[str, bytes] = {}
        self._began_ns: int | None = None
        self._working = False
        self._strangers: Counter[str] = Counter()
        self._effects: list[Effect] = []

    def handle(self, event: Event, now_ns: int) -> list[Effect]:
        """What `event` leads to. `now_ns` is the edge's clock and never goes back."""
        self._began_ns = now_ns if self._began_ns is None else self._began_ns
        self._effects = []
        match event:
            case Received():
                self._receive(event, now_ns)
            case Done():
                self._working = False
                self._found(self._mapper.done(event.job, event.result, event.ms), now_ns)
            case Tick():
                self._notice_silence(now_ns)
        self._give_work()
        return self._effects

    # ------------------------------------------------------------------ messages

    def _receive(self, event: Received, now_ns: int) -> None:
        peer = self._peers.get(event.peer)
        counts = peer.counts if peer else self._strangers
        counts["bytes_up"] += sum(len(frame) for frame in event.frames)
        try:
            message = decode(event.frames)
        except WireError as error:
            counts["bad_messages"] += 1
            if counts["bad_messages"] == 1:
                self._record(now_ns, "bad message", peer, str(error))
            return
        if peer is not None:
            self._heard(peer, now_ns)
        match message:
            case wire.Hello():
                self._greet(event.peer, message, now_ns)
            case wire.Ping():  # a stranger's too: our session tells him to say hello
                pong = wire.Pong(message.sequence, message.sent_ns, now_ns, now_ns, self._session)
                self._send(event.peer, pong)
            case wire.Bye() if peer:
                peer.gone = True
                self._record(now_ns, "left", peer, "said bye")
            case Keyframe() if peer:
                self._keyframe(event.peer, peer, message, now_ns)
            case wire.PoseUpdate() if peer:
                peer.counts["poses"] += 1
                peer.state = message.state
            case wire.Evaluation() if peer:
                peer.counts["evaluations"] += 1
            case _:  # from a stranger, or not an agent's word
                counts["unexpected"] += 1

    def _heard(self, peer: _Peer, now_ns: int) -> None:
        peer.heard_ns = now_ns
        if peer.gone:
            peer.gone = False
            self._record(now_ns, "back", peer, "is heard again")

    def _greet(self, peer_id: bytes, hello: wire.Hello, now_ns: int) -> None:
        """Welcome a new run or a known one; refuse a name that somebody else is using."""
        if peer_id not in self._peers:
            if (reason := self._objection(hello, now_ns)) is not None:
                self._send(peer_id, wire.Refused(reason))
                self._record(now_ns, "refused", None, reason)
                return
            key = f"{hello.name}-{hello.run_id % 0x10000:04x}"
            self._peers[peer_id] = _Peer(hello, key, now_ns, InOrder())
            self._by_key[key] = peer_id
            self._record(now_ns, "joined the edge", self._peers[peer_id], f"{hello.kind} '{hello.name}'")
        peer = self._peers[peer_id]
        self._send(peer_id, wire.Welcome(self._session, peer.inorder.next_keyframe))
        if peer.missed is not None:
            missed, peer.missed = peer.missed, None
            self._correct(peer_id, peer, missed, now_ns)

    def _objection(self, hello: wire.Hello, now_ns: int) -> str | None:
        """Why a new run cannot be taken in, if it cannot."""
        edge = self._config.edge
        present = [peer for peer in self._peers.values() if not peer.gone]
        for peer in present:
            if peer.hello.name == hello.name and now_ns - peer.heard_ns < seconds(edge.name_hold_s):
                return f"the name '{hello.name}' is in use by another agent; choose another with --name"
        if len(present) >= edge.max_agents:
            return f"the edge serves {len(present)} agents already, as many as it may (edge.max_agents)"
        return None

    def _keyframe(self, peer_id: bytes, peer: _Peer, keyframe: Keyframe, now_ns: int) -> None:
        applicable = peer.inorder.push(keyframe)
        self._send(peer_id, peer.inorder.ack())
        for ready in applicable:
            peer.counts["keyframes"] += 1
            self._found(self._mapper.add(peer.key, peer.hello, ready), now_ns)

    def _notice_silence(self, now_ns: int) -> None:
        for peer in self._peers.values():
            if not peer.gone and now_ns - peer.heard_ns > seconds(self._config.edge.silent_s):
                peer.gone = True
                self._record(now_ns, "silent", peer, f"nothing heard for {self._config.edge.silent_s:g} s")

    # ------------------------------------------------------------------ the map

    def _found(self, findings: list[Finding], now_ns: int) -> None:
        """Write down what the mapper decided, and send what follows from it."""
        for finding in findings:
            peer_id = self._by_key[finding.agent]
            peer = self._peers[peer_id]
            if finding.correction is None:
                self._record(now_ns, finding.what, peer, finding.reason)
            elif peer.gone:
                peer.missed = finding
            else:
                self._correct(peer_id, peer, finding, now_ns)

    def _correct(self, peer_id: bytes, peer: _Peer, finding: Finding, now_ns: int) -> None:
        assert finding.correction is not None
        peer.revision += 1
        peer.counts["corrections"] += 1
        correction = replace(finding.correction, revision=peer.revision)
        self._send(peer_id, correction)
        fields = {"map_id": correction.map_id, "revision": peer.revision, "answers": correction.answers}
        self._record(now_ns, finding.what, peer, finding.reason, **fields)

    def _give_work(self) -> None:
        if not self._working and (job := self._mapper.next_job()) is not None:
            self._working = True
            self._effects.append(Work(job))

    # ------------------------------------------------------------------ going out

    def _send(self, peer_id: bytes, message: wire.Down) -> None:
        frames = encode(message)
        peer = self._peers.get(peer_id)
        counts = peer.counts if peer else self._strangers
        counts["bytes_down"] += sum(len(frame) for frame in frames)
        self._effects.append(Send(peer_id, frames))

    def _record(self, now_ns: int, what: str, peer: _Peer | None, reason: str, **fields: Any) -> None:
        assert self._began_ns is not None
        t_s = round((now_ns - self._began_ns) * 1e-9, 6)
        agent = peer.hello.name if peer else None
        self._effects.append(Record({"t_s": t_s, "event": what, "agent": agent, "reason": reason, **fields}))

    def report(self) -> dict[str, Any]:
        """edge.json: per agent and in all. An agent's earlier runs stand under their run's own key."""
        newest = {peer.hello.name: peer for peer in self._peers.values()}
        return {
            "session": self._session,
            "policy": self._config.edge.policy,
            "agents": {
                peer.hello.name if newest[peer.hello.name] is peer else peer.key: self._report_of(peer)
                for peer in self._peers.values()
            },
            "strangers": dict(self._strangers),
            **self._mapper.report(),
            "version": __version__,
            "config": to_mapping(self._config),
        }

    def _report_of(self, peer: _Peer) -> dict[str, Any]:
        return {
            "kind": str(peer.hello.kind),
            "run_id": peer.hello.run_id,
            "state": str(peer.state),
            "gone": peer.gone,
            **{name: peer.counts[name] for name in _COUNTS},
            **self._mapper.report_of(peer.key),
        }


_COUNTS = (
    "keyframes",
    "poses",
    "evaluations",
    "corrections",
    "bytes_up",
    "bytes_down",
    "bad_messages",
    "unexpected",
)
