"""Which verified loops are accepted: those that fit the map, or that loops at other places support.

A verified loop may be false: two places can look alike. Within a map it has to agree with the graph. Between
two maps, or against the map, loops at several places have to be consistent, and no competing hypothesis may
be nearly as good (`share.mapping.loop_consistency`).
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from share.config import MergeConfig
from share.geometry import se3
from share.mapping.loop_consistency import (
    Cut,
    LoopEvidence,
    count_places,
    is_at_any,
    is_near,
    minimum_cut,
    weigh_loops,
)
from share.mapping.loops import (
    Disagreement,
    KeyframeKey,
    Loop,
    RelativePose,
    disagreement,
    inverse_pose,
    pairwise_chi2,
)
from share.mapping.map_graph import MapGraph
from share.mapping.overlap_check import OverlapCheck, cusum
from share.mapping.segments import MIN_LOOP_GAP
from share.types import F64

AGREE_CHI2 = 22.5  # two loops agree, or a loop fits the map (99.9 %, 6 dof)
_CONTRADICT_CHI2 = 200.0  # above this a loop contradicts the map whatever supporting loops there are
_MAX_PENDING = 200  # pending loops; the oldest is dropped
JOIN_FOUND = 0.3  # share of the common points that must be found, on average, before maps merge
_UNDO_CUSUM = 0.6  # CUSUM of the missing share above the usual; more forbids or undoes a merge
_UNDO_LOST = 1.5  # CUSUM of what is found too seldom; more undoes a merge (true pairs: below 1.0)
_COMPETING_WEIGHT = 0.5  # a competing hypothesis with more than this share of the weight blocks a merge
_CONTRADICTING_PLACES = 4  # contradicting loops split a map from this many places on
_CONTRADICTING_WEIGHT = 1.4  # and from this multiple of the existing loops' weight on
_MAX_NAMED = 3  # loops listed in a reason
_MIN_MOVE = 2e-3  # rad and m; a pending loop is tested again once its ends moved by more
_MAX_CHECKED = 8  # accepted loops whose found share is computed when others contradict them


@dataclass(frozen=True)
class LoopDecision:
    """Decision on a loop, with its reason.

    joined_maps: merged maps, the surviving name first; T_join (4, 4): from the other's frame to its. added:
    all loops accepted by it, this one and pending ones; dropped: loops removed.
    """

    accepted: bool
    reason: str
    joined_maps: tuple[str, str] | None = None
    added: tuple[Loop, ...] = ()
    dropped: tuple[Loop, ...] = ()
    T_join: F64 | None = field(default=None, compare=False)


class LoopAcceptance:
    """Decides on the loops of one graph and adds them to it.

    pending: loops that need support, oldest first. contradicting: loops that contradict their map.
    ambiguous_nodes: those at places with a known look-alike.
    """

    def __init__(self, config: MergeConfig, graph: MapGraph, overlap_check: OverlapCheck) -> None:
        self.pending: list[Loop] = []
        self.contradicting: list[Loop] = []
        self.ambiguous_nodes: set[int] = set()
        self._rejected_at: dict[Loop, F64] = {}  # pending loops that did not fit, and T_a_b of the map then
        self._config, self._graph, self._overlap_check = config, graph, overlap_check

    @property
    def comparison_count(self) -> int:
        """Pairs of views compared since the start."""
        return self._overlap_check.comparison_count

    def decide(self, loop: Loop) -> LoopDecision:
        """Accept a loop, keep it pending, or reject it. Raises ValueError if a keyframe is unknown."""
        a, b = self._graph.loop_nodes(loop)
        edges = self._graph.edges
        if any(
            n in edges.loops and {a, b} == {edges.by_id[n].a, edges.by_id[n].b} for n in edges.incident(b)
        ):
            return LoopDecision(False, f"loop {loop}: these keyframes have a loop already")
        if self._graph.odometry.are_neighbours(a, b):
            gap = f"less than {MIN_LOOP_GAP} keyframes apart"
            return LoopDecision(False, f"loop {loop}: neighbours by odometry, {gap}")
        if self._graph.is_same_map(a, b):
            return self._decide_within_map(loop)
        return self._decide_join(self._overlap_check.with_found_share(loop))

    def review_joins(self, node_id: int) -> LoopDecision | None:
        """Undo a recent merge that the view of a new node contradicts; None if there is none."""
        for (a, b), probation in self._overlap_check.review_joins(node_id):
            if probation.missing > _UNDO_CUSUM or probation.lost > _UNDO_LOST:
                self._overlap_check.end_probation((a, b))
                dropped = self.split_segments(a, b)
                first, second = (self._graph.odometry.segments[s].name for s in (a, b))
                sums = f"CUSUM {probation.missing:.1f}, {probation.lost:.1f}"
                reason = f"what {first} and {second} should share is missing ({sums})"
                return LoopDecision(True, f"{reason}; {dropped_text(dropped)}", dropped=dropped)
        return None

    def split_segments(self, a: int, b: int) -> tuple[Loop, ...]:
        """Remove the fewest loops without which segments a and b are in different maps."""
        return self._graph.drop_loops(self._cut(a, b).edges)

    def accept_fitting(self) -> tuple[Loop, ...]:
        """Accept pending loops within a map that fit it now."""
        in_one_map = [loop for loop in self.pending if self._graph.is_same_map(*self._graph.loop_nodes(loop))]
        map_poses = {loop: self._graph.relative_pose(*self._graph.loop_nodes(loop)) for loop in in_one_map}
        moved = [
            loop
            for loop in in_one_map
            if loop not in self._rejected_at or _has_moved(self._rejected_at[loop], map_poses[loop])
        ]
        differences = zip(moved, self._disagreements(moved), strict=True)
        fitting = [loop for loop, difference in differences if difference.chi2 <= AGREE_CHI2]
        self._rejected_at = {
            x: map_poses[x] if x in moved else self._rejected_at[x] for x in in_one_map if x not in fitting
        }
        self._add_loops(fitting)
        return tuple(fitting)

    def remove_keyframes(self, removed: Collection[KeyframeKey]) -> None:
        """Forget loops of keyframes that were removed from the graph."""
        self.ambiguous_nodes.intersection_update(self._graph.poses)
        self.pending = [loop for loop in self.pending if loop.keyframes.isdisjoint(removed)]
        self.contradicting = [loop for loop in self.contradicting if loop.keyframes.isdisjoint(removed)]

    # Loops within a map

    def _decide_within_map(self, loop: Loop) -> LoopDecision:
        (difference,) = self._disagreements([loop])
        if difference.chi2 <= AGREE_CHI2:
            return self._accept([loop], f"loop {loop}: fits the map, {difference}")
        if difference.chi2 > _CONTRADICT_CHI2:
            return self._decide_contradiction(loop, f"loop {loop}: contradicts the map, {difference}")
        return self._decide_drift(loop, f"loop {loop}: fits the map badly ({difference})")

    def _disagreements(self, loops: Sequence[Loop]) -> list[Disagreement]:
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
        """The map has drifted if a loop elsewhere agrees with this one."""
        consistent = self._consistent_loops(loop, self.pending)
        if not consistent:
            self._add_pending(self._overlap_check.with_found_share(loop))
            return LoopDecision(False, f"{reason}: pending, needs a supporting loop")
        return self._accept([*consistent, loop], f"{reason}: supported by {consistent[-1]}")

    def _decide_contradiction(self, loop: Loop, reason: str) -> LoopDecision:
        """Decide on a loop that is off by more than odometry can drift.

        Within a segment it is false: two places look alike. Between segments the map may be wrong instead: it
        is if the contradicting loops outweigh those that connect the two.
        """
        a, b = (self._graph.segment(key) for key in (loop.a, loop.b))
        if a == b:
            self.ambiguous_nodes.update(self._graph.loop_nodes(loop))
            return LoopDecision(False, f"{reason}: two places look alike")
        loop = self._overlap_check.with_found_share(loop)
        consistent = [*self._consistent_loops(loop, self.contradicting), loop]
        self.contradicting = [*self.contradicting, loop][-_MAX_PENDING:]
        evidence = self._weigh(consistent)
        reason = f"{reason}; {evidence} support it"
        if evidence.places < _CONTRADICTING_PLACES:
            return LoopDecision(False, f"{reason}, {_CONTRADICTING_PLACES} places needed")
        cut = self._cut(a, b)
        existing = self._weigh_existing(cut)
        reason = f"{reason}, {existing} oppose it"
        if not evidence.outweighs(existing, _CONTRADICTING_WEIGHT):
            return LoopDecision(False, f"{reason}, more weight needed")
        if objection := self._overlap_objection(loop):
            return LoopDecision(False, reason + objection)
        return self._replace_loops(consistent, cut.edges, reason)

    def _cut(self, a: int, b: int) -> Cut:
        """The loops, by edge id, that `split_segments` removes, and the segments on the side of a."""
        loops = {
            n: tuple(self._graph.segment(key) for key in (loop.a, loop.b))
            for n, loop in self._graph.edges.loops.items()
            if self._graph.reference_segment(loop.a) == self._graph.reference_segments[a]
        }
        edge_ids = list(loops)
        cut = minimum_cut([(x, y) for x, y in loops.values()], a, b)
        return Cut([edge_ids[i] for i in cut.edges], cut.start_side)

    def _weigh_existing(self, cut: Cut) -> LoopEvidence:
        """Weigh the accepted loops of a cut, after computing the found share of a few that lack it."""
        loops = self._graph.edges.loops
        unchecked = [n for n in cut.edges if loops[n].found_share is None and is_near(loops[n])]
        for n in unchecked[:: 1 + len(unchecked) // _MAX_CHECKED]:
            loops[n] = self._overlap_check.with_found_share(loops[n])
        ends = {self._graph.segment(key) for n in cut.edges for key in (loops[n].a, loops[n].b)}
        sides = {segment: int(segment in cut.start_side) for segment in ends}
        return weigh_loops([loops[n] for n in cut.edges], self._graph, sides)

    def _replace_loops(self, loops: list[Loop], edge_ids: list[int], reason: str) -> LoopDecision:
        dropped = self._graph.drop_loops(edge_ids)
        self.contradicting, others = [], [loop for loop in self.contradicting if loop not in loops]
        self.pending += others
        return replace(self._accept(loops, f"{reason}; {dropped_text(dropped)}"), dropped=dropped)

    # Loops between two maps

    def _decide_join(self, loop: Loop) -> LoopDecision:
        consistent = [*self._consistent_loops(loop, self.pending), loop]
        evidence, min_places = self._weigh_unambiguous(consistent), self._min_places(loop)
        places = f"{evidence.places} of {min_places} required places agree"
        objection = "" if evidence.places >= min_places and evidence.keyframes >= 2 else ": pending"
        if not any(one.is_confirmed and is_near(one) for one in consistent):
            objection = objection or ", but the images align by none: pending"
        objection = objection or self._join_objection(loop, evidence) or self._overlap_objection(loop)
        if objection:
            self._add_pending(loop)
            return LoopDecision(False, f"loop {loop}: would merge two maps, {places}{objection}")
        a, b = (f"keyframe {key.id} of {key.agent}" for key in (loop.a, loop.b))
        return self._accept(consistent, f"{a} and {b} see the same place; {places}")

    def _join_objection(self, loop: Loop, evidence: LoopEvidence) -> str:
        """Reason why loops at enough places may still be of a copy, or empty."""
        if evidence.found_share < JOIN_FOUND:
            return f", but only {evidence.found_share:.0%} of the points in both views are found: pending"
        max_weight = _COMPETING_WEIGHT * evidence.weight
        competing = self._competing_hypothesis(loop, max_weight)
        return f"; a competing hypothesis has {competing}: pending" if competing.weight > max_weight else ""

    def _overlap_objection(self, loop: Loop) -> str:
        """Reason of the overlap check against a merge as this loop says, or empty."""
        comparisons = self._overlap_check.compare_overlap(loop)
        if len(comparisons) < self._config.overlap_pairs:
            return f", but only {len(comparisons)} views overlap: pending"
        if not comparisons:
            return ""
        missing_share = float(np.mean([comparison.regions.missing_share for comparison in comparisons]))
        if sum(comparison.excess_missing for comparison in comparisons) > 0:
            return (
                f", but {missing_share:.0%} of the {len(comparisons)} overlapping views is missing: pending"
            )
        cusums = itertools.accumulate(comparisons, cusum, initial=0.0)
        if (worst := max(cusums)) > _UNDO_CUSUM:
            return f", but things are missing in consecutive views (CUSUM {worst:.1f}): pending"
        return ""

    def _min_places(self, loop: Loop) -> int:
        """Places required for a merge; in a map with few known places, all but one."""
        graph = self._graph
        maps = [graph.map_nodes(graph.reference_segment(key)) for key in (loop.a, loop.b)]
        known_places = min(
            count_places(graph.poses.stack(nodes), self._config.join_places + 1) for nodes in maps
        )
        return max(1, known_places - 1)

    def _competing_hypothesis(self, loop: Loop, max_weight: float) -> LoopEvidence:
        """Evidence of a hypothesis on the same two maps that contradicts this loop.

        The first one that outweighs `max_weight`, or else the best.
        """
        compared = self._compare_loops(loop, self.pending)
        remaining = [other for other, chi2 in compared if chi2 > _CONTRADICT_CHI2]
        best = LoopEvidence()
        while remaining and best.weight <= max_weight:
            hypothesis = [*self._consistent_loops(remaining[-1], remaining[:-1]), remaining[-1]]
            evidence = self._weigh(hypothesis)
            if evidence.weight > best.weight and not self._overlap_objection(hypothesis[-1]):
                best = evidence
            pairs = {x.keyframes for x in hypothesis}
            remaining = [x for x in remaining if x.keyframes not in pairs]
        return best

    # Supporting and contradicting loops

    def _consistent_loops(self, loop: Loop, others: Sequence[Loop]) -> list[Loop]:
        """Loops between the same two maps (within a map: the same segments) that agree with this one."""
        return [x for x, chi2 in self._compare_loops(loop, others) if chi2 <= AGREE_CHI2]

    def _compare_loops(self, loop: Loop, others: Sequence[Loop]) -> list[tuple[Loop, float]]:
        """Loops between the same two maps, directed as this one, each with its chi-square against it."""
        aligned = [directed for other in others if (directed := self._oriented(loop, other)) is not None]
        if not aligned:
            return []
        (a, b), ends = self._graph.loop_nodes(loop), [self._graph.loop_nodes(x) for x in aligned]
        from_a = self._graph.relative_estimates(a, [x for x, _ in ends])
        to_b = inverse_pose(self._graph.relative_estimates(b, [y for _, y in ends]))
        return list(zip(aligned, pairwise_chi2(loop, from_a, aligned, to_b).tolist(), strict=True))

    def _oriented(self, loop: Loop, other: Loop) -> Loop | None:
        """Return `other` directed like `loop`; None if it joins other maps or the same two keyframes."""
        if loop.keyframes == other.keyframes:
            return None
        graph = self._graph
        side = (
            graph.segment
            if graph.reference_segment(loop.a) == graph.reference_segment(loop.b)
            else graph.reference_segment
        )
        sides = side(loop.a), side(loop.b)
        for directed in (other, other.reverse()):
            if (side(directed.a), side(directed.b)) == sides:
                return directed
        return None

    def _weigh(self, loops: Sequence[Loop]) -> LoopEvidence:
        """Weigh loops between two maps, or within a map between two segments."""
        graph = self._graph
        pairs = {(graph.segment(loop.a), graph.segment(loop.b)) for loop in loops}
        maps = {s: graph.reference_segments[s] for pair in pairs for s in pair}
        is_one_map = any(maps[a] == maps[b] for a, b in pairs)
        return weigh_loops(loops, graph, {s: s for s in maps} if is_one_map else maps)

    def _weigh_unambiguous(self, loops: Sequence[Loop]) -> LoopEvidence:
        """Weigh the near loops away from places that are known to look alike."""
        near_loops = [loop for loop in loops if is_near(loop)]
        return self._weigh([loop for loop in near_loops if not self._is_ambiguous(loop)])

    def _is_ambiguous(self, loop: Loop) -> bool:
        graph = self._graph
        for node_id in graph.loop_nodes(loop):
            segment = graph.odometry.nodes[node_id].segment
            ambiguous = [
                n
                for n in self.ambiguous_nodes
                if n in graph.poses and graph.odometry.nodes[n].segment == segment
            ]
            if is_at_any(graph.poses[node_id], [graph.poses[n] for n in ambiguous]):
                return True
        return False

    # Acceptance

    def _accept(self, loops: list[Loop], reason: str) -> LoopDecision:
        graph = self._graph
        references = sorted(
            {graph.reference_segment(key) for key in (loops[-1].a, loops[-1].b)}, key=graph.rank
        )
        surest, T_join = min(loops, key=lambda loop: float(loop.cov.trace())), None
        if len(references) > 1:
            T_join = graph.align_maps(surest)
        self._add_loops(loops)
        if len(references) == 1:
            return LoopDecision(True, reason, added=tuple(loops))
        self._overlap_check.begin_probation(loops[-1])
        added = self.accept_fitting()
        survivor, absorbed = (graph.odometry.segments[s].name for s in references)
        reason = f"map {absorbed} merged into {survivor}: {reason}{pending_text(added)}"
        return LoopDecision(True, reason, (survivor, absorbed), (*loops, *added), T_join=T_join)

    def _add_loops(self, loops: Sequence[Loop]) -> None:
        accepted = {loop.keyframes for loop in loops}
        self.pending = [loop for loop in self.pending if loop.keyframes not in accepted]
        for loop in loops:
            self._graph.add_loop(loop)

    def _add_pending(self, loop: Loop) -> None:
        self.pending = [*self.pending, loop][-_MAX_PENDING:]


def _has_moved(before: F64, now: F64) -> bool:
    return bool(np.abs(se3.log(se3.inverse(before) @ now)).max() > _MIN_MOVE)


def dropped_text(loops: Sequence[Loop]) -> str:
    named = ", ".join(map(str, loops[:_MAX_NAMED]))
    return f"loops removed: {named}" + (
        f" and {len(loops) - _MAX_NAMED} more" if len(loops) > _MAX_NAMED else ""
    )


def pending_text(loops: Sequence[Loop]) -> str:
    return f", {len(loops)} pending loops fit too" if loops else ""
