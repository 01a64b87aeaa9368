"""The atlas: all maps. A map is a set of odometry segments and the loops that connect them.

Plain sequential calls, without clock or thread.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

from share.config import MergeConfig
from share.mapping.agent_runs import AgentRuns
from share.mapping.agents.quarantine import Quarantine
from share.mapping.culling import KeyframeCulling
from share.mapping.graph.edges import inflate_covariance
from share.mapping.graph.gravity import make_gravity_factor
from share.mapping.keyframe_removal import (
    RemovedKeyframe,
    reconnect,
    remove_keyframe,
    remove_segment,
)
from share.mapping.localisation_gate import LocalisationGate
from share.mapping.loop_acceptance import LoopAcceptance, LoopDecision
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_changes import SaveLink, SavePoses, StoredMap
from share.mapping.map_graph import MapGraph
from share.mapping.map_renewal import MapRenewal
from share.mapping.map_solving import MapSolving
from share.mapping.overlap_check import OverlapCheck
from share.mapping.recognition.verification import CameraView
from share.types import F64, Keyframe


class Atlas:
    """All keyframes of all agents, in maps. Keyframes are numbered by node ids.

    graph: poses, edges and maps. runs: who is present. quarantine: agents that are kept apart.
    loop_acceptance: loops between two maps and within one. solving: jobs of the solver and their solutions.
    culling: keyframes to remove. renewal: keyframes of earlier sessions that show what is gone.
    """

    def __init__(self, config: MergeConfig, camera_views: Mapping[int, CameraView] | None = None) -> None:
        """camera_views: by node id; the caller keeps them up to date."""
        known_views: Mapping[int, CameraView] = {} if camera_views is None else camera_views
        self.graph = MapGraph()
        self.overlap_check = OverlapCheck(self.graph, known_views)
        self.loop_acceptance = LoopAcceptance(config, self.graph, self.overlap_check)
        self.renewal = MapRenewal(self.graph, known_views, self.overlap_check)
        self._localisation_gate = LocalisationGate(config.enter_m)
        self.runs = AgentRuns()
        self.solving = MapSolving(self.graph, self.loop_acceptance, self._localisation_gate, self.runs)
        self.culling = KeyframeCulling(self.graph, self.runs)
        self.quarantine = Quarantine(self.graph, self.loop_acceptance)

    def __len__(self) -> int:
        return len(self.graph.poses)

    # Queries

    def key(self, node_id: int) -> KeyframeKey:
        return self.graph.odometry.nodes[node_id].key

    def pose(self, key: KeyframeKey) -> F64:
        """T_map_body (4, 4), in the map that `map_id` names. Raises ValueError if unknown."""
        return self.graph.poses[self.graph.odometry.node_id(key)]

    def map_id(self, key: KeyframeKey) -> str:
        """Name of the map that contains a keyframe. Raises ValueError if it is unknown."""
        return self.graph.map_id(self.graph.segment(key))

    def current_map_id(self, agent: str) -> str | None:
        """Name of the map of the agent's current segment; None before its first keyframe."""
        segment = self.graph.odometry.current_segment(agent)
        return None if segment is None else self.graph.map_id(segment)

    def map_sizes(self) -> dict[str, int]:
        """Number of keyframes of each map, by its name."""
        segments = self.graph.odometry.segments
        return {
            segments[reference].name: sum([len(segments[s].nodes) for s in own])
            for reference, own in self.graph.maps.items()
        }

    def T_map_odom(self, agent: str) -> F64 | None:
        """T_map_odom (4, 4) at the agent's newest keyframe; None if its current segment has none."""
        newest = self.graph.odometry.newest_node(agent)
        return None if newest is None else self.graph.T_map_odom(newest)

    def is_placed(self, node_id: int) -> bool:
        """Return whether a keyframe's segment is shown its map, and does not wait to enter another's."""
        segment = self.graph.odometry.nodes[node_id].segment
        reference_segment = self.graph.reference_segments[segment]
        return segment == reference_segment or self._localisation_gate.is_published(
            segment, reference_segment
        )

    def waiting_segments(self) -> list[int]:
        """Segments of connected agents that wait to enter another's map."""
        newest = map(self.graph.odometry.newest_node, self.runs.present())
        nodes = self.graph.odometry.nodes
        return sorted(nodes[n].segment for n in newest if n is not None and not self.is_placed(n))

    def all_poses(self) -> SavePoses:
        """Current pose and map of every keyframe."""
        graph, nodes = self.graph, self.graph.odometry.nodes
        map_ids = {segment: graph.map_id(segment) for segment in graph.odometry.live_segments}
        maps = tuple(map_ids[node.segment] for node in nodes.values())
        return SavePoses(tuple(node.key for node in nodes.values()), graph.poses.stack(list(nodes)), maps)

    # Runs

    def add_run(self, agent: str, name: str, credential: str | None = "") -> None:
        """Register a run of the agent of this name. credential: see `AgentIdentities.set_credential`."""
        self.runs.add(agent, name)
        self.quarantine.agreement.add_run(agent, name, credential)

    def set_present(self, agent: str, is_present: bool) -> None:
        """Set whether a run is connected.

        An absent agent is sent nothing and delays nobody's corrections. When it returns, its map is solved if
        its pose there was not published.
        """
        if self.runs.set_present(agent, is_present) and is_present:
            self.solving.schedule_unpublished(agent)

    def is_run_gone(self, agent: str) -> bool:
        """Return whether the run is not connected and has no keyframes."""
        return self.runs.is_absent(agent) and not self.graph.odometry.has_nodes(agent)

    def remove_run(self, agent: str) -> None:
        """Forget a run without keyframes that will not return."""
        self.runs.remove(agent)
        self.quarantine.remove_run(agent)
        self.solving.remove_run(agent)
        self.graph.odometry.remove_agent(agent)

    # Keyframes

    def reconnect(self, agent: str, keyframe: Keyframe) -> tuple[Keyframe, SaveLink | None]:
        """Reconnect a keyframe whose reference was removed to the newest one left on its segment.

        Call before `add_keyframe`. Returns the keyframe to add and the odometry edge to store; None if the
        keyframe is unchanged.
        """
        odometry, reference = self.graph.odometry, KeyframeKey(agent, keyframe.reference)
        if (
            keyframe.reference < 0
            or odometry.has_keyframe(reference)
            or odometry.current_segment(agent) is None
        ):
            return keyframe, None
        newest = odometry.newest_node(agent)
        previous = None if newest is None else (self.key(newest).id, odometry.nodes[newest].T_odom_body)
        link = reconnect(agent, keyframe, previous)
        if link.reference < 0:
            return keyframe, link
        inflated = replace(link, cov=inflate_covariance(link.T_ref_body, link.cov))
        return replace(keyframe, reference=link.reference, T_ref_body=link.T_ref_body, cov=link.cov), inflated

    def add_keyframe(self, agent: str, keyframe: Keyframe, rank: int = 0) -> int:
        """Add a keyframe and return its node id.

        A keyframe without a reference begins a segment and a map. rank: the segment of the least rank, among
        equals the oldest, keeps its map's name and frame in a merge. Raises ValueError for a duplicate or an
        unknown reference.
        """
        if agent not in self.runs:
            self.runs.add(agent, agent)
        cov = inflate_covariance(keyframe.T_ref_body, keyframe.cov)
        node_id = self.graph.add_keyframe(agent, keyframe, cov, make_gravity_factor(keyframe), rank)
        self.quarantine.add_step(node_id, keyframe.T_ref_body, cov)
        self.graph.add_spans(node_id, keyframe)
        return node_id

    def restore(self, stored_map: StoredMap, ranks: Sequence[int]) -> list[int]:
        """Restore an earlier session's map; the atlas must be empty. Returns the keyframes' node ids.

        ranks: of all its segments. All maps need solving afterwards.
        """
        graph, gate, node_ids = self.graph, self._localisation_gate, list[int]()
        agents = [name.rpartition("/")[0] for name in stored_map.segments]
        segments = {
            name: graph.odometry.new_segment(agent, rank)
            for name, agent, rank in zip(stored_map.segments, agents, ranks, strict=True)
        }
        poses = stored_map.poses
        solved = {} if poses is None else dict(zip(poses.keys, poses.T_map_body, strict=True))
        for stored in stored_map.keyframes:
            key, sent, link = stored.keyframe_key, stored.keyframe, stored_map.links.get(stored.keyframe_key)
            T_ref_body = sent.T_ref_body if link is None else link.T_ref_body
            cov = inflate_covariance(T_ref_body, sent.cov) if link is None else link.cov
            node_id = graph.odometry.append_node(
                key, segments[stored.segment_name], sent.T_odom_body, stored.ordinal
            )
            graph.add_node(node_id, T_ref_body, cov, make_gravity_factor(sent))
            self.quarantine.add_step(node_id, T_ref_body, cov)
            graph.add_spans(node_id, sent)
            graph.poses[node_id] = solved.get(key, graph.poses[node_id])
            node_ids.append(node_id)
        for loop in stored_map.loops:
            graph.add_loop(loop)
        self.overlap_check.note_restored(max(node_ids, default=-1) + 1)
        self.quarantine.suspect_restored()
        for agent in set(agents):
            current = graph.odometry.current_segment(agent)
            if current is not None and graph.odometry.segments[current].nodes:  # not in a damaged file
                gate.restore(current, graph.reference_segments[current])
        return node_ids

    def remove_keyframes(self, node_ids: Iterable[int]) -> list[RemovedKeyframe]:
        """Remove redundant keyframes, except those that have to stay by now."""
        removed = list[RemovedKeyframe]()
        for node_id in node_ids:
            if node_id in self.graph.poses and self.culling.is_removable(node_id):
                removed.append(remove_keyframe(self.graph, node_id))
                self.graph.update_maps()
        return self._finish_removal(removed)

    def forget_keyframes(self, node_ids: Collection[int]) -> list[RemovedKeyframe]:
        """Remove keyframes, whatever depends on them.

        Keyframes that stay keep their poses. What only removed keyframes connected becomes several maps; a
        map whose reference segment is gone is named by the next one.
        """
        graph, removed = self.graph, list[RemovedKeyframe]()
        before, is_removed = list(graph.reference_segments), set(node_ids)
        self.culling.start_over()
        for segment in list(graph.odometry.live_segments):
            nodes = graph.odometry.segments[segment].nodes
            if is_removed.issuperset(nodes):
                removed += remove_segment(graph, segment)
            else:
                removed += [remove_keyframe(graph, n) for n in sorted(is_removed.intersection(nodes))]
        graph.update_maps()
        for segment in graph.odometry.live_segments:
            if (reference_segment := graph.reference_segments[segment]) != before[segment]:
                graph.split_segments.add(segment)
                graph.unsolved_maps[reference_segment] = None
        return self._finish_removal(removed)

    def _finish_removal(self, removed: Sequence[RemovedKeyframe]) -> list[RemovedKeyframe]:
        """Forget what else is known of removed keyframes. Return them as the map file keeps them."""
        graph = self.graph
        self._localisation_gate.forget_all_but(graph.odometry.live_segments)
        self.solving.forget_all_but(graph.odometry.live_segments)
        live = {graph.reference_segments[segment] for segment in graph.odometry.live_segments}
        graph.unsolved_maps = dict.fromkeys(
            reference for reference in graph.unsolved_maps if reference in live
        )
        self.loop_acceptance.remove_keyframes({out.key for out in removed})
        self.quarantine.agreement.remove_nodes([out.node_id for out in removed], graph.odometry.live_segments)
        return [self.quarantine.to_agent_scale(out) for out in removed]

    # Loops

    def propose(self, loop: Loop, is_answer: bool = True) -> LoopDecision:
        """Decide on a verified loop from candidate a to query b. is_answer: to the query, which is new.
        Raises ValueError for unknown keyframes."""
        if reason := self.quarantine.separation_reason(loop):
            return LoopDecision(False, f"loop {loop}: {reason}")
        decision = self.loop_acceptance.decide(loop)
        if decision.accepted and is_answer:  # also answers for pending loops accepted with it
            self.solving.mark_answered(loop.b)
        return decision
