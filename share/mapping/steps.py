"""The slow steps of mapping, as frozen values: whoever runs them hands the result back to the mapper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.config import PlaceConfig
from share.mapping.atlas import SolveJob
from share.mapping.graph.solver import PoseGraphSolver
from share.mapping.graph.updates import GraphSolution
from share.mapping.recognition.index import PlaceCandidate, PlaceIndex
from share.mapping.recognition.verification import CameraView, Refusal, Verification, verify
from share.types import F64, Correction


@dataclass(frozen=True, eq=False)
class QueryStep:
    """Which stored keyframes look like this one?"""

    index: PlaceIndex
    node_id: int
    camera_view: CameraView
    limit: int
    excluded: tuple[int, ...]
    kind: str = "place"

    def run(self) -> list[PlaceCandidate]:
        return self.index.query(self.camera_view.view.descriptors, self.limit, self.excluded)


@dataclass(frozen=True, eq=False)
class VerifyStep:
    """Is this the place of that candidate?"""

    node_id: int
    query_view: CameraView
    candidate_id: int
    candidate_view: CameraView
    config: PlaceConfig
    kind: str = "verify"

    def run(self) -> Verification | Refusal:
        return verify(self.query_view, self.candidate_view, self.config)


@dataclass(frozen=True, eq=False)
class SolveStep:
    """Where was everybody?"""

    job: SolveJob
    kind: str = "solve"

    def run(self, solver: PoseGraphSolver) -> GraphSolution:
        if self.job.is_reset:
            solver.clear()
        solver.update(self.job.change)
        return solver.solve(self.job.anchor, self.job.covariance_nodes)


LookupStep = QueryStep | VerifyStep
Step = QueryStep | VerifyStep | SolveStep


# ---- What the mapper decides, and tells the edge.


@dataclass(frozen=True, eq=False)
class MapEvent:
    """Something decided about an agent's run, why, and the correction that follows, if one does."""

    agent: str
    event: str
    reason: str
    correction: Correction | None = None


def map_assignment(
    agent: str, map_id: str, T_map_odom: F64, about_id: int, cov: F64 | None = None
) -> MapEvent:
    """Which map a run is in, before anything moves it there. A map is named after what founded it. about: a
    keyframe of the stretch. cov (6, 6): of T_map_odom; exact where it is the map's own gauge."""
    verb = "starts" if map_id.startswith(f"{agent}/") else "is in"
    return MapEvent(
        agent,
        "correction",
        f"{verb} map {map_id}",
        Correction(T_map_odom, np.zeros((6, 6)) if cov is None else cov, map_id, 0, about_id),
    )
