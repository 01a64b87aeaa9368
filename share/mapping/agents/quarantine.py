"""Keeps agents that disagree with the others out of their maps, and removes them where the evidence comes
later.

Small scale errors are corrected, and understated variances enlarged.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from share.geometry import se3
from share.mapping.agents.agent_pair import tilt_between
from share.mapping.agents.agreement import AgentAgreement, AgentConsistency
from share.mapping.graph.edges import PoseEdge
from share.mapping.keyframe_removal import RemovedKeyframe
from share.mapping.loop_acceptance import LoopAcceptance, LoopDecision
from share.mapping.loops import Loop
from share.mapping.map_graph import MapGraph, rescale_translation
from share.mapping.recognition.depth_scale import DepthScale
from share.types import F64

_MIN_LOOP_SUPPORT = 12  # loops between two segments; fewer may fit only because a map was bent
_MAX_WITHDRAWN = 2000  # newest withdrawn loops
_RECONSIDERED_AT_ONCE = 8  # withdrawn loops
_COMPARED_AT_ONCE = 8  # pairs of views, after which no further loop is decided


@dataclass(frozen=True, eq=False)
class QuarantineChange:
    """Agents with a new standing, and the loops removed (dropped) or accepted again (added) because of it."""

    standings: dict[str, AgentConsistency] = field(default_factory=dict)
    dropped: tuple[Loop, ...] = ()
    added: tuple[Loop, ...] = ()


class Quarantine:
    """Quarantine in one graph. withdrawn: loops that are kept until the agents' standings change."""

    def __init__(self, graph: MapGraph, loop_acceptance: LoopAcceptance) -> None:
        self.agreement = AgentAgreement()
        self._graph, self._loop_acceptance = graph, loop_acceptance
        self.withdrawn: list[Loop] = []
        self._to_reconsider: list[Loop] = []

    def remove_run(self, run: str) -> None:
        """Forget a run without keyframes that will not return."""
        self.agreement.remove_run(run)
        self._graph.log_scales.pop(run, None)
        self._graph.covariance_scales.pop(run, None)

    def add_step(self, node_id: int, T_ref_body: F64, cov: F64) -> None:
        """Add a node, by odometry from the previous one of its segment."""
        odometry = self._graph.odometry
        agent, previous = odometry.nodes[node_id].key.agent, odometry.previous_node(node_id)
        may_have_changed = self.agreement.add_step(agent, node_id, previous, T_ref_body, cov)
        if previous is None:  # the run may be new
            self._apply_scales_to([agent])
        elif may_have_changed:
            self.apply_scales()

    def add_loop(self, loop: Loop, depth_scale: DepthScale | None) -> QuarantineChange:
        """Compare the agents of a verified loop, and split maps of agents that no longer agree. Decide again
        on a few withdrawn loops, if scheduled.

        depth_scale: of b's depths relative to a's.
        """
        agents = loop.a.agent, loop.b.agent
        if agents[0] == agents[1]:
            return self.reconsider_withdrawn()
        a, b = self._graph.loop_nodes(loop)
        edge = PoseEdge(a, b, loop.T_a_b, loop.cov)
        segments = self._graph.segment(loop.a), self._graph.segment(loop.b)
        before, unverified = self._separated(), self.agreement.identities.unverified
        unverified_before = len(unverified)
        changed = self.agreement.add_loop(agents, segments, edge, depth_scale, self._tilt(edge))
        self.apply_scales()
        if not changed and len(unverified) == unverified_before:
            return self.reconsider_withdrawn()
        after = self._separated()
        affected = map(
            self.agreement.identities.newest_run, (before[0] ^ after[0]).union(*(before[1] ^ after[1]))
        )
        standings = {name: self.agreement.standing(name) for name in sorted(affected)}
        dropped = self._split_maps()
        self.schedule_withdrawn()
        reconsidered = self.reconsider_withdrawn()
        return QuarantineChange(standings, (*dropped, *reconsidered.dropped), reconsidered.added)

    def _separated(self) -> tuple[frozenset[str], frozenset[frozenset[str]]]:
        return self.agreement.quarantined, self.agreement.disputed

    def quarantined_nodes(self, agent: str) -> tuple[int, ...]:
        """Nodes of agents that must not share a map with this one."""
        odometry = self._graph.odometry
        if not self.agreement.quarantined and not self.agreement.disputed:
            return ()
        segments = [odometry.segments[segment] for segment in sorted(odometry.live_segments)]
        separated = {s.agent for s in segments if self.agreement.are_separated(agent, s.agent)}
        return tuple(n for s in segments if s.agent in separated for n in s.nodes) if separated else ()

    def separation_reason(self, loop: Loop) -> str:
        """Why the loop must not be accepted: it would connect agents kept in separate maps; else empty."""
        first, second = (self._graph.reference_segment(key) for key in (loop.a, loop.b))
        if first == second:
            return ""
        agents = self._agents_in_map(first), self._agents_in_map(second)
        return self.agreement.unverified_reason(*agents) or self.agreement.separation_reason(*agents)

    def rescale_loop(self, loop: Loop, depth_scale: DepthScale | None) -> Loop:
        """Correct a loop for the agents' scales, where known.

        depth_scale: of b's depths relative to a's; its pose sensitivity corrects T_a_b.
        """
        log_scale_a, log_scale_b = (self._log_scale(key.agent) for key in (loop.a, loop.b))
        if depth_scale is None or depth_scale.pose_sensitivity is None or not (log_scale_a or log_scale_b):
            return loop
        T = rescale_translation(
            se3.exp(depth_scale.pose_sensitivity * (log_scale_b - log_scale_a)) @ loop.T_a_b, log_scale_a
        )
        return replace(loop, T_a_b=se3.orthonormal(T))

    def to_agent_scale(self, removed: RemovedKeyframe) -> RemovedKeyframe:
        """Convert a removal to the agent's own metres and covariances, in which odometry is stored."""
        link = removed.link
        if link is None or link.reference < 0:
            return removed
        T = rescale_translation(link.T_ref_body, -self._log_scale(removed.key.agent))
        cov = link.cov / self._graph.covariance_scales.get(removed.key.agent, 1.0)
        return replace(removed, link=replace(link, T_ref_body=T, cov=cov))

    def _log_scale(self, agent: str) -> float:
        return self._graph.log_scales.get(agent, 0.0)

    def apply_scales(self) -> None:
        """Correct the odometry of agents whose scales have changed."""
        has_nodes = self._graph.odometry.has_nodes
        runs = self.agreement.scaled_runs() | self._graph.log_scales.keys()
        self._apply_scales_to(sorted(run for run in runs if has_nodes(run)))

    def _apply_scales_to(self, runs: Iterable[str]) -> None:
        agreement, graph = self.agreement, self._graph
        for agent in runs:
            scales = agreement.log_scale(agent), agreement.covariance_scale(agent)
            if scales != (self._log_scale(agent), graph.covariance_scales.get(agent, 1.0)):
                graph.rescale_odometry(agent, *scales)

    def suspect_restored(self) -> None:
        """Mark agents outside a restored session's largest map as unverified: they may have been
        quarantined.
        """
        identities = self.agreement.identities
        maps = [self._agents_in_map(reference_segment) for reference_segment in sorted(self._graph.maps)]
        names = [set(map(identities.name, agents)) for agents in maps]
        largest = max(range(len(maps)), key=lambda i: len(names[i]), default=0)
        trusted = maps[largest] if maps and len(names[largest]) > 1 else set[str]()
        identities.mark_unverified(set[str]().union(*maps) - trusted)

    def _split_maps(self) -> tuple[Loop, ...]:
        """Remove loops until separated agents share no map: first loops between them, then the fewest
        others.
        """
        graph, segments = self._graph, self._graph.odometry.segments
        before = list(graph.reference_segments)
        are_separated, loops = self.agreement.are_separated, graph.edges.loops
        loops_between = [n for n, loop in loops.items() if are_separated(loop.a.agent, loop.b.agent)]
        dropped = graph.drop_loops(loops_between) if loops_between else ()
        maps = list(graph.maps.values())
        for a, b in itertools.chain.from_iterable(itertools.combinations(sorted(own), 2) for own in maps):
            if graph.reference_segments[a] == graph.reference_segments[b] and are_separated(
                segments[a].agent, segments[b].agent
            ):
                dropped += self._loop_acceptance.split_segments(a, b)
        dropped += graph.drop_loops(self._weak_loops(before, {before[graph.segment(x.a)] for x in dropped}))
        self.withdrawn = [*self.withdrawn, *dropped][-_MAX_WITHDRAWN:]
        return dropped

    def _weak_loops(self, reference_segments: Sequence[int], maps: Collection[int]) -> list[int]:
        """Edge ids of the loops between other agents of split maps where these are few.

        Loops that fitted a bent map have to be confirmed without it.
        """
        graph, segments = self._graph, self._graph.odometry.segments
        out = []
        for edge_id in graph.edges.loops:
            a, b = graph.segment_pair(graph.edges.by_id[edge_id])
            is_between_agents = segments[a].agent != segments[b].agent and reference_segments[a] in maps
            if is_between_agents and graph.loop_counts[(a, b)] < _MIN_LOOP_SUPPORT:
                out.append(edge_id)
        return out

    def schedule_withdrawn(self) -> None:
        """Have all withdrawn loops decided again, a few at a time, since standings have changed."""
        self._to_reconsider = [*self._to_reconsider, *self.withdrawn][-_MAX_WITHDRAWN:]
        self.withdrawn = []

    def reconsider_withdrawn(self) -> QuarantineChange:
        """Decide again on the next few scheduled loops.

        Those still forbidden are withdrawn again, while their keyframes exist.
        """
        odometry, decisions = self._graph.odometry, list[LoopDecision]()
        max_comparisons = self._loop_acceptance.comparison_count + _COMPARED_AT_ONCE
        while (
            self._to_reconsider
            and len(decisions) < _RECONSIDERED_AT_ONCE
            and self._loop_acceptance.comparison_count < max_comparisons
        ):
            loop = self._to_reconsider.pop(0)
            if not (odometry.has_keyframe(loop.a) and odometry.has_keyframe(loop.b)):
                continue
            if self.agreement.are_separated(loop.a.agent, loop.b.agent) or self.separation_reason(loop):
                self.withdrawn.append(loop)
            else:
                decisions.append(self._loop_acceptance.decide(loop))
        dropped = tuple(x for d in decisions for x in d.dropped)
        added = tuple(x for d in decisions for x in d.added if x not in dropped)
        return QuarantineChange(dropped=dropped, added=added)

    def _agents_in_map(self, reference_segment: int) -> set[str]:
        return {self._graph.odometry.segments[s].agent for s in self._graph.map_segments(reference_segment)}

    def _tilt(self, edge: PoseEdge) -> tuple[float, float] | None:
        a, b = (self._graph.gravity_factors.get(n) for n in (edge.a, edge.b))
        if a is None or b is None:
            return None
        return tilt_between(a, 1 / float(np.linalg.norm(a)), b, 1 / float(np.linalg.norm(b)), edge)
