"""The joint map of all agents: odometry segments and the loops that connect them.

Plain sequential calls, without clock or thread.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from share.config import MergeConfig
from share.mapping.agents.agreement import AgentStanding
from share.mapping.agents.covariance_scales import inflate_covariance
from share.mapping.agents.quarantine import Quarantine, QuarantineChange
from share.mapping.corrections import LocalisationGate
from share.mapping.culling import KeyframeCulling, OdometryLink, RemovedKeyframe, reconnect, remove_keyframe
from share.mapping.graph.gravity import make_gravity_factor
from share.mapping.graph.updates import GraphSolution
from share.mapping.loop_acceptance import LoopAcceptance, LoopDecision
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_graph import MapGraph
from share.mapping.map_solving import AppliedSolution, MapSolving, SolveJob
from share.mapping.overlap_check import OverlapCheck
from share.mapping.query_queue import rank_candidates
from share.mapping.recognition.depth_scale import DepthScale
from share.mapping.recognition.verification import CameraView
from share.mapping.segments import AgentRuns
from share.types import F64, Keyframe


@dataclass(frozen=True, eq=False)
class RestoredKeyframe:
    """A keyframe of an earlier session.

    T_ref_body (4, 4), cov (6, 6): of the step that leads to it, as sent (is_as_sent) or as the graph used it.
    """

    key: KeyframeKey
    segment_name: str
    ordinal: int
    keyframe: Keyframe
    T_ref_body: F64
    cov: F64
    is_as_sent: bool


class Atlas:
    """All keyframes of all agents, in maps. Keyframes are numbered by node ids."""

    def __init__(self, config: MergeConfig, camera_views: Mapping[int, CameraView] | None = None) -> None:
        """camera_views: by node id; the caller keeps them up to date."""
        self._config = config
        known_views: Mapping[int, CameraView] = {} if camera_views is None else camera_views
        self._graph = MapGraph()
        self._loop_acceptance = LoopAcceptance(config, self._graph, OverlapCheck(self._graph, known_views))
        self._localisation_gate = LocalisationGate(config.enter_m, config.enter_patience)
        self._runs = AgentRuns()
        self._solving = MapSolving(
            config, self._graph, self._loop_acceptance, self._localisation_gate, self._runs
        )
        self._culling = KeyframeCulling(config, self._graph, self._runs)
        self._quarantine = Quarantine(config.scale_tolerance, self._graph, self._loop_acceptance, known_views)

    # Queries

    def __len__(self) -> int:
        return len(self._graph.poses)

    def pose(self, key: KeyframeKey) -> F64:
        """T_map_body (4, 4), in the map that `map_id` names. Raises ValueError if unknown."""
        return self._graph.poses[self._graph.odometry.node_id(key)]

    def map_id(self, key: KeyframeKey) -> str:
        """Name of the map that contains a keyframe. Raises ValueError if it is unknown."""
        return self._graph.map_id(self._graph.segment(key))

    def current_map_id(self, agent: str) -> str | None:
        """Name of the map of the agent's current segment; None before its first keyframe."""
        segment = self._graph.odometry.current_segment(agent)
        return None if segment is None else self._graph.map_id(segment)

    def map_sizes(self) -> dict[str, int]:
        """Number of keyframes of each map."""
        out = Counter[str]()
        for segment in sorted(self._graph.odometry.live_segments):
            out[self._graph.map_id(segment)] += len(self._graph.odometry.segments[segment].nodes)
        return out

    def T_map_odom(self, agent: str) -> F64 | None:
        """T_map_odom (4, 4) at the agent's newest keyframe; None if its current segment has none."""
        newest = self._graph.odometry.newest_node(agent)
        return None if newest is None else self._graph.T_map_odom(newest)

    def key(self, node_id: int) -> KeyframeKey:
        """Key of the keyframe with this node id."""
        return self._graph.odometry.nodes[node_id].key

    def neighbours(self, node_id: int) -> tuple[int, ...]:
        """The keyframe, and those too close to it by odometry for a loop."""
        odometry, min_gap = self._graph.odometry, self._config.min_loop_gap
        nodes = odometry.segments[odometry.nodes[node_id].segment].nodes
        position = bisect_left(nodes, node_id)
        nearby = nodes[max(0, position - min_gap) : position + min_gap]
        return tuple(n for n in nearby if odometry.are_neighbours(n, node_id, min_gap))

    def rank_candidates(self, node_id: int, others: Sequence[int]) -> list[int]:
        """Sort similar keyframes by how useful a loop with them is."""
        return rank_candidates(self._graph, node_id, others)

    def all_poses(self) -> tuple[tuple[KeyframeKey, ...], F64, tuple[str, ...]]:
        """Every keyframe, its T_map_body (N, 4, 4), and the name of its map."""
        nodes, poses = self._graph.odometry.nodes, self._graph.poses
        keys = tuple(node.key for node in nodes.values())
        maps = tuple(self._graph.map_id(node.segment) for node in nodes.values())
        return keys, np.array([poses[n] for n in nodes]).reshape(-1, 4, 4), maps

    @property
    def pending(self) -> tuple[Loop, ...]:
        """Loops that need a supporting loop, oldest first."""
        return tuple(self._loop_acceptance.pending)

    @property
    def loops(self) -> tuple[Loop, ...]:
        """Accepted loops, oldest first."""
        return tuple(self._graph.edges.loops.values())

    # Keyframes and loops

    def add_run(self, agent: str, name: str, credential: str | None = "") -> None:
        """Register a run of the agent of this name. credential: see `AgentIdentities.set_credential`."""
        self._runs.add(agent, name)
        self._quarantine.add_run(agent, name, credential)

    def set_present(self, agent: str, is_present: bool) -> None:
        """Set whether a run is connected.

        An absent agent is sent nothing and delays nobody's corrections. When it returns, its map is solved if
        its pose there was not published.
        """
        if self._runs.set_present(agent, is_present) and is_present:
            self._solving.schedule_unpublished(agent)

    def is_run_gone(self, agent: str) -> bool:
        """Return whether the run is not connected and has no keyframes."""
        return self._runs.is_absent(agent) and not self._graph.odometry.has_nodes(agent)

    def remove_run(self, agent: str) -> None:
        """Forget a run without keyframes that will not return."""
        self._runs.remove(agent)
        self._quarantine.remove_run(agent)
        self._solving.remove_run(agent)
        self._graph.odometry.remove_agent(agent)

    def reconnect(self, agent: str, keyframe: Keyframe) -> tuple[Keyframe, OdometryLink | None]:
        """Reconnect a keyframe whose reference was removed to the newest one left on its segment.

        Call before `add_keyframe`. Returns the keyframe to add and the odometry edge that leads to it; None
        if the keyframe is unchanged.
        """
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
        """Add a keyframe and return its node id.

        A keyframe without a reference begins a segment and a map. rank: the segment of the least rank, among
        equals the oldest, keeps its map's name and frame in a merge. Raises ValueError for a duplicate or an
        unknown reference.
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
        """Restore an earlier session's map; the atlas must be empty. Returns the keyframes' node ids.

        segments: agent and rank of every segment there was, in order. All maps need solving afterwards.
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
            if current is not None and graph.odometry.segments[current].nodes:  # not in a damaged file
                self._localisation_gate.restore(current, graph.reference_segments[current])
        return node_ids

    def choose_redundant(self, count: int) -> list[int]:
        """Return up to `count` nodes to remove: see `KeyframeCulling`."""
        return self._culling.choose(count)

    def remove_keyframes(self, node_ids: Iterable[int]) -> list[RemovedKeyframe]:
        """Remove keyframes, except those that have to stay by now."""
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
        """Decide on a verified loop from candidate a to query b. Raises ValueError for unknown keyframes."""
        if reason := self._quarantine.separation_reason(loop):
            return LoopDecision(False, f"loop {loop}: {reason}")
        decision = self._loop_acceptance.decide(loop)
        if decision.accepted:  # also answers for pending loops accepted with it
            self._solving.mark_answered(loop.b)
        return decision

    def compare_agents(self, loop: Loop, depth_scale: DepthScale | None) -> QuarantineChange:
        """Compare the agents of a verified loop, before it is proposed: see `Quarantine`."""
        return self._quarantine.add_loop(loop, depth_scale)

    def rescale_loop(self, loop: Loop, depth_scale: DepthScale | None) -> Loop:
        """Correct a loop for the agents' scales, where known: see `Quarantine`."""
        return self._quarantine.rescale_loop(loop, depth_scale)

    def standing(self, agent: str) -> AgentStanding:
        """Return how the agent agrees with the others."""
        return self._quarantine.agreement.standing(agent)

    def contradictions(self) -> dict[tuple[str, str], float]:
        """Severity of the contradictions of each pair of agents: see `AgentAgreement`."""
        return self._quarantine.agreement.contradictions()

    def are_separated(self, first: str, second: str) -> bool:
        """Return whether these agents must be in separate maps."""
        return bool(self._quarantine.agreement.separation_reason([first], [second]))

    def separated_keyframes(self, node_id: int) -> tuple[int, ...]:
        """Nodes of agents that must not share a map with this keyframe's agent."""
        return self._quarantine.quarantined_nodes(self.key(node_id).agent)

    def review_joins(self, node_id: int) -> LoopDecision | None:
        """Undo a recent merge that the view of a new keyframe contradicts; None if there is none."""
        return self._loop_acceptance.review_joins(node_id)

    # Solving: see `MapSolving`

    def due_maps(self) -> list[str]:
        """Names of maps that changed since their last job, longest waiting first."""
        return self._solving.due_maps()

    def make_job(self, map_id: str) -> SolveJob:
        """Return the solver job of a map. Raises ValueError if there is no such map."""
        return self._solving.make_job(map_id)

    def reset_solver(self) -> None:
        """The solver lost its state: the next job contains the whole graph."""
        self._solving.reset()

    def apply_solution(self, job: SolveJob, solution: GraphSolution) -> AppliedSolution:
        """Apply a solution; keyframes and loops that arrived meanwhile are kept."""
        return self._solving.apply(job, solution)
