"""The slow steps of mapping, as frozen values: whoever runs them hands the result back to the mapper."""

from __future__ import annotations

from dataclasses import dataclass

from share.config import PlaceConfig
from share.graph.change import Solution
from share.graph.solver import Solver
from share.merge.solving import SolveJob
from share.place.index import Candidate, PlaceIndex
from share.place.verify import Refusal, Sight, Verified, verify


@dataclass(frozen=True, eq=False)
class Query:
    """Which stored keyframes look like this one?"""

    index: PlaceIndex
    number: int
    sight: Sight
    limit: int
    exclude: tuple[int, ...]
    kind: str = "place"

    def run(self) -> list[Candidate]:
        return self.index.query(self.sight.view.descriptors, self.limit, self.exclude)


@dataclass(frozen=True, eq=False)
class Verify:
    """Is this the place of that candidate?"""

    number: int
    sight: Sight
    candidate: int
    seen: Sight
    config: PlaceConfig
    kind: str = "verify"

    def run(self) -> Verified | Refusal:
        return verify(self.sight, self.seen, self.config)


@dataclass(frozen=True, eq=False)
class Solve:
    """Where was everybody?"""

    job: SolveJob
    kind: str = "solve"

    def run(self, solver: Solver) -> Solution:
        if self.job.anew:
            solver.clear()
        solver.update(self.job.change)
        return solver.solve(self.job.anchor, self.job.wanted)


Look = Query | Verify
Step = Query | Verify | Solve
