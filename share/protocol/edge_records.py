"""The edge's bookkeeping: effects, event log, durability of keyframes, totals over mapper restarts."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

from share.event_kinds import EventKind
from share.mapping.corrections import MapEvent
from share.mapping.map_changes import MapChange
from share.protocol.admission import RunRegistry
from share.protocol.edge_events import EdgeEffect, SaveChanges, SendToPeer, WriteEvent
from share.protocol.peer import Peer
from share.timing import Throttle
from share.wire.codec import WIRE_VERSION, encode, message_bytes
from share.wire.messages import DownlinkMessage

# Limits on the events of one kind that one agent can cause: short-term, and sustained.
_EVENT_HZ, _EVENT_BURST = 1.0, 20.0
_SUSTAINED_HZ, _SUSTAINED_BURST = 1 / 60, 200.0


class EventLog:
    """Makes the lines of events.jsonl. began_ns: origin of their times; None: the first event."""

    def __init__(self, began_ns: int | None) -> None:
        self._began_ns = began_ns
        self._throttle = Throttle(_EVENT_HZ, _EVENT_BURST)
        self._sustained = Throttle(_SUSTAINED_HZ, _SUSTAINED_BURST)

    def start(self, now_ns: int) -> None:
        """Set the time origin, if not set."""
        self._began_ns = now_ns if self._began_ns is None else self._began_ns

    def elapsed_s(self, now_ns: int) -> float:
        assert self._began_ns is not None
        return round((now_ns - self._began_ns) * 1e-9, 6)

    def event(
        self, now_ns: int, kind: EventKind, agent: str | None, reason: str, **fields: Any
    ) -> WriteEvent:
        head = {"t_s": self.elapsed_s(now_ns), "event": kind, "agent": agent, "reason": reason}
        return WriteEvent(head | fields)

    def throttled_event(
        self, now_ns: int, kind: EventKind, agent: str | None, reason: str, **fields: Any
    ) -> WriteEvent | None:
        """Return the event, or None beyond the limits of its kind and of who caused it (agent or client), or
        of its map where nobody did; the next one counts those left out."""
        key = kind, agent, fields.get("client"), fields.get("map_id") if agent is None else None
        suppressed = self._throttle.admit(key, now_ns)
        if suppressed is not None:
            suppressed = self._sustained.admit(key, now_ns, suppressed)
        if suppressed is None:
            return None
        more = f" (and {suppressed} more since the last line)" if suppressed else ""
        return self.event(now_ns, kind, agent, f"{reason}{more}", **fields)


class DurabilityTracker:
    """Determines when the keyframes of all agents are durable and may be acknowledged: once their changes are
    stored, or at once without a store."""

    def __init__(self, has_store: bool) -> None:
        self._has_store = has_store
        self._ticket = 0  # newest issued
        self._saved_ticket = 0  # newest stored
        self._pending: deque[tuple[int, Peer, int]] = deque()  # ticket, peer, its `durable_below` once stored

    def save(self, changes: tuple[MapChange, ...]) -> SaveChanges | None:
        """Return the effect that stores these changes; None without changes or store."""
        if not self._has_store or not changes:
            return None
        self._ticket += 1
        return SaveChanges(self._ticket, changes)

    def add_keyframe(self, peer: Peer, keyframe: int) -> None:
        """Add an applied keyframe, which becomes durable with the newest ticket."""
        peer.pending_saves += 1
        self._pending.append((self._ticket, peer, keyframe + 1))

    def mark_saved(self, ticket: int) -> list[Peer]:
        """Record that all changes up to this ticket are stored. Return the peers with newly durable
        keyframes."""
        self._saved_ticket = max(self._saved_ticket, ticket)
        peers = {}
        while self._pending and self._pending[0][0] <= ticket:
            _, peer, next_keyframe = self._pending.popleft()
            peer.durable_below = next_keyframe
            peer.pending_saves -= 1
            peers[peer.key] = peer
        return list(peers.values())

    def take_durable(self) -> list[Peer]:
        """Return the peers with newly durable keyframes that wait for no ticket."""
        return self.mark_saved(self._saved_ticket if self._has_store else self._ticket)


class EventSubject(Protocol):
    """The subject of an event: an agent's run, or a client."""

    @property
    def name(self) -> str: ...


class CountedSender(EventSubject, Protocol):
    """A peer with counted messages."""

    def count(self, kind: str, reason: str, now_ns: int) -> int: ...


