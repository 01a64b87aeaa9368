"""What the mapper reports: changes to store, events and counters since the last time they were taken."""

from __future__ import annotations

from share.errors import describe_exception
from share.mapping.agents.quarantine import QuarantineChange
from share.mapping.corrections import MapEvent
from share.mapping.loop_acceptance import LoopDecision
from share.mapping.map_changes import MapChange, RemoveLoops, SaveLoop
from share.mapping.map_solving import AppliedSolution
from share.mapping.mapper_counters import MapperCounters


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
