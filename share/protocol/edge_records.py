"""What an edge has counted, over all lives of its mapper."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, Generic, TypeVar

from share.mapping.changes import Change
from share.protocol.edge_events import Keep, Record
from share.protocol.peer import Peer
from share.rates import Throttle

# ---- What the edge writes down: a decision, its reason, and when; what a peer can cause at any rate,
# seldom.

_HZ, _BURST = 1.0, 20.0  # records of one kind that one agent can cause,
_LASTING_HZ, _LASTING_BURST = 1 / 60, 200.0  # and those if it goes on causing them


class Records:
    """began_ns: times count from here; None: from the first event."""

    def __init__(self, began_ns: int | None) -> None:
        self._began_ns = began_ns
        self._throttle, self._lasting = Throttle(_HZ, _BURST), Throttle(_LASTING_HZ, _LASTING_BURST)

    def begin(self, now_ns: int) -> None:
        """An event has come."""
        self._began_ns = now_ns if self._began_ns is None else self._began_ns

    def since_began_s(self, now_ns: int) -> float:
        assert self._began_ns is not None
        return round((now_ns - self._began_ns) * 1e-9, 6)

    def of(self, now_ns: int, what: str, agent: str | None, reason: str, **fields: Any) -> Record:
        head = {"t_s": self.since_began_s(now_ns), "event": what, "agent": agent, "reason": reason}
        return Record(head | fields)

    def seldom(self, now_ns: int, what: str, agent: str | None, reason: str, **fields: Any) -> Record | None:
        """None where so many of this kind and agent have just been written; the next one counts them."""
        held_back = self._throttle.admit((what, agent), now_ns)
        if held_back is None:
            return None
        held_back = self._lasting.admit((what, agent), now_ns, held_back)
        if held_back is None:
            return None
        more = f" (and {held_back} more since the last line)" if held_back else ""
        return self.of(now_ns, what, agent, f"{reason}{more}", **fields)


# ---- When a keyframe is safe, so that it may be acknowledged: once what was to be kept with it is kept.


class Safekeeping:
    """Of all agents of an edge. keeps: what is applied is safe once it is kept; else at once."""

    def __init__(self, keeps: bool) -> None:
        self._keeps = keeps
        self._ticket = 0  # of the newest that is to be kept
        self._kept_to = 0  # the newest ticket that is kept
        self._unsafe: deque[tuple[int, Peer, int]] = deque()  # ticket, and what is safe once it is kept

    def keep(self, changes: tuple[Change, ...]) -> Keep | None:
        """These are to be kept, after all before them; None where nothing is."""
        if not self._keeps or not changes:
            return None
        self._ticket += 1
        return Keep(self._ticket, changes)

    def applied(self, peer: Peer, keyframe: int) -> None:
        """A keyframe of this peer: it is safe with the newest that is to be kept."""
        peer.unsafe += 1
        self._unsafe.append((self._ticket, peer, keyframe + 1))

    def kept(self, ticket: int) -> list[Peer]:
        """All up to this ticket is kept. Returns whose keyframes are safe by that."""
        self._kept_to = max(self._kept_to, ticket)
        told = {}
        while self._unsafe and self._unsafe[0][0] <= ticket:
            _, peer, next_keyframe = self._unsafe.popleft()
            peer.safe = next_keyframe
            peer.unsafe -= 1
            told[peer.key] = peer
        return list(told.values())

    def safe(self) -> list[Peer]:
        """The same, of what waits for nothing that is not kept yet."""
        return self.kept(self._kept_to if self._keeps else self._ticket)


_MERGES = tuple(("merges", what) for what in ("requested", "skipped", "done"))
_LOOPS = (("loops", "tried"), ("loops", "accepted"))
_OF_ALL = (
    *_LOOPS,
    *_MERGES,
    *((name,) for name in ("taken_out", "failed_jobs", "internal_errors", "forgotten_runs")),
    *((f"{kind}_ms", "n") for kind in ("place", "verify", "solve")),
)
_OF_AGENT = (
    *_LOOPS,
    *_MERGES,
    *((name,) for name in ("keyframes", "poses", "evaluations", "corrections", "bytes_up", "bytes_down")),
    *((name,) for name in ("bad_messages", "unexpected", "queries_skipped", "refused_messages")),
    ("doubted_keyframes",),
)
_MOST_RUNS = 4096  # that are remembered


class Totals:
    """A life begins to count at 0; `added` goes on where the one before it ended."""

    def __init__(self) -> None:
        self._before: Mapping[str, Any] = {}
        self._runs: dict[str, Mapping[str, Any]] = {}  # of agents, also those that the last life did not hear

    def ended(self, report: Mapping[str, Any]) -> None:
        """A life's last report, with what was `added`."""
        self._before = report
        for agent in report["agents"].values():
            self._runs.pop(agent["run"], None)
            self._runs[agent["run"]] = agent
        for run in list(self._runs)[:-_MOST_RUNS]:
            del self._runs[run]

    def added(self, report: Mapping[str, Any]) -> dict[str, Any]:
        """A life's report, with the counts of those before it. An agent's are those of the same run."""
        if not self._before:
            return dict(report)
        out = _sum(report, self._before, _OF_ALL)
        out["agents"] = {
            name: _sum(agent, self._runs.get(agent["run"], {}), _OF_AGENT)
            for name, agent in report["agents"].items()
        }
        was = self._before["strangers"]
        out["strangers"] = {
            what: report["strangers"].get(what, 0) + was.get(what, 0)
            for what in sorted({*report["strangers"], *was})
        }
        return out


def _sum(
    now: Mapping[str, Any], before: Mapping[str, Any], paths: tuple[tuple[str, ...], ...]
) -> dict[str, Any]:
    out = dict(now)
    for path in paths:
        count = _at(before, path)
        if not count:
            continue
        if len(path) == 1:
            out[path[0]] = out.get(path[0], 0) + count
        else:
            inner = dict(out.get(path[0], {}))
            inner[path[1]] = inner.get(path[1], 0) + count
            out[path[0]] = inner
    return out


def _at(report: Mapping[str, Any], path: tuple[str, ...]) -> int:
    found: Any = report
    for key in path:
        if key not in found:
            return 0
        found = found[key]
    return int(found)


# ---- Keyframes that wait to be taken into the map, of each name in turn: who sends many waits for itself.

T = TypeVar("T")

_MOST_MS = 10.0  # that keyframes are taken in before one is looked up


class Turns(Generic[T]):
    """In order of arrival of each name."""

    def __init__(self) -> None:
        self._waiting: dict[str, deque[T]] = {}  # whose turn is next first

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def add(self, name: str, what: T) -> None:
        self._waiting.setdefault(name, deque()).append(what)

    def next(self, spent_ms: float = 0.0) -> T | None:
        """What is taken in now. spent_ms: on those before it, since a keyframe was last looked up. None:
        there is nothing, or it is time to look one up."""
        if not self._waiting or spent_ms >= _MOST_MS:
            return None
        name = next(iter(self._waiting))
        queue = self._waiting.pop(name)
        what = queue.popleft()
        if queue:
            self._waiting[name] = queue
        return what
