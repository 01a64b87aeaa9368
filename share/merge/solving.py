"""The question to the solver about one map."""

from __future__ import annotations

from dataclasses import dataclass

from share.graph.change import Change


@dataclass(frozen=True, eq=False)
class SolveJob:
    """Solve what is joined to node `anchor`, which is the gauge, once `change` is known. anew: that is all
    there is; whatever the solver knew before is nothing.

    stretches: of the map, and of each the newest node. asked: those stretches for whose newest nodes
    covariances are asked. answers: per agent, the keyframe whose loop is answered.
    """

    map_id: str
    stretches: tuple[int, ...]
    anchor: int
    last: tuple[int, ...]
    asked: tuple[int, ...]
    change: Change
    anew: bool
    answers: tuple[tuple[str, int], ...]

    @property
    def wanted(self) -> tuple[int, ...]:
        """The nodes whose covariances are asked for."""
        return tuple(last for s, last in zip(self.stretches, self.last, strict=True) if s in self.asked)
