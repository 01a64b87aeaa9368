"""Solving maps: what the solver needs to know of a map, and what its solution changes."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from share.geometry import se3
from share.mapping.agent_runs import AgentRuns
from share.mapping.graph.solver import GraphSolution, GraphUpdate
from share.mapping.localisation_gate import LocalisationGate, PlacementUncertainty, sigma_ahead
from share.mapping.loop_acceptance import LoopAcceptance, pending_text
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_gauge import MapGauge, SolvedPose
from share.mapping.map_graph import MapGraph
from share.types import F64, Correction

_OUTLIER_CHI2 = 1000.0  # loops with a larger chi-squared after a solution are dropped
_MIN_STEP_VARIANCE = 1e-8  # m^2, below the floor of any step


@dataclass(frozen=True, eq=False)
class AppliedSolution:
    """Changes made by a solution.

    corrections: by agent. added, dropped: loops accepted or removed because of it. waiting_sigma_m: agents
    whose correction the localisation gate holds back, with the sigma (m) of their position.
    """

    corrections: dict[str, Correction]
    reason: str
    added: tuple[Loop, ...] = ()
    dropped: tuple[Loop, ...] = ()
    waiting_sigma_m: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class SolveJob:
    """Solve the component of node `anchor`, the gauge, after applying `change`.

    is_reset: `change` is the whole graph, and the solver has to forget what it knew. segments: of the map,
    each with its newest node. covariance_segments: those whose newest node needs a covariance. answered_ids:
    newest keyframe of each agent that this solution answers.
    """

    map_id: str
    segments: tuple[int, ...]
    anchor: int
    newest_nodes: tuple[int, ...]
    covariance_segments: tuple[int, ...]
    change: GraphUpdate
    is_reset: bool
    answered_ids: tuple[tuple[str, int], ...]

    @property
    def covariance_nodes(self) -> tuple[int, ...]:
        """Nodes that need a covariance."""
        return tuple(
            last
            for s, last in zip(self.segments, self.newest_nodes, strict=True)
            if s in self.covariance_segments
        )


class MapSolving:
    """Makes solver jobs for the maps of one graph and applies their solutions."""

    def __init__(
        self,
        graph: MapGraph,
        loop_acceptance: LoopAcceptance,
        localisation_gate: LocalisationGate,
        runs: AgentRuns,
    ) -> None:
        self._graph, self._loop_acceptance = graph, loop_acceptance
        self._localisation_gate, self._runs = localisation_gate, runs
        self._gauge = MapGauge()
        self._answered_ids: dict[str, int] = {}  # newest keyframe of each agent with a loop not solved yet

    def mark_answered(self, key: KeyframeKey) -> None:
        """A loop from this keyframe was accepted; the next solution of its map answers it."""
        self._answered_ids[key.agent] = max(key.id, self._answered_ids.get(key.agent, -1))

    def remove_run(self, agent: str) -> None:
        self._answered_ids.pop(agent, None)

    def forget_all_but(self, segments: Collection[int]) -> None:
        """Forget what was published to all but these segments: the others have no keyframes."""
        self._gauge.forget_all_but(segments)

    def schedule_unpublished(self, agent: str) -> None:
        """Solve the map of a run that reconnected, unless its pose there was published."""
        segment = self._graph.odometry.current_segment(agent)
        if segment is None or segment not in self._graph.odometry.live_segments:
            return
        reference_segment = self._graph.reference_segments[segment]
        if (
            reference_segment != segment
            and self._localisation_gate.published_cov(segment, reference_segment) is None
        ):
            self._graph.unsolved_maps[reference_segment] = None

    def due_maps(self) -> list[str]:
        """Names of maps that changed since their last job, longest waiting first."""
        return [self._graph.odometry.segments[reference].name for reference in self._graph.unsolved_maps]

    def make_job(self, map_id: str) -> SolveJob:
        """Return the solver job of a map. Raises ValueError if there is no such map."""
        graph = self._graph
        reference_segment = graph.find_map(map_id)
        segments = tuple(graph.map_segments(reference_segment))
        agents = {graph.odometry.segments[s].agent for s in segments}
        graph.unsolved_maps.pop(reference_segment, None)
        is_reset = graph.edges.is_reset
        return SolveJob(
            map_id,
            segments,
            graph.anchor(reference_segment),
            tuple(graph.odometry.segments[s].nodes[-1] for s in segments),
            self._segments_wanting_covariance(reference_segment, segments),
            graph.edges.take_update(graph.poses, graph.gravity_factors),
            is_reset,
            tuple(
                (agent, self._answered_ids.pop(agent)) for agent in sorted(agents & self._answered_ids.keys())
            ),
        )

    def _segments_wanting_covariance(
        self, reference_segment: int, segments: Sequence[int]
    ) -> tuple[int, ...]:
        """Segments that need a covariance: of agents that are answered, or unpublished in this map.

        Absent agents that would enter the map are left out; those in it before a restart are not.
        """
        odometry = self._graph.odometry
        return tuple(
            s
            for s in segments
            if odometry.current_segment(agent := odometry.segments[s].agent) == s
            and (
                not self._runs.is_absent(agent) or self._localisation_gate.is_published(s, reference_segment)
            )
            and (
                agent in self._answered_ids
                or self._localisation_gate.published_cov(s, reference_segment) is None
            )
        )

    def apply(self, job: SolveJob, solution: GraphSolution) -> AppliedSolution:
        """Apply a solution; keyframes and loops that arrived meanwhile are kept.

        If the map was merged or split meanwhile, the solution is discarded and the map is due again.
        """
        graph = self._graph
        reference_segment = job.segments[0]
        if tuple(graph.map_segments(reference_segment)) != job.segments:
            if reference_segment in graph.odometry.live_segments:
                graph.unsolved_maps[graph.reference_segments[reference_segment]] = None
            self._answered_ids = dict(job.answered_ids) | self._answered_ids
            graph.edges.mark_moved(n for n in solution.pose_ids.tolist() if n in graph.poses)
            return AppliedSolution({}, f"map {job.map_id}: merged or split while being solved, due again")
        if solution.reason:
            return AppliedSolution({}, f"map {job.map_id}: not solved, {solution.reason}")
        self._apply_poses(job, solution)
        outlier_ids = solution.loop_ids[solution.loop_chi2 > _OUTLIER_CHI2].tolist()
        dropped = graph.drop_loops([n for n in outlier_ids if n in graph.edges.loops]) if outlier_ids else ()
        added = self._loop_acceptance.accept_fitting()
        waiting = self._update_gate(job, solution)
        corrections, failed = self._corrections(job)
        loop_count = sum(
            count
            for (segment, _), count in graph.loop_counts.items()
            if graph.reference_segments[segment] == reference_segment
        )
        counts = f"{len(solution.pose_ids)} poses, {loop_count} loops solved"
        reason = f"map {job.map_id}: {counts}, corrections for {', '.join(corrections) or 'no agent'}"
        reason += "".join(f"; {agent}: {cause}" for agent, cause in failed.items())
        if dropped:
            reason += f"; outlier loops removed: {', '.join(map(str, dropped))}"
        return AppliedSolution(corrections, reason + pending_text(added), added, dropped, waiting)

    def _apply_poses(self, job: SolveJob, solution: GraphSolution) -> None:
        graph = self._graph
        graph.poses.assign(solution.pose_ids, solution.poses)
        for segment, last in zip(job.segments, job.newest_nodes, strict=True):
            nodes = graph.odometry.segments[segment].nodes
            graph.propagate(nodes[bisect_right(nodes, last) :])

    def _update_gate(self, job: SolveJob, solution: GraphSolution) -> dict[str, float]:
        """Pass the new covariances to the localisation gate. Return the sigma (m) of agents that wait."""
        odometry, nodes = self._graph.odometry, self._graph.odometry.nodes
        covariances = dict(zip(job.covariance_nodes, solution.covariances, strict=True))
        answered_ids = dict(job.answered_ids)
        uncertainties = {
            segment: PlacementUncertainty(
                se3.inverse_cov(nodes[last].T_odom_body, covariances[last]),
                sigma_ahead(covariances[last]),
                answered_ids.get(odometry.segments[segment].agent),
                odometry.segments[segment].is_worn,
            )
            for segment, last in zip(job.segments, job.newest_nodes, strict=True)
            if last in covariances and last in nodes
        }
        self._localisation_gate.forget_waits(self._graph.split_segments)
        self._graph.split_segments.clear()
        waiting = self._localisation_gate.update(job.segments[0], job.segments, uncertainties)
        return {odometry.segments[s].agent: sigma_m for s, sigma_m in waiting.items()}

    def _corrections(self, job: SolveJob) -> tuple[dict[str, Correction], dict[str, str]]:
        """Corrections of the agents that passed the gate, and why those of others are invalid.

        Keyframes newer than the solution follow the newest solved one rigidly.
        """
        graph, odometry, answered_ids = self._graph, self._graph.odometry, dict(job.answered_ids)
        passed: dict[int, tuple[int, F64]] = {}  # by segment: newest solved node, and covariance
        for segment, last in zip(job.segments, job.newest_nodes, strict=True):
            cov = self._localisation_gate.published_cov(segment, job.segments[0])
            is_current = odometry.current_segment(odometry.segments[segment].agent) == segment
            if cov is not None and is_current and last in odometry.nodes:
                passed[segment] = last, cov
        published = self._gauge.publish(job.segments[0], self._solved_poses(passed))
        out: dict[str, Correction] = {}
        failed: dict[str, str] = {}
        for segment, (last, cov) in passed.items():
            agent, map_id = odometry.segments[segment].agent, graph.map_id(segment)
            about_id, answered_id = odometry.nodes[last].key.id, answered_ids.get(agent, -1)
            try:
                out[agent] = Correction(published[segment], cov, map_id, 0, about_id, answered_id)
            except ValueError as error:
                failed[agent] = f"no correction: {error}"
        return out, failed

    def _solved_poses(self, passed: Mapping[int, tuple[int, F64]]) -> dict[int, SolvedPose]:
        """Poses of segments at their newest solved nodes. passed: by segment, node and covariance (6, 6) of
        T_map_odom. Computed at once: one by one they would take most of the time of applying a solution."""
        if not passed:
            return {}
        graph, odometry = self._graph, self._graph.odometry
        node_ids = [node_id for node_id, _ in passed.values()]
        T_odom_body = np.array([odometry.nodes[n].T_odom_body for n in node_ids])
        T_body_odom = se3.inverse(T_odom_body)
        T_map_odom = se3.orthonormal(graph.poses.stack(node_ids) @ T_body_odom)
        body_covs = se3.inverse_cov(T_body_odom, np.array([cov for _, cov in passed.values()]))
        out = {}
        for i, (segment, (node_id, cov)) in enumerate(passed.items()):
            previous = odometry.previous_node(node_id)
            step_cov = cov if previous is None else graph.odometry_edge(previous, node_id).cov
            variance = max(_MIN_STEP_VARIANCE, se3.position_sigma(step_cov) ** 2)
            out[segment] = SolvedPose(T_map_odom[i], T_odom_body[i], sigma_ahead(body_covs[i]), variance)
        return out
