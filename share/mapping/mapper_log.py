"""What the mapper reports: changes to store and events since they were last taken, and counters (loops and
merges of each run, steps and their durations)."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any

from share.errors import describe_exception
from share.mapping.agents.quarantine import QuarantineChange
from share.mapping.corrections import MapEvent
from share.mapping.loop_acceptance import LoopDecision
from share.mapping.map_changes import MapChange, RemoveLoops, SaveLoop
from share.mapping.map_solving import AppliedSolution
from share.metrics.frame_log import summary


class MapperLog:
    """changes: to the map file. events: those that no step returns."""

    def __init__(self) -> None:
        self.changes: list[MapChange] = []
        self.events: list[MapEvent] = []
        self.counters = MapperCounters()

    def record_loops(self, outcome: LoopDecision | AppliedSolution | QuarantineChange) -> None:
        """Add the loops that an outcome has added or dropped."""
        self.changes += [RemoveLoops(loop.a, loop.b) for loop in outcome.dropped]
        self.changes += [SaveLoop(loop) for loop in outcome.added]

    def failure(
        self, what: str, error: Exception, agent: str | None = None, map_id: str | None = None
    ) -> list[MapEvent]:
        """Count an error and return its event; the map goes on without the step. agent, map_id: concerned, if
        any."""
        self.counters.failed_steps += 1
        where = "" if map_id is None else f"map {map_id}: "
        reason = f"{where}{what}: {describe_exception(error)}"
        return [MapEvent(agent, "step failed", reason, map_id=map_id)]

    def take_changes(self) -> tuple[MapChange, ...]:
        """Return the changes since the last call."""
        changes, self.changes = tuple(self.changes), []
        return changes

    def take_events(self) -> list[MapEvent]:
        """Return the events since the last call."""
        events, self.events = self.events, []
        return events


STEP_KINDS = "describe", "index", "place", "verify", "align", "solve"
_MAX_STEP_TIMES = 5000  # newest durations of each kind of step in a report


@dataclass
class RunCounters:
    """Counters of one run. merges: `requested`, `skipped`, `done`. newest_id: its newest keyframe."""

    loops_tried: int = 0
    merges: Counter[str] = field(default_factory=Counter)
    newest_id: int = -1

    def report(self) -> dict[str, Any]:
        """The run's fields of edge.json."""
        return {
            "loops": {"tried": self.loops_tried, "accepted": self.merges["done"]},
            "merges": merge_counts(self.merges),
        }


class MapperCounters:
    """runs: by run. steps: finished steps by kind. removed_keyframes, failed_steps: since the start."""

    def __init__(self) -> None:
        self.runs: dict[str, RunCounters] = {}
        self.steps: Counter[str] = Counter()
        self.removed_keyframes = self.failed_steps = 0
        self._totals = RunCounters()
        self._step_ms = {kind: deque[float](maxlen=_MAX_STEP_TIMES) for kind in STEP_KINDS}

    def add_run(self, agent: str) -> None:
        self.runs[agent] = RunCounters()

    def remove_run(self, agent: str) -> None:
        """Forget a run; the totals keep its loops and merges."""
        del self.runs[agent]

    def count_tried(self, agent: str) -> None:
        """Count a pair of views that was verified for a keyframe of this run."""
        for counters in (self.runs[agent], self._totals):
            counters.loops_tried += 1

    def count_merge(self, agent: str, outcome: str) -> None:
        """Count a loop of this run. outcome: see `RunCounters`."""
        for counters in (self.runs[agent], self._totals):
            counters.merges[outcome] += 1

    def add_step(self, kind: str, ms: float) -> None:
        self._step_ms[kind].append(ms)
        self.steps[kind] += 1

    def report(self, pending_count: int, loop_count: int) -> dict[str, Any]:
        """Totals of all runs and durations of steps, for edge.json. Counts: of loops now in the map."""
        merges = merge_counts(self._totals.merges)
        return {
            "loops": {
                "tried": self._totals.loops_tried,
                "accepted": merges["done"],
                "waiting": pending_count,
                "in_map": loop_count,
            },
            "merges": merges,
            "removed_keyframes": self.removed_keyframes,
            "failed_steps": self.failed_steps,
            **{
                f"{kind}_ms": {**summary(list(ms)).report(), "n": self.steps[kind]}
                for kind, ms in self._step_ms.items()
            },
        }


def merge_counts(merges: Counter[str]) -> dict[str, int]:
    """Counts of all outcomes, zeros included."""
    return {outcome: merges[outcome] for outcome in ("requested", "skipped", "done")}