class EdgeOutput:
    """Collects the effects of one event: messages, records, changes to be stored. now_ns: its time."""

    def __init__(self, registry: RunRegistry, has_store: bool, began_ns: int | None) -> None:
        self.effects: list[EdgeEffect] = []
        self.now_ns = 0
        self.durability = DurabilityTracker(has_store)
        self._registry, self._event_log = registry, EventLog(began_ns)

    @property
    def elapsed_s(self) -> float:
        """Time since the origin of the times in records."""
        return self._event_log.elapsed_s(self.now_ns)

    def begin(self, now_ns: int) -> None:
        """Start the effects of the next event."""
        self._event_log.start(now_ns)
        self.effects, self.now_ns = [], now_ns

    def add(self, *effects: EdgeEffect) -> None:
        self.effects.extend(effects)

    def send(self, peer_id: bytes, message: DownlinkMessage, version: int = WIRE_VERSION) -> None:
        frames = encode(message, version)
        self._registry.sender(peer_id).counts["bytes_down"] += message_bytes(frames)
        self.add(SendToPeer(peer_id, frames))

    def send_correction(self, peer: Peer, map_event: MapEvent, is_repeat: bool = False) -> None:
        """Send a correction. is_repeat: sent again at the agent's request, so its record is throttled."""
        assert map_event.correction is not None
        peer.revision += 1
        peer.counts["corrections"] += 1
        correction = replace(map_event.correction, revision=peer.revision)
        peer.computation.answer(correction.answered_keyframe, self.now_ns)
        self.send(peer.id, correction)
        answered = {"revision": peer.revision, "answers": correction.answered_keyframe}
        self.record(map_event.event, peer, map_event.reason, is_repeat, map_id=correction.map_id, **answered)

    def count_bad_message(self, sender: CountedSender | None, reason: str, throttled: bool = False) -> None:
        """Count a bad message; record the first of each sender. throttled: as in `record`, for senders that a
        peer can make many of."""
        if (sender or self._registry.unjoined).count("bad_messages", reason, self.now_ns) == 1:
            self.record("bad message", sender, reason, throttled)

    def record(
        self, event: EventKind, peer: EventSubject | None, reason: str, throttled: bool = True, **fields: Any
    ) -> None:
        """Record an event. throttled: unless it is repeated too often, as a peer could cause it."""
        make = self._event_log.throttled_event if throttled else self._event_log.event
        if (effect := make(self.now_ns, event, peer.name if peer else None, reason, **fields)) is not None:
            self.add(effect)

    def save(self, *changes: MapChange) -> int | None:
        """Store changes; return their ticket, None without a store."""
        if (effect := self.durability.save(changes)) is None:
            return None
        self.add(effect)
        return effect.ticket


_MERGE_COUNTS = (("merges", "requested"), ("merges", "skipped"), ("merges", "done"))
_LOOP_COUNTS = (("loops", "tried"), ("loops", "accepted"))
_TOTAL_COUNTS = (
    *_LOOP_COUNTS,
    *_MERGE_COUNTS,
    *((name,) for name in ("removed_keyframes", "failed_steps", "internal_errors", "forgotten_runs")),
    *((f"{kind}_ms", "n") for kind in ("place", "verify", "solve")),
)
_AGENT_COUNTS = (
    *_LOOP_COUNTS,
    *_MERGE_COUNTS,
    *((name,) for name in ("keyframes", "poses", "evaluations", "corrections", "bytes_up", "bytes_down")),
    *((name,) for name in ("bad_messages", "unexpected", "queries_skipped", "refused_messages")),
    ("suspect_keyframes",),
)
_MAX_RUNS = 4096  # remembered


class SessionTotals:
    """Totals over restarts of the mapper, which counts from 0 each time."""

    def __init__(self) -> None:
        self._previous: Mapping[str, Any] = {}
        self._agent_reports: dict[str, Mapping[str, Any]] = {}  # by run key, the most recent last

    def add_session(self, report: Mapping[str, Any]) -> None:
        """Add the last report of a mapper that has ended, as returned by `with_totals`."""
        self._previous = report
        for agent in report["agents"].values():
            self._agent_reports.pop(agent["run"], None)
            self._agent_reports[agent["run"]] = agent
        for run in list(self._agent_reports)[:-_MAX_RUNS]:
            del self._agent_reports[run]

    def with_totals(self, report: Mapping[str, Any]) -> dict[str, Any]:
        """Return the present mapper's report plus the counts of earlier ones; of agents, those of the same
        run."""
        if not self._previous:
            return dict(report)
        out = _add_counts(report, self._previous, _TOTAL_COUNTS)
        out["agents"] = {
            name: _add_counts(agent, self._agent_reports.get(agent["run"], {}), _AGENT_COUNTS)
            for name, agent in report["agents"].items()
        }
        previous = self._previous["unjoined"]
        out["unjoined"] = {
            name: report["unjoined"].get(name, 0) + previous.get(name, 0)
            for name in sorted({*report["unjoined"], *previous})
        }
        return out


def _add_counts(
    now: Mapping[str, Any], previous: Mapping[str, Any], paths: tuple[tuple[str, ...], ...]
) -> dict[str, Any]:
    """Return a copy of `now` with the counts of `previous` at these paths (one or two keys) added."""
    out = dict(now)
    for *outer, name in paths:
        before = previous.get(outer[0], {}) if outer else previous
        if name in before:
            counts = out
            if outer:
                counts = out[outer[0]] = dict(out.get(outer[0], {}))
            counts[name] = counts.get(name, 0) + before[name]
    return out
