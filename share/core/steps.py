"""The slow steps of mapping, as frozen values: whoever runs them hands the result back to the mapper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from share.config import PlaceConfig
from share.graph.change import Solution
from share.graph.solver import Solver
from share.merge.solving import SolveJob
from share.place.index import Candidate, PlaceIndex
from share.place.missing import missing
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
    """Are they the same place? Best candidates first; `enough` that are make the rest needless."""

    number: int
    sight: Sight
    candidates: Mapping[int, Sight]
    enough: int
    config: PlaceConfig
    kind: str = "verify"

    def run(self) -> dict[int, Verified | Refusal]:
        outcomes: dict[int, Verified | Refusal] = {}
        for number, sight in self.candidates.items():
            outcome = verify(self.sight, sight, self.config)
            if isinstance(outcome, Verified):
                outcome = replace(outcome, found=1 - missing(self.sight, sight, outcome.T_c_q).share)
            outcomes[number] = outcome
            if sum(isinstance(found, Verified) for found in outcomes.values()) >= self.enough:
                break
        return outcomes


@dataclass(frozen=True, eq=False)
class Solve:
    """Where was everybody?"""

    job: SolveJob
    kind: str = "solve"

    def run(self, solver: Solver) -> Solution:
        if self.job.anew:
            solver.clear()
        solver.update(self.job.change)
        return solver.solve(self.job.anchor, self.job.last)


Look = Query | Verify
Step = Query | Verify | Solve
