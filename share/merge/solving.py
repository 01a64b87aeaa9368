"""The pose graph of one map as a frozen question; a worker turns it into a frozen answer."""

from __future__ import annotations

from dataclasses import dataclass

from share.config import GraphConfig
from share.graph.posegraph import Edge, SolvedGraph, solve
from share.types import F64


@dataclass(frozen=True, eq=False)
class SolveJob:
    """All that is known of one map. The first node is the gauge.

    nodes: the atlas's numbers of the poses (N, 4, 4); edges go by them. last: per stretch in
    `stretches`, which pose is its newest. loop_ids: the atlas's numbers of `loops`. answers: per
    agent, the keyframe whose loop is answered.
    """

    map_id: str
    stretches: tuple[int, ...]
    nodes: tuple[int, ...]
    poses: F64
    odometry: tuple[Edge, ...]
    loops: tuple[Edge, ...]
    loop_ids: tuple[int, ...]
    last: tuple[int, ...]
    answers: tuple[tuple[str, int], ...]


@dataclass(frozen=True, eq=False)
class SolveResult:
    job: SolveJob
    solved: SolvedGraph


def run_job(job: SolveJob, config: GraphConfig) -> SolveResult:
    """Solve; pure, so it may run in any thread or process."""
    local = {number: i for i, number in enumerate(job.nodes)}
    odometry, loops = (
        [Edge(local[e.a], local[e.b], e.T_a_b, e.cov) for e in edges] for edges in (job.odometry, job.loops)
    )
    return SolveResult(job, solve(job.poses, odometry, loops, (0,), config, covariances_of=job.last))
