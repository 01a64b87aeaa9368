"""The slow steps of mapping as frozen values, which the caller runs; results go back to the mapper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.config import PlaceConfig
from share.mapping.graph.solver import PoseGraphSolver
from share.mapping.graph.updates import GraphSolution
from share.mapping.map_solving import SolveJob
from share.mapping.recognition.index import PlaceCandidate, PlaceIndex
from share.mapping.recognition.verification import CameraView, Refusal, Verification, verify
from share.types import F64, Correction


@dataclass(frozen=True, eq=False)
class QueryStep:
    """Find stored keyframes that look like this one."""

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
    """Verify one candidate: relative pose, or a refusal."""

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
    """Optimise one map."""

    job: SolveJob
    kind: str = "solve"

    def run(self, solver: PoseGraphSolver) -> GraphSolution:
        if self.job.is_reset:
            solver.clear()
        solver.update(self.job.change)
        return solver.solve(self.job.anchor, self.job.covariance_nodes)


LookupStep = QueryStep | VerifyStep
Step = QueryStep | VerifyStep | SolveStep


@dataclass(frozen=True, eq=False)
class MapEvent:
    """A decision about an agent's run with its reason, and the correction that follows, if any."""

    agent: str
    event: str
    reason: str
    correction: Correction | None = None


def map_assignment(
    agent: str, map_id: str, T_map_odom: F64, about_id: int, cov: F64 | None = None
) -> MapEvent:
    """Event that assigns a run to a map. A map is named after its reference segment.

    about_id: a keyframe of the run's segment. cov (6, 6): of T_map_odom; None where it is exact, since the
    segment defines the map's frame.
    """
    verb = "starts" if map_id.startswith(f"{agent}/") else "is in"
    return MapEvent(
        agent,
        "correction",
        f"{verb} map {map_id}",
        Correction(T_map_odom, np.zeros((6, 6)) if cov is None else cov, map_id, 0, about_id),
    )
