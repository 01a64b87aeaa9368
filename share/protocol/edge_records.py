"""What an edge has counted, over all lives of its mapper."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, Generic, TypeVar

from share.mapping.map_changes import MapChange
from share.protocol.edge_events import SaveChanges, WriteEvent
from share.protocol.peer import Peer
from share.timing import Throttle

# ---- What the edge writes down: a decision, its reason, and when; what a peer can cause at any rate,
# seldom.

_EVENT_HZ, _EVENT_BURST = 1.0, 20.0  # records of one kind that one agent can cause,
_SUSTAINED_HZ, _SUSTAINED_BURST = 1 / 60, 200.0  # and those if it goes on causing them


class EventLog:
    """began_ns: times count from here; None: from the first event."""

    def __init__(self, began_ns: int | None) -> None:
        self._began_ns = began_ns
        self._throttle, self._sustained = (
            Throttle(_EVENT_HZ, _EVENT_BURST),
            Throttle(_SUSTAINED_HZ, _SUSTAINED_BURST),
        )

    def start(self, now_ns: int) -> None:
        """An event has come."""
        self._began_ns = now_ns if self._began_ns is None else self._began_ns

    def elapsed_s(self, now_ns: int) -> float:
        assert self._began_ns is not None
        return round((now_ns - self._began_ns) * 1e-9, 6)

    def event(self, now_ns: int, kind: str, agent: str | None, reason: str, **fields: Any) -> WriteEvent:
        head = {"t_s": self.elapsed_s(now_ns), "event": kind, "agent": agent, "reason": reason}
        return WriteEvent(head | fields)

    def throttled_event(
        self, now_ns: int, kind: str, agent: str | None, reason: str, **fields: Any
    ) -> WriteEvent | None:
        """None where so many of this kind and agent have just been written; the next one counts them."""
        suppressed = self._throttle.admit((kind, agent), now_ns)
        if suppressed is None:
            return None
        suppressed = self._sustained.admit((kind, agent), now_ns, suppressed)
        if suppressed is None:
            return None
        more = f" (and {suppressed} more since the last line)" if suppressed else ""
        return self.event(now_ns, kind, agent, f"{reason}{more}", **fields)


# ---- When a keyframe is safe, so that it may be acknowledged: once what was to be kept with it is kept.


class DurabilityTracker:
    """Of all agents of an edge. keeps: what is applied is safe once it is kept; else at once."""

    def __init__(self, has_store: bool) -> None:
        self._has_store = has_store
        self._ticket = 0  # of the newest that is to be kept
        self._saved_ticket = 0  # the newest ticket that is kept
        self._pending: deque[tuple[int, Peer, int]] = deque()  # ticket, and what is safe once it is kept

    def save(self, changes: tuple[MapChange, ...]) -> SaveChanges | None:
        """These are to be kept, after all before them; None where nothing is."""
        if not self._has_store or not changes:
            return None
        self._ticket += 1
        return SaveChanges(self._ticket, changes)

    def add_keyframe(self, peer: Peer, keyframe: int) -> None:
        """A keyframe of this peer: it is safe with the newest that is to be kept."""
        peer.pending_saves += 1
        self._pending.append((self._ticket, peer, keyframe + 1))

    def mark_saved(self, ticket: int) -> list[Peer]:
        """All up to this ticket is kept. Returns whose keyframes are safe by that."""
        self._saved_ticket = max(self._saved_ticket, ticket)
        peers = {}
        while self._pending and self._pending[0][0] <= ticket:
            _, peer, next_keyframe = self._pending.popleft()
            peer.durable_below = next_keyframe
            peer.pending_saves -= 1
            peers[peer.key] = peer
        return list(peers.values())

    def take_durable(self) -> list[Peer]:
        """The same, of what waits for nothing that is not kept yet."""
        return self.mark_saved(self._saved_ticket if self._has_store else self._ticket)


_MERGE_COUNTS = tuple(("merges", what) for what in ("requested", "skipped", "done"))
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
_MAX_RUNS = 4096  # that are remembered


class SessionTotals:
    """A life begins to count at 0; `with_totals` goes on where the one before it ended."""

    def __init__(self) -> None:
        self._previous: Mapping[str, Any] = {}
        self._agent_reports: dict[
            str, Mapping[str, Any]
        ] = {}  # of agents, also those that the last life did not hear

    def add_session(self, report: Mapping[str, Any]) -> None:
        """A life's last report, with what was `with_totals`."""
        self._previous = report
        for agent in report["agents"].values():
            self._agent_reports.pop(agent["run"], None)
            self._agent_reports[agent["run"]] = agent
        for run in list(self._agent_reports)[:-_MAX_RUNS]:
            del self._agent_reports[run]

    def with_totals(self, report: Mapping[str, Any]) -> dict[str, Any]:
        """A life's report, with the counts of those before it. An agent's are those of the same run."""
        if not self._previous:
            return dict(report)
        out = _add_counts(report, self._previous, _TOTAL_COUNTS)
        out["agents"] = {
            name: _add_counts(agent, self._agent_reports.get(agent["run"], {}), _AGENT_COUNTS)
            for name, agent in report["agents"].items()
        }
        previous = self._previous["unjoined"]
        out["unjoined"] = {
            what: report["unjoined"].get(what, 0) + previous.get(what, 0)
            for what in sorted({*report["unjoined"], *previous})
        }
        return out


def _add_counts(
    now: Mapping[str, Any], previous: Mapping[str, Any], paths: tuple[tuple[str, ...], ...]
) -> dict[str, Any]:
    out = dict(now)
    for path in paths:
        count = _count_at(previous, path)
        if not count:
            continue
        if len(path) == 1:
            out[path[0]] = out.get(path[0], 0) + count
        else:
            inner = dict(out.get(path[0], {}))
            inner[path[1]] = inner.get(path[1], 0) + count
            out[path[0]] = inner
    return out


def _count_at(report: Mapping[str, Any], path: tuple[str, ...]) -> int:
    value: Any = report
    for key in path:
        if key not in value:
            return 0
        value = value[key]
    return int(value)


# ---- Keyframes that wait to be taken into the map, of each name in turn: who sends many waits for itself.

T = TypeVar("T")

_MAX_ADD_MS = 10.0  # that keyframes are taken in before one is looked up


class FairQueue(Generic[T]):
    """In order of arrival of each name."""

    def __init__(self) -> None:
        self._queues: dict[str, deque[T]] = {}  # whose turn is next first

    def __len__(self) -> int:
        return sum(map(len, self._queues.values()))

    def add(self, name: str, item: T) -> None:
        self._queues.setdefault(name, deque()).append(item)

    def take_next(self, spent_ms: float = 0.0) -> T | None:
        """What is taken in now. spent_ms: on those before it, since a keyframe was last looked up. None:
        there is nothing, or it is time to look one up."""
        if not self._queues or spent_ms >= _MAX_ADD_MS:
            return None
        name = next(iter(self._queues))
        queue = self._queues.pop(name)
        item = queue.popleft()
        if queue:
            self._queues[name] = queue
        return item
