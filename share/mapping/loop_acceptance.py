"""Which loops are believed: those that fit the map, or that others, elsewhere, bear witness to.

A verified loop may still be false: two places can look alike. Within a map it has to agree with what the
map knows. Between two maps, or against the map, loops at several places have to tell the same story, and no
other story may be nearly as good (`share.mapping.loop_consistency`).
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from share.config import MergeConfig
from share.geometry import se3
from share.mapping.loop_consistency import LoopEvidence, count_places, is_near, minimum_cut, weigh_loops
from share.mapping.loops import (
    Disagreement,
    KeyframeKey,
    Loop,
    RelativePose,
    disagreement,
    inverse_pose,
    is_near_any,
    pairwise_chi2,
)
from share.mapping.map_graph import MapGraph
from share.mapping.overlap_check import OverlapCheck, cusum
from share.types import F64

_MAX_NAMED = 3  # loops, in a reason
_MIN_MOVE = 2e-3  # rad and m: with less, what did not fit does not
_MAX_CHECKED = 8  # loops that stand, whenever others contradict them


@dataclass(frozen=True)
class LoopDecision:
    """What became of a loop, and why, for a person. joined: maps that became one, the survivor first.
    tied: all loops that are believed since, this one and those that waited; dropped: those no longer."""

    accepted: bool
    reason: str
    joined_maps: tuple[str, str] | None = None
    added: tuple[Loop, ...] = ()
    dropped: tuple[Loop, ...] = ()


class LoopAcceptance:
    """Of the loops of one chart, which it changes by what it believes.

    waiting: for witnesses, oldest first. rebels: those that contradict their map.
    """

    def __init__(self, config: MergeConfig, graph: MapGraph, overlap_check: OverlapCheck) -> None:
        self.pending: list[Loop] = []
        self.contradicting: list[Loop] = []
        self._ambiguous_nodes: set[int] = set()  # nodes at places of which a look-alike is known
        self._rejected_at: dict[
            Loop, F64
        ] = {}  # waiting loops that did not fit their map, which then had T_a_b
        self._config, self._graph, self._overlap_check = config, graph, overlap_check

    def decide(self, loop: Loop) -> LoopDecision:
        """Accepted, waiting, or refused, with the reason. Raises ValueError if a keyframe is unknown."""
        a, b = self._graph.loop_nodes(loop)
        edges, disagreement = self._graph.edges, self._config.min_loop_gap
        if any(
            n in edges.loops and {a, b} == {edges.by_id[n].a, edges.by_id[n].b} for n in edges.incident(b)
        ):
            return LoopDecision(False, f"loop {loop}: joined already")
        if self._graph.odometry.are_neighbours(a, b, disagreement):
            need = f"at least {disagreement} keyframes apart needed"
            return LoopDecision(False, f"loop {loop}: neighbours by odometry, {need}")
        if self._graph.is_same_map(a, b):
            return self._decide_within_map(loop)
        return self._decide_join(self._overlap_check.with_found_share(loop))

    def review_joins(self, node_id: int) -> LoopDecision | None:
        """A new node, in a map: undoes the join that what it sees speaks against, if any does."""
        c = self._config
        for (a, b), cusum_value in self._overlap_check.review_joins(node_id, c.overlap_gone):
            if cusum_value > c.undo_doubt:
                self._overlap_check.end_probation((a, b))
                dropped = self._graph.drop_loops(self._separating_loops(a, b))
                first, second = (self._graph.odometry.segments[s].name for s in (a, b))
                reason = f"what {first} and {second} should share is missing (CUSUM {cusum_value:.1f})"
                return LoopDecision(True, f"{reason}; {dropped_text(dropped)}", dropped=dropped)
        return None

    def split_segments(self, a: int, b: int) -> tuple[Loop, ...]:
        """Take back the loops without which stretches a and b, of one map, are of two."""
        return self._graph.drop_loops(self._separating_loops(a, b))

    def accept_fitting(self) -> tuple[Loop, ...]:
        """Those that waited and fit the map that they are in by now are believed."""
        in_one_map = [loop for loop in self.pending if self._graph.is_same_map(*self._graph.loop_nodes(loop))]
        map_poses = {loop: self._graph.relative_pose(*self._graph.loop_nodes(loop)) for loop in in_one_map}
        moved = [
            loop
            for loop in in_one_map
            if loop not in self._rejected_at or _has_moved(self._rejected_at[loop], map_poses[loop])
        ]
        gaps = self._disagreements(moved)
        fitting = [
            loop
            for loop, disagreement in zip(moved, gaps, strict=True)
            if disagreement.chi2 <= self._config.agree_chi2
        ]
        self._rejected_at = {
            x: map_poses[x] if x in moved else self._rejected_at[x] for x in in_one_map if x not in fitting
        }
        self._add_loops(fitting)
        return tuple(fitting)

    def remove_keyframes(self, removed: Collection[KeyframeKey]) -> None:
        """Loops of these keyframes, which the chart has no more, are waited with no longer."""
        self._ambiguous_nodes.intersection_update(self._graph.poses)
        self.pending = [loop for loop in self.pending if loop.keyframes.isdisjoint(removed)]
        self.contradicting = [loop for loop in self.contradicting if loop.keyframes.isdisjoint(removed)]

    # ------------------------------------------------------------ within a map

    def _decide_within_map(self, loop: Loop) -> LoopDecision:
        (disagreement,) = self._disagreements([loop])
        if disagreement.chi2 <= self._config.agree_chi2:
            return self._accept([loop], f"loop {loop}: fits the map, {disagreement}")
        if disagreement.chi2 > self._config.surprise_chi2:
            return self._decide_contradiction(loop, f"loop {loop}: contradicts the map, {disagreement}")
        return self._decide_drift(loop, f"loop {loop}: fits the map badly ({disagreement})")

    def _disagreements(self, loops: Sequence[Loop]) -> list[Disagreement]:
        """Between what each loop says and what its map knows."""
        ends = [self._graph.loop_nodes(loop) for loop in loops]
        nodes_by_goal: dict[int, list[int]] = {}
        for a, b in ends:
            nodes_by_goal.setdefault(b, []).append(a)
        known = {
            (a, b): k
            for b, goals in nodes_by_goal.items()
            for a, k in zip(goals, self._graph.relative_estimates(b, goals), strict=True)
        }
        return [
            disagreement(inverse_pose(known[end]), RelativePose(loop.T_a_b, loop.cov))
            for loop, end in zip(loops, ends, strict=True)
        ]

    def _decide_drift(self, loop: Loop, reason: str) -> LoopDecision:
        """The map has drifted, if another loop elsewhere says so too."""
        consistent = self._consistent_loops(loop, self.pending)
        if not consistent:
            self._add_pending(self._overlap_check.with_found_share(loop))
            return LoopDecision(False, f"{reason}: pending, needs a supporting loop")
        return self._accept([*consistent, loop], f"{reason}: agrees with {consistent[-1]}")

    def _decide_contradiction(self, loop: Loop, reason: str) -> LoopDecision:
        """Odometry does not lie so much: the places look alike. Between stretches the map may be wrong:
        it is, if what contradicts it is better evidence than what ties the two."""
        a, b = (self._graph.segment(key) for key in (loop.a, loop.b))
        if a == b:
            self._ambiguous_nodes.update(self._graph.loop_nodes(loop))
            return LoopDecision(False, f"{reason}: two places look alike")
        loop = self._overlap_check.with_found_share(loop)
        consistent = [*self._consistent_loops(loop, self.contradicting), loop]
        self.contradicting = [*self.contradicting, loop][-self._config.max_pending :]
        c, evidence = self._config, self._weigh(consistent)
        reason = f"{reason}; {evidence} supporting"
        if evidence.places < c.rebel_places:
            return LoopDecision(False, f"{reason}, {c.rebel_places} places needed")
        existing_ids = self._separating_loops(a, b)
        existing = self._weigh_existing(existing_ids)
        reason = f"{reason}, {existing} opposing"
        if evidence.weight <= c.rebel_weight * existing.weight:
            return LoopDecision(False, f"{reason}, more weight needed")
        if objection := self._overlap_objection(loop):
            return LoopDecision(False, reason + objection)
        return self._replace_loops(consistent, existing_ids, reason)

    def _separating_loops(self, a: int, b: int) -> list[int]:
        """The fewest loops without which stretches a and b are not of one map."""
        loops = {
            n: tuple(self._graph.segment(key) for key in (loop.a, loop.b))
            for n, loop in self._graph.edges.loops.items()
            if self._graph.reference_segment(loop.a) == self._graph.reference_segments[a]
        }
        edge_ids = list(loops)
        return [edge_ids[i] for i in minimum_cut([(x, y) for x, y in loops.values()], a, b)]

    def _weigh_existing(self, edge_ids: Sequence[int]) -> LoopEvidence:
        """What loops of a map, by their edges' numbers, are worth; a few of those that nobody has looked at
        yet are looked at."""
        loops = self._graph.edges.loops
        unchecked = [n for n in edge_ids if loops[n].found_share is None and is_near(loops[n], self._config)]
        for n in unchecked[:: 1 + len(unchecked) // _MAX_CHECKED]:
            loops[n] = self._overlap_check.with_found_share(loops[n])
        return self._weigh([loops[n] for n in edge_ids])

    def _replace_loops(self, loops: list[Loop], edge_ids: list[int], reason: str) -> LoopDecision:
        dropped = self._graph.drop_loops(edge_ids)
        self.contradicting, others = [], [loop for loop in self.contradicting if loop not in loops]
        self.pending += others
        accepted = self._accept(loops, f"{reason}; {dropped_text(dropped)}")
        return LoopDecision(True, accepted.reason, accepted.joined_maps, accepted.added, dropped)

    # ------------------------------------------------------------ between two maps

    def _decide_join(self, loop: Loop) -> LoopDecision:
        consistent = [*self._consistent_loops(loop, self.pending), loop]
        evidence, min_places = self._weigh_unambiguous(consistent), self._min_places(loop)
        reason = f"loop {loop}: {evidence.places} of {min_places} required places agree"
        objection = "" if evidence.places >= min_places and evidence.keyframes >= 2 else ": pending"
        objection = objection or self._join_objection(loop, evidence) or self._overlap_objection(loop)
        if objection:
            self._add_pending(loop)
            return LoopDecision(False, reason + objection)
        return self._accept(consistent, reason)

    def _join_objection(self, loop: Loop, evidence: LoopEvidence) -> str:
        """Why a story that is told at enough places may yet be of a copy; empty if nothing says so."""
        c = self._config
        if evidence.found_share < c.join_found:
            return f", but only {evidence.found_share:.0%} of what both should show is found: pending"
        max_weight = c.rival_weight * evidence.weight
        competing = self._competing_hypothesis(loop, max_weight)
        return f"; a competing hypothesis has {competing}: pending" if competing.weight > max_weight else ""

    def _overlap_objection(self, loop: Loop) -> str:
        """What the overlap of both maps has against it, whatever was recognised; empty if nothing."""
        comparisons, c = self._overlap_check.compare_overlap(loop), self._config
        if len(comparisons) < c.overlap_pairs:
            return f", but only {len(comparisons)} views overlap: pending"
        missing_share = sum(comparison.missing_share for comparison in comparisons) / max(1, len(comparisons))
        if missing_share > c.overlap_gone:
            return (
                f", but {missing_share:.0%} of the {len(comparisons)} overlapping views is missing: pending"
            )
        cusums = itertools.accumulate(
            comparisons, lambda d, look: cusum(d, look, c.overlap_gone), initial=0.0
        )
        if (worst := max(cusums)) > c.undo_doubt:
            return f", but successive views lack structure (CUSUM {worst:.1f}): pending"
        return ""

    def _min_places(self, loop: Loop) -> int:
        """Of a map that knows few places, all but one."""
        graph, c = self._graph, self._config
        maps = [graph.map_nodes(graph.reference_segment(key)) for key in (loop.a, loop.b)]
        known_places = min(
            count_places([graph.poses[n] for n in nodes], c, c.join_places + 1) for nodes in maps
        )
        return max(1, known_places - 1)

    def _competing_hypothesis(self, loop: Loop, max_weight: float) -> LoopEvidence:
        """Of the stories between the same two maps that contradict this one, the first that weighs more
        than allowed, or else the best."""
        compared = self._compare_loops(loop, self.pending)
        remaining = [other for other, chi2 in compared if chi2 > self._config.surprise_chi2]
        best = LoopEvidence()
        while remaining and best.weight <= max_weight:
            hypothesis = [*self._consistent_loops(remaining[-1], remaining[:-1]), remaining[-1]]
            evidence = self._weigh(hypothesis)
            if evidence.weight > best.weight and not self._overlap_objection(hypothesis[-1]):
                best = evidence
            pairs = {x.keyframes for x in hypothesis}
            remaining = [x for x in remaining if x.keyframes not in pairs]
        return best

    # ------------------------------------------------------------ witnesses

    def _consistent_loops(self, loop: Loop, others: Sequence[Loop]) -> list[Loop]:
        """Of others between the same two maps (in one map: the same stretches), those that agree."""
        return [x for x, chi2 in self._compare_loops(loop, others) if chi2 <= self._config.agree_chi2]

    def _compare_loops(self, loop: Loop, others: Sequence[Loop]) -> list[tuple[Loop, float]]:
        """Others between the same two maps, and by how much each disagrees."""
        facing = [turned for other in others if (turned := self._oriented(loop, other)) is not None]
        if not facing:
            return []
        (a, b), ends = self._graph.loop_nodes(loop), [self._graph.loop_nodes(x) for x in facing]
        from_a = self._graph.relative_estimates(a, [x for x, _ in ends])
        to_b = inverse_pose(self._graph.relative_estimates(b, [y for _, y in ends]))
        return list(zip(facing, pairwise_chi2(loop, from_a, facing, to_b).tolist(), strict=True))

    def _oriented(self, loop: Loop, other: Loop) -> Loop | None:
        """The other loop, from where this one comes from to where it goes, if it has such ends and is
        not about the very same keyframes."""
        if loop.keyframes == other.keyframes:
            return None
        graph = self._graph
        side = (
            graph.segment
            if graph.reference_segment(loop.a) == graph.reference_segment(loop.b)
            else graph.reference_segment
        )
        ours = side(loop.a), side(loop.b)
        for turned in (other, other.reverse()):
            if (side(turned.a), side(turned.b)) == ours:
                return turned
        return None

    def _weigh(self, loops: Sequence[Loop]) -> LoopEvidence:
        return weigh_loops(loops, self._graph, self._config)

    def _weigh_unambiguous(self, loops: Sequence[Loop]) -> LoopEvidence:
        """Where nothing else is known to look the same."""
        near_loops = [loop for loop in loops if is_near(loop, self._config)]
        return self._weigh([loop for loop in near_loops if not self._is_ambiguous(loop)])

    def _is_ambiguous(self, loop: Loop) -> bool:
        graph, c = self._graph, self._config
        for node_id in graph.loop_nodes(loop):
            segment = graph.odometry.nodes[node_id].segment
            ambiguous = [
                n
                for n in self._ambiguous_nodes
                if n in graph.poses and graph.odometry.nodes[n].segment == segment
            ]
            if is_near_any(graph.poses[node_id], [graph.poses[n] for n in ambiguous], c.place_m, c.place_rad):
                return True
        return False

    # ------------------------------------------------------------ believing

    def _accept(self, loops: list[Loop], reason: str) -> LoopDecision:
        graph = self._graph
        references = sorted(
            {graph.reference_segment(key) for key in (loops[-1].a, loops[-1].b)}, key=graph.rank
        )
        if len(references) > 1:
            graph.align_maps(min(loops, key=lambda loop: float(loop.cov.trace())))
        self._add_loops(loops)
        if len(references) == 1:
            return LoopDecision(True, reason, added=tuple(loops))
        self._overlap_check.begin_probation(loops[-1])
        added = self.accept_fitting()
        survivor, absorbed = (graph.odometry.segments[s].name for s in references)
        reason += f"{pending_text(added)}: map {absorbed} joins {survivor}"
        return LoopDecision(True, reason, (survivor, absorbed), (*loops, *added))

    def _add_loops(self, loops: Sequence[Loop]) -> None:
        accepted = {loop.keyframes for loop in loops}
        self.pending = [loop for loop in self.pending if loop.keyframes not in accepted]
        for loop in loops:
            self._graph.add_loop(loop)

    def _add_pending(self, loop: Loop) -> None:
        self.pending = [*self.pending, loop][-self._config.max_pending :]


def _has_moved(before: F64, now: F64) -> bool:
    return bool(np.abs(se3.log(se3.inverse(before) @ now)).max() > _MIN_MOVE)


def dropped_text(loops: Sequence[Loop]) -> str:
    """For a reason."""
    named = ", ".join(map(str, loops[:_MAX_NAMED]))
    return f"removed: {named}" + (f" and {len(loops) - _MAX_NAMED} more" if len(loops) > _MAX_NAMED else "")


def pending_text(loops: Sequence[Loop]) -> str:
    """For a reason."""
    return f", {len(loops)} pending loops fit too" if loops else ""
