"""The slow steps of mapping, frozen values that the caller runs, and the jobs that yield them."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Any

from share.mapping.corrections import MapEvent
from share.mapping.graph.solver import GraphSolution, PoseGraphSolver
from share.mapping.map_solving import SolveJob
from share.mapping.recognition.index import U32, PlaceCandidate, PlaceIndex
from share.mapping.recognition.keyframe_views import IndexEntry
from share.mapping.recognition.patch_alignment import (
    ImageView,
    align_from_map,
    align_undetermined,
    align_verified,
)
from share.mapping.recognition.verification import (
    GRAVITY_DEG,
    CameraView,
    Refusal,
    Verification,
    gravity_difference_deg,
    verify,
)
from share.types import F64, View


@dataclass(frozen=True, eq=False)
class DescribeStep:
    """Find the ORB features of a keyframe's image."""

    node_id: int
    image: ImageView
    kind: str = "describe"

    def run(self) -> View:
        return self.image.describe()


@dataclass(frozen=True, eq=False)
class IndexStep:
    """Hash the descriptors of restored keyframes: words of each."""

    node_id: int  # one of them
    index: PlaceIndex
    entries: Sequence[IndexEntry]
    kind: str = "index"

    def run(self) -> dict[int, U32]:
        return {node_id: self.index.words(descriptors) for node_id, descriptors in self.entries}


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
    """Verify one candidate by its ORB features, and align the images where there are any: relative pose, or a
    refusal. Where the features do not determine a pose, the images may."""

    node_id: int
    query_view: CameraView
    candidate_id: int
    candidate_view: CameraView
    query_image: ImageView | None = None
    candidate_image: ImageView | None = None
    kind: str = "verify"

    def run(self) -> Verification | Refusal:
        verified = verify(self.query_view, self.candidate_view)
        if self.query_image is None or self.candidate_image is None:
            return verified
        if isinstance(verified, Verification):
            return align_verified(verified, self.query_image, self.candidate_image)
        aligned = align_undetermined(verified, self.query_image, self.candidate_image)
        if isinstance(aligned, Refusal):
            return verified
        turned = gravity_difference_deg(aligned.T_c_q, self.query_view, self.candidate_view)
        return aligned if turned <= GRAVITY_DEG else verified


@dataclass(frozen=True, eq=False)
class AlignStep:
    """Verify a candidate of the same map: align the images from the pose that the map has.

    T_c_q (4, 4): body of the keyframe in the candidate's body frame."""

    node_id: int
    query_image: ImageView
    candidate_id: int
    candidate_image: ImageView
    T_c_q: F64
    kind: str = "align"

    def run(self) -> Verification | Refusal:
        return align_from_map(self.T_c_q, self.query_image, self.candidate_image)


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


LookupStep = DescribeStep | IndexStep | QueryStep | VerifyStep | AlignStep
Step = LookupStep | SolveStep

# Yields in turn a step, whose result or exception it is sent, and the events that follow from it.
Job = Generator[Any, Any, None]


class StepRunner:
    """Runs one job at a time, step by step. is_running: a step is with the caller."""

    def __init__(self) -> None:
        self._job: Job | None = None
        self.is_running = False

    def start(self, job: Job) -> None:
        """Begin a job, in place of one without further steps."""
        self._job = job

    def next_step(self) -> Any:
        """Next step of the job; None if it has no more."""
        step = None if self._job is None else next(self._job, None)
        self.is_running = step is not None
        return step

    def finish(self, result: Any) -> list[MapEvent]:
        """Return the events that follow from a step's result. Raises what the job does not catch."""
        self.is_running = False
        assert self._job is not None
        events: list[MapEvent] = (
            self._job.throw(result) if isinstance(result, Exception) else self._job.send(result)
        )
        return events
