"""The edge's map in one process, without sockets: add keyframes and measure the CPU time of every step."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from share.config import Config
from share.mapping.corrections import MapEvent
from share.mapping.graph.solver import PoseGraphSolver
from share.mapping.mapper import Mapper
from share.types import Keyframe
from share.wire.messages import Hello


class TimedMap:
    """A mapper and a solver that take turns. ms: CPU times of each kind of step."""

    def __init__(self, config: Config) -> None:
        self.mapper, self.solver = Mapper(config), PoseGraphSolver()
        self.ms: dict[str, list[float]] = defaultdict(list)
        self.map_events: list[MapEvent] = []

    def join(self, agent: str, hello: Hello) -> None:
        self.mapper.add_run(agent, hello)

    def add(self, agent: str, keyframe: Keyframe) -> None:
        before = self.mapper.report()["removed_keyframes"]
        found, ms = _timed(self.mapper.add_keyframe, agent, keyframe)
        self.ms["add" if self.mapper.report()["removed_keyframes"] == before else "thin"].append(ms)
        self.map_events += found

    def look(self) -> None:
        """Run all pending look-ups."""
        while (step := self.mapper.next_lookup()) is not None:
            result, ms = _timed(step.run)
            self.ms["query" if step.kind == "place" else step.kind].append(ms)
            found, ms = _timed(self.mapper.finish_step, step, result, ms)
            if step.kind == "verify":
                self.ms["judge"].append(ms)
            self.map_events += found

    def solve(self) -> None:
        """Solve all maps that are due."""
        while True:
            step, tell_ms = _timed(self.mapper.next_solve)
            if step is None:
                return
            result, ms = _timed(step.run, self.solver)
            self.ms["solve"].append(ms)
            found, ms = _timed(self.mapper.finish_step, step, result, ms)
            self.ms["apply"].append(ms + tell_ms)
            self.map_events += found


def _timed(work: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return the result of `work`, and its CPU time in ms."""
    began = time.process_time()
    result = work(*arguments)
    return result, 1e3 * (time.process_time() - began)
