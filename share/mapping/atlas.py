"""The joint map of all agents: stretches of odometry, and the loops that tie them together.

Plain sequential calls without clock or thread. Solving is somebody else's: `make_job` hands out what is
new, `apply_solution` takes the solution in.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from share.config import MergeConfig
from share.geometry import se3
from share.mapping.agents.agreement import AgentStanding
from share.mapping.agents.covariance_scales import inflate_covariance, make_gravity_factor
from share.mapping.agents.quarantine import Quarantine, QuarantineChange
from share.mapping.corrections import LocalisationGate, PlacementUncertainty
from share.mapping.culling import KeyframeCulling, OdometryLink, RemovedKeyframe, reconnect, remove_keyframe
from share.mapping.graph.updates import GraphSolution, GraphUpdate
from share.mapping.loop_acceptance import LoopAcceptance, LoopDecision, pending_text
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_graph import MapGraph
from share.mapping.overlap_check import OverlapCheck
from share.mapping.query_queue import rank_candidates
from share.mapping.recognition.depth_scale import DepthScale
from share.mapping.recognition.verification import CameraView
from share.mapping.segments import AgentRuns
from share.types import F64, Correction, Keyframe


@dataclass(frozen=True, eq=False)
class AppliedSolution:
    """What a solution changed. corrections: by agent. tied, dropped: loops that are believed since, and those
    that are no longer. waiting: agents who do not hear of it yet, since it knows them to so many m only."""

    corrections: dict[str, Correction]
    reason: str
    added: tuple[Loop, ...] = ()
    dropped: tuple[Loop, ...] = ()
    waiting_sigma_m: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RestoredKeyframe:
    """A keyframe as an earlier life kept it. stretch: by name. T_ref_body (4, 4), cov (6, 6): of the step
    that leads to it, as the agent sent it or as the pose graph had it."""

    key: KeyframeKey
    segment_name: str
    ordinal: int
    keyframe: Keyframe
    T_ref_body: F64
    cov: F64
    is_as_sent: bool


class Atlas:
    """All keyframes of all agents, in maps."""

    def __init__(self, config: MergeConfig, camera_views: Mapping[int, CameraView] | None = None) -> None:
        """sights: what each keyframe saw, by its number; kept by whoever asks."""
        self._config = config
        known_views: Mapping[int, CameraView] = {} if camera_views is None else camera_views
        self._graph = MapGraph()
        self._loop_acceptance = LoopAcceptance(config, self._graph, OverlapCheck(self._graph, known_views))
        self._answered_ids: dict[str, int] = {}  # agent -> its newest keyframe that a loop came from
        self._localisation_gate = LocalisationGate(config.enter_m, config.enter_patience)
        self._runs = AgentRuns()
        self._culling = KeyframeCulling(config, self._graph, self._runs)
        self._quarantine = Quarantine(config.scale_tolerance, self._graph, self._loop_acceptance, known_views)

    # ------------------------------------------------------------ what is known

    def __len__(self) -> int:
        return len(self._graph.poses)

    def pose(self, key: KeyframeKey) -> F64:
        """T_map_body (4, 4), in the map that `map_id` names. Raises ValueError if unknown."""
        return self._graph.poses[self._graph.odometry.node_id(key)]

    def map_id(self, key: KeyframeKey) -> str:
        """Raises ValueError if there is no such keyframe."""
        return self._graph.map_id(self._graph.segment(key))

    def current_map_id(self, agent: str) -> str | None:
        """The map that the agent's present stretch is in; None before its first keyframe."""
        segment = self._graph.odometry.current_segment(agent)
        return None if segment is None else self._graph.map_id(segment)

    def map_sizes(self) -> dict[str, int]:
        """How many keyframes each map has."""
        out = Counter[str]()
        for segment in sorted(self._graph.odometry.live_segments):
            out[self._graph.map_id(segment)] += len(self._graph.odometry.segments[segment].nodes)
        return out

    def T_map_odom(self, agent: str) -> F64 | None:
        """Where the agent's present odometry lies in its map; None before its first keyframe."""
        newest = self._graph.odometry.newest_node(agent)
        return None if newest is None else self._graph.T_map_odom(newest)

    def key(self, node_id: int) -> KeyframeKey:
        """Of the keyframe with this number."""
        return self._graph.odometry.nodes[node_id].key

    def neighbours(self, node_id: int) -> tuple[int, ...]:
        """The keyframe, and those that odometry ties to it too closely for a loop."""
        odometry, disagreement = self._graph.odometry, self._config.min_loop_gap
        nodes = odometry.segments[odometry.nodes[node_id].segment].nodes
        position = bisect_left(nodes, node_id)
        nearby = nodes[max(0, position - disagreement) : position + disagreement]
        return tuple(n for n in nearby if odometry.are_neighbours(n, node_id, disagreement))

    def rank_candidates(self, node_id: int, others: Sequence[int]) -> list[int]:
        """Keyframes that look like this one, those whose loop would tell most first."""
        return rank_candidates(self._graph, node_id, others)

    def all_poses(self) -> tuple[tuple[KeyframeKey, ...], F64, tuple[str, ...]]:
        """Every keyframe, its T_map_body (N, 4, 4), and its map."""
        nodes, poses = self._graph.odometry.nodes, self._graph.poses
        keys = tuple(node.key for node in nodes.values())
        maps = tuple(self._graph.map_id(node.segment) for node in nodes.values())
        return keys, np.array([poses[n] for n in nodes]).reshape(-1, 4, 4), maps

    @property
    def pending(self) -> tuple[Loop, ...]:
        """Loops that wait for a witness, oldest first."""
        return tuple(self._loop_acceptance.pending)

    @property
    def loops(self) -> tuple[Loop, ...]:
        """Accepted loops, oldest first."""
        return tuple(self._graph.edges.loops.values())

    # ------------------------------------------------------------ what arrives

    def add_run(self, agent: str, name: str, credential: str | None = "") -> None:
        """A run of the agent of this name comes. voice: see `Subjects.speaks`."""
        self._runs.add(agent, name)
        self._quarantine.add_run(agent, name, credential)

    def set_present(self, agent: str, is_present: bool) -> None:
        """Who is not heard need not be told where he is, and nobody waits for him. Once he is heard again, a
        map that he does not know of is due."""
        if self._runs.set_present(agent, is_present) and is_present:
            segment = self._graph.odometry.current_segment(agent)
            if segment is not None and segment in self._graph.odometry.live_segments:
                self._schedule_solve(segment)

    def is_run_gone(self, agent: str) -> bool:
        """Whether it is not heard, and nothing of it is left."""
        return self._runs.is_absent(agent) and not self._graph.odometry.has_nodes(agent)

    def remove_run(self, agent: str) -> None:
        """A run of which nothing is left will not come back."""
        self._runs.remove(agent)
        self._quarantine.remove_run(agent)
        self._answered_ids.pop(agent, None)
        self._graph.odometry.remove_agent(agent)

    def _schedule_solve(self, segment: int) -> None:
        reference_segment = self._graph.reference_segments[segment]
        if (
            reference_segment != segment
            and self._localisation_gate.published_cov(segment, reference_segment) is None
        ):
            self._graph.unsolved_maps[reference_segment] = None

    def reconnect(self, agent: str, keyframe: Keyframe) -> tuple[Keyframe, OdometryLink | None]:
        """Before it is added: a keyframe whose reference was taken out, tied to what is left of its stretch,
        and the odometry edge that leads to it now. None: as it came."""
        graph, reference = self._graph, KeyframeKey(agent, keyframe.reference)
        current = graph.odometry.current_segment(agent)
        if keyframe.reference < 0 or graph.odometry.has_keyframe(reference) or current is None:
            return keyframe, None
        newest_id = graph.odometry.newest_node(agent)
        link = reconnect(agent, keyframe, None if newest_id is None else graph.odometry.nodes[newest_id])
        if link.reference is None:
            return keyframe, link
        stored_link = replace(link, cov=inflate_covariance(self._config, link.T_ref_body, link.cov))
        return replace(
            keyframe, reference=link.reference.id, T_ref_body=link.T_ref_body, cov=link.cov
        ), stored_link

    def add_keyframe(self, agent: str, keyframe: Keyframe, rank: int = 0) -> int:
        """Its number here. A keyframe without a reference founds a map of its own; of maps that are joined,
        the oldest of those of the least rank keeps its name and place.

        Raises ValueError for a keyframe known already or whose reference is unknown.
        """
        c = self._config
        cov, gravity_factor = (
            inflate_covariance(c, keyframe.T_ref_body, keyframe.cov),
            make_gravity_factor(c, keyframe),
        )
        node_id = self._graph.add_keyframe(agent, keyframe, cov, gravity_factor, rank)
        self._quarantine.add_step(node_id, keyframe.T_ref_body, cov)
        return node_id

    def restore(
        self,
        segments: Sequence[tuple[str, int]],
        keyframes: Iterable[RestoredKeyframe],
        loops: Iterable[Loop],
        T_map_body: Mapping[KeyframeKey, F64],
    ) -> list[int]:
        """What an earlier life knew; this one must be empty. stretches: of every one there was, in order, the
        agent and its rank.

        Returns the keyframes' numbers. All maps are due.
        """
        graph, segment_by_name = self._graph, {}
        for agent, rank in segments:
            segment = graph.odometry.new_segment(agent, rank)
            segment_by_name[graph.odometry.segments[segment].name] = segment
        node_ids = []
        for restored in keyframes:
            cov = (
                inflate_covariance(self._config, restored.T_ref_body, restored.cov)
                if restored.is_as_sent
                else restored.cov
            )
            T_odom_body = restored.keyframe.T_odom_body
            node_ids.append(
                graph.odometry.append_node(
                    restored.key, segment_by_name[restored.segment_name], T_odom_body, restored.ordinal
                )
            )
            graph.add_node(
                node_ids[-1], restored.T_ref_body, cov, make_gravity_factor(self._config, restored.keyframe)
            )
            self._quarantine.add_step(node_ids[-1], restored.T_ref_body, cov)
            graph.poses[node_ids[-1]] = T_map_body.get(restored.key, graph.poses[node_ids[-1]])
        for loop in loops:
            graph.add_loop(loop)
        self._quarantine.suspect_restored()
        for agent in {agent for agent, _ in segments}:
            current = graph.odometry.current_segment(agent)
            if current is not None and graph.odometry.segments[current].nodes:  # a damaged file may lack them
                self._localisation_gate.restore(current, graph.reference_segments[current])
        return node_ids

    def choose_redundant(self, count: int) -> list[int]:
        """Numbers of so many keyframes, if there are as many that may go: see `KeyframeCulling`."""
        return self._culling.choose(count)

    def remove_keyframes(self, node_ids: Iterable[int]) -> list[RemovedKeyframe]:
        """These keyframes, but for those that have to stay by now."""
        graph, removed = self._graph, list[RemovedKeyframe]()
        for node_id in node_ids:
            if node_id in graph.poses and self._culling.is_removable(node_id):
                segment = graph.odometry.nodes[node_id].segment
                removed.append(
                    self._quarantine.to_agent_scale(remove_keyframe(graph, node_id, self._config.most_loops))
                )
                graph.update_maps()
                if segment not in graph.odometry.live_segments:
                    self._localisation_gate.forget([segment])
        live = {graph.reference_segments[segment] for segment in graph.odometry.live_segments}
        graph.unsolved_maps = dict.fromkeys(
            reference_segment for reference_segment in graph.unsolved_maps if reference_segment in live
        )
        self._loop_acceptance.remove_keyframes({out.key for out in removed})
        self._quarantine.agreement.remove_nodes(
            [out.node_id for out in removed], graph.odometry.live_segments
        )
        return removed

    def propose(self, loop: Loop) -> LoopDecision:
        """A verified loop from candidate a to query b: accepted, waiting, or refused, with the reason. Raises
        ValueError if either keyframe is unknown."""
        if reason := self._quarantine.separation_reason(loop):
            return LoopDecision(False, f"loop {loop}: {reason}")
        decision = self._loop_acceptance.decide(loop)
        if decision.accepted:  # loops that waited are believed because of it: it is what is answered
            self._answered_ids[loop.b.agent] = max(loop.b.id, self._answered_ids.get(loop.b.agent, -1))
        return decision

    def compare_agents(self, loop: Loop, depth_scale: DepthScale | None) -> QuarantineChange:
        """A verified loop, before it is proposed, says how its agents agree: see `Quarantine`."""
        return self._quarantine.add_loop(loop, depth_scale)

    def rescale_loop(self, loop: Loop, depth_scale: DepthScale | None) -> Loop:
        """A loop in true metres, so far as they are known: see `Quarantine`."""
        return self._quarantine.rescale_loop(loop, depth_scale)

    def standing(self, agent: str) -> AgentStanding:
        """How the agent agrees with the others."""
        return self._quarantine.agreement.standing(agent)

    def contradictions(self) -> dict[tuple[str, str], float]:
        """See `Agreement`."""
        return self._quarantine.agreement.contradictions()

    def are_separated(self, first: str, second: str) -> bool:
        """Whether these agents must not come into one map."""
        return bool(self._quarantine.agreement.separation_reason([first], [second]))

    def separated_keyframes(self, node_id: int) -> tuple[int, ...]:
        """Keyframes of agents that must not come into one map with this one's."""
        return self._quarantine.quarantined_nodes(self.key(node_id).agent)

    def review_joins(self, node_id: int) -> LoopDecision | None:
        """Whether what this keyframe saw speaks against a young join of its map: it is undone."""
        return self._loop_acceptance.review_joins(node_id)

    # ------------------------------------------------------------ the solver's side

    def due_maps(self) -> list[str]:
        """Maps with news that no job has had yet, the oldest news first."""
        return [
            self._graph.odometry.segments[reference_segment].name
            for reference_segment in self._graph.unsolved_maps
        ]

    def make_job(self, map_id: str) -> SolveJob:
        """What the solver has to know to solve this map. ValueError if there is none."""
        graph = self._graph
        reference_segment = graph.find_map(map_id)
        segments = tuple(graph.map_segments(reference_segment))
        agents = {graph.odometry.segments[s].agent for s in segments}
        graph.unsolved_maps.pop(reference_segment, None)
        anew = graph.edges.is_reset
        return SolveJob(
            map_id,
            segments,
            graph.anchor(reference_segment),
            tuple(graph.odometry.segments[s].nodes[-1] for s in segments),
            self._segments_wanting_covariance(reference_segment, segments),
            graph.edges.take_update(graph.poses, graph.gravity_factors),
            anew,
            tuple(
                (agent, self._answered_ids.pop(agent)) for agent in sorted(agents & self._answered_ids.keys())
            ),
        )

    def _segments_wanting_covariance(
        self, reference_segment: int, segments: Sequence[int]
    ) -> tuple[int, ...]:
        """Whose covariance is worth its time: who is answered, or never heard how sure he is in this map. Not
        who is away and would come into it; but who was in it before a restart is told with his welcome."""
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

    def reset_solver(self) -> None:
        """The solver knows nothing any more: the next job tells everything."""
        self._graph.edges.reset()

    def apply_solution(self, job: SolveJob, solution: GraphSolution) -> AppliedSolution:
        """Take a solution in; keyframes and loops that came meanwhile are kept.

        If the map was joined or split meanwhile the solution no longer speaks of it: it is left
        aside and the map is due again.
        """
        graph = self._graph
        reference_segment = job.segments[0]
        if tuple(graph.map_segments(reference_segment)) != job.segments:
            if reference_segment in graph.odometry.live_segments:
                graph.unsolved_maps[graph.reference_segments[reference_segment]] = None
            self._answered_ids = dict(job.answered_ids) | self._answered_ids
            graph.edges.mark_moved(n for n in solution.pose_ids.tolist() if n in graph.poses)
            return AppliedSolution({}, f"map {job.map_id}: joined or split while it was solved, due again")
        if solution.reason:
            return AppliedSolution({}, f"map {job.map_id}: not solved, {solution.reason}")
        self._apply_poses(job, solution)
        outlier_ids = solution.loop_ids[solution.loop_chi2 > self._config.drop_chi2].tolist()
        dropped = graph.drop_loops([n for n in outlier_ids if n in graph.edges.loops]) if outlier_ids else ()
        added = self._loop_acceptance.accept_fitting()
        waiting = self._update_gate(job, solution)
        corrections, failed = self._corrections(job)
        counts = f"{len(solution.pose_ids)} poses, {len(solution.loop_ids)} loops solved"
        reason = f"map {job.map_id}: {counts}, corrects {', '.join(corrections) or 'nobody'}"
        reason += "".join(f"; {agent}: {cause}" for agent, cause in failed.items())
        if dropped:
            reason += f"; dropped loops at odds with it: {', '.join(map(str, dropped))}"
        return AppliedSolution(corrections, reason + pending_text(added), added, dropped, waiting)

    def _apply_poses(self, job: SolveJob, solution: GraphSolution) -> None:
        graph = self._graph
        for node_id, T in zip(solution.pose_ids.tolist(), solution.poses, strict=True):
            if node_id in graph.poses:
                graph.poses[node_id] = T
        for segment, last in zip(job.segments, job.newest_nodes, strict=True):
            graph.propagate(n for n in graph.odometry.segments[segment].nodes if n > last)

    def _update_gate(self, job: SolveJob, solution: GraphSolution) -> dict[str, float]:
        """Of those who were asked for. Returns which agents wait to hear of this map: their spread, m."""
        odometry, covariances = (
            self._graph.odometry,
            dict(zip(job.covariance_nodes, solution.covariances, strict=True)),
        )
        nodes, answers = odometry.nodes, dict(job.answered_ids)
        placements = {
            segment: PlacementUncertainty(
                se3.inverse_cov(nodes[last].T_odom_body, covariances[last]),
                se3.position_sigma(covariances[last]),
                answers.get(odometry.segments[segment].agent),
            )
            for segment, last in zip(job.segments, job.newest_nodes, strict=True)
            if last in covariances and last in nodes
        }
        self._localisation_gate.forget_waits(self._graph.split_segments)
        self._graph.split_segments.clear()
        waiting = self._localisation_gate.update(job.segments[0], job.segments, placements)
        return {odometry.segments[s].agent: spread for s, spread in waiting.items()}

    def _corrections(self, job: SolveJob) -> tuple[dict[str, Correction], dict[str, str]]:
        """For whom the map knows surely enough; those after the newest that was solved hang on it rigidly.
        And of whom a correction would be none, with the reason: that costs nobody else."""
        odometry, answers = self._graph.odometry, dict(job.answered_ids)
        out: dict[str, Correction] = {}
        failed: dict[str, str] = {}
        for segment, last in zip(job.segments, job.newest_nodes, strict=True):
            agent, cov = (
                odometry.segments[segment].agent,
                self._localisation_gate.published_cov(segment, job.segments[0]),
            )
            if cov is None or odometry.current_segment(agent) != segment or last not in odometry.nodes:
                continue  # he waits, or that odometry has ended: nothing is left to correct
            T_map_odom, map_id = self._graph.T_map_odom(last), self._graph.map_id(segment)
            about_id, answered_id = odometry.nodes[last].key.id, answers.get(agent, -1)
            try:
                out[agent] = Correction(T_map_odom, cov, map_id, 0, about_id, answered_id)
            except ValueError as error:
                failed[agent] = f"no correction, {error}"
        return out, failed


# ---- The question to the solver about one map.


@dataclass(frozen=True, eq=False)
class SolveJob:
    """Solve what is joined to node `anchor`, which is the gauge, once `change` is known. anew: that is all
    there is; whatever the solver knew before is nothing.

    stretches: of the map, and of each the newest node. asked: those stretches for whose newest nodes
    covariances are asked. answers: per agent, the keyframe whose loop is answered.
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
        """The nodes whose covariances are asked for."""
        return tuple(
            last
            for s, last in zip(self.segments, self.newest_nodes, strict=True)
            if s in self.covariance_segments
        )
