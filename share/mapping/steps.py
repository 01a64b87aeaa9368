"""The slow steps of mapping, as frozen values: whoever runs them hands the result back to the mapper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.config import PlaceConfig
from share.mapping.atlas import SolveJob
from share.mapping.graph.solver import Solver
from share.mapping.graph.updates import Solution
from share.mapping.recognition.index import Candidate, PlaceIndex
from share.mapping.recognition.verification import Refusal, Sight, Verified, verify
from share.types import F64, Correction


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


# ---- What the mapper decides, and tells the edge.


@dataclass(frozen=True, eq=False)
class Finding:
    """Something decided about an agent's run, why, and the correction that follows, if one does."""

    agent: str
    what: str
    reason: str
    correction: Correction | None = None


def in_map(agent: str, map_id: str, T_map_odom: F64, about: int, cov: F64 | None = None) -> Finding:
    """Which map a run is in, before anything moves it there. A map is named after what founded it. about: a
    keyframe of the stretch. cov (6, 6): of T_map_odom; exact where it is the map's own gauge."""
    founds = "founds" if map_id.startswith(f"{agent}/") else "is in"
    return Finding(
        agent,
        "correction",
        f"{founds} map {map_id}",
        Correction(T_map_odom, np.zeros((6, 6)) if cov is None else cov, map_id, 0, about),
    )
