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
from share.mapping.loop_consistency import Evidence, fewest, near, places, weigh
from share.mapping.loops import Disagreement, Key, Known, Loop, disagreement, near_any, opposite, witness_chi2
from share.mapping.map_graph import Chart
from share.mapping.overlap_check import Survey, doubt
from share.types import F64

_NAMED = 3  # loops, in a reason
_MOVED = 2e-3  # rad and m: with less, what did not fit does not
_LOOKED_AT = 8  # loops that stand, whenever others contradict them


@dataclass(frozen=True)
class Decision:
    """What became of a loop, and why, for a person. joined: maps that became one, the survivor first.
    tied: all loops that are believed since, this one and those that waited; dropped: those no longer."""

    accepted: bool
    reason: str
    joined: tuple[str, str] | None = None
    tied: tuple[Loop, ...] = ()
    dropped: tuple[Loop, ...] = ()


class Judge:
    """Of the loops of one chart, which it changes by what it believes.

    waiting: for witnesses, oldest first. rebels: those that contradict their map.
    """

    def __init__(self, config: MergeConfig, chart: Chart, survey: Survey) -> None:
        self.waiting: list[Loop] = []
        self.rebels: list[Loop] = []
        self._alike: set[int] = set()  # nodes at places of which a look-alike is known
        self._held: dict[Loop, F64] = {}  # waiting loops that did not fit their map, which then had T_a_b
        self._config, self._chart, self._survey = config, chart, survey

    def decide(self, loop: Loop) -> Decision:
        """Accepted, waiting, or refused, with the reason. Raises ValueError if a keyframe is unknown."""
        a, b = self._chart.ends(loop)
        ties, gap = self._chart.ties, self._config.min_loop_gap
        if any(n in ties.loops and {a, b} == {ties.edges[n].a, ties.edges[n].b} for n in ties.touching(b)):
            return Decision(False, f"loop {loop}: joined already")
        if self._chart.trails.are_neighbours(a, b, gap):
            need = f"at least {gap} keyframes apart needed"
            return Decision(False, f"loop {loop}: neighbours by odometry, {need}")
        if self._chart.same_map(a, b):
            return self._close(loop)
        return self._join(self._survey.looked_at(loop))

    def review(self, number: int) -> Decision | None:
        """A new node, in a map: undoes the join that what it sees speaks against, if any does."""
        c = self._config
        for (a, b), doubts in self._survey.review(number, c.overlap_gone):
            if doubts > c.undo_doubt:
                self._survey.end((a, b))
                dropped = self._chart.drop(self._ties_between(a, b))
                one, other = (self._chart.trails.stretches[s].name for s in (a, b))
                why = f"what {one} and {other} should share is gone (doubt {doubts:.1f})"
                return Decision(True, f"{why}; {taken_out(dropped)}", dropped=dropped)
        return None

    def part(self, a: int, b: int) -> tuple[Loop, ...]:
        """Take back the loops without which stretches a and b, of one map, are of two."""
        return self._chart.drop(self._ties_between(a, b))

    def settle(self) -> tuple[Loop, ...]:
        """Those that waited and fit the map that they are in by now are believed."""
        inside = [loop for loop in self.waiting if self._chart.same_map(*self._chart.ends(loop))]
        lie = {loop: self._chart.lie(*self._chart.ends(loop)) for loop in inside}
        moved = [loop for loop in inside if loop not in self._held or _has_moved(self._held[loop], lie[loop])]
        gaps = self._gaps(moved)
        fitting = [loop for loop, gap in zip(moved, gaps, strict=True) if gap.chi2 <= self._config.agree_chi2]
        self._held = {x: lie[x] if x in moved else self._held[x] for x in inside if x not in fitting}
        self._believe(fitting)
        return tuple(fitting)

    def forget(self, gone: Collection[Key]) -> None:
        """Loops of these keyframes, which the chart has no more, are waited with no longer."""
        self._alike.intersection_update(self._chart.poses)
        self.waiting = [loop for loop in self.waiting if loop.pair.isdisjoint(gone)]
        self.rebels = [loop for loop in self.rebels if loop.pair.isdisjoint(gone)]

    # ------------------------------------------------------------ within a map

    def _close(self, loop: Loop) -> Decision:
        (gap,) = self._gaps([loop])
        if gap.chi2 <= self._config.agree_chi2:
            return self._accept([loop], f"loop {loop}: fits the map, {gap}")
        if gap.chi2 > self._config.surprise_chi2:
            return self._contradiction(loop, f"loop {loop}: contradicts the map, {gap}")
        return self._corrected(loop, f"loop {loop}: fits the map badly ({gap})")

    def _gaps(self, loops: Sequence[Loop]) -> list[Disagreement]:
        """Between what each loop says and what its map knows."""
        ends = [self._chart.ends(loop) for loop in loops]
        to: dict[int, list[int]] = {}
        for a, b in ends:
            to.setdefault(b, []).append(a)
        known = {
            (a, b): k
            for b, goals in to.items()
            for a, k in zip(goals, self._chart.between(b, goals), strict=True)
        }
        return [
            disagreement(opposite(known[end]), Known(loop.T_a_b, loop.cov))
            for loop, end in zip(loops, ends, strict=True)
        ]

    def _corrected(self, loop: Loop, why: str) -> Decision:
        """The map has drifted, if another loop elsewhere says so too."""
        story = self._same_story(loop, self.waiting)
        if not story:
            self._wait(self._survey.looked_at(loop))
            return Decision(False, f"{why}: waits for a witness")
        return self._accept([*story, loop], f"{why}: agrees with {story[-1]}")

    def _contradiction(self, loop: Loop, why: str) -> Decision:
        """Odometry does not lie so much: the places look alike. Between stretches the map may be wrong:
        it is, if what contradicts it is better evidence than what ties the two."""
        a, b = (self._chart.stretch_of(key) for key in (loop.a, loop.b))
        if a == b:
            self._alike.update(self._chart.ends(loop))
            return Decision(False, f"{why}: two places look alike")
        loop = self._survey.looked_at(loop)
        story = [*self._same_story(loop, self.rebels), loop]
        self.rebels = [*self.rebels, loop][-self._config.max_pending :]
        c, have = self._config, self._weigh(story)
        why = f"{why}; {have} say so"
        if have.places < c.rebel_places:
            return Decision(False, f"{why}, {c.rebel_places} places needed")
        against = self._ties_between(a, b)
        standing = self._standing(against)
        why = f"{why}, {standing} do not"
        if have.weight <= c.rebel_weight * standing.weight:
            return Decision(False, f"{why}, more weight needed")
        if denial := self._denial(loop):
            return Decision(False, why + denial)
        return self._overthrow(story, against, why)

    def _ties_between(self, a: int, b: int) -> list[int]:
        """The fewest loops without which stretches a and b are not of one map."""
        loops = {
            n: tuple(self._chart.stretch_of(key) for key in (loop.a, loop.b))
            for n, loop in self._chart.ties.loops.items()
            if self._chart.founder_of(loop.a) == self._chart.founder[a]
        }
        numbers = list(loops)
        return [numbers[i] for i in fewest([(x, y) for x, y in loops.values()], a, b)]

    def _standing(self, against: Sequence[int]) -> Evidence:
        """What loops of a map, by their edges' numbers, are worth; a few of those that nobody has looked at
        yet are looked at."""
        loops = self._chart.ties.loops
        unknown = [n for n in against if loops[n].found is None and near(loops[n], self._config)]
        for n in unknown[:: 1 + len(unknown) // _LOOKED_AT]:
            loops[n] = self._survey.looked_at(loops[n])
        return self._weigh([loops[n] for n in against])

    def _overthrow(self, loops: list[Loop], against: list[int], why: str) -> Decision:
        dropped = self._chart.drop(against)
        self.rebels, others = [], [loop for loop in self.rebels if loop not in loops]
        self.waiting += others
        accepted = self._accept(loops, f"{why}; {taken_out(dropped)}")
        return Decision(True, accepted.reason, accepted.joined, accepted.tied, dropped)

    # ------------------------------------------------------------ between two maps

    def _join(self, loop: Loop) -> Decision:
        story = [*self._same_story(loop, self.waiting), loop]
        have, need = self._unique(story), self._places_needed(loop)
        why = f"loop {loop}: would join two maps, {have.places} of {need} places that say so"
        lacks = "" if have.places >= need and have.keyframes >= 2 else ": waits"
        lacks = lacks or self._doubt(loop, have) or self._denial(loop)
        if lacks:
            self._wait(loop)
            return Decision(False, why + lacks)
        return self._accept(story, why)

    def _doubt(self, loop: Loop, have: Evidence) -> str:
        """Why a story that is told at enough places may yet be of a copy; empty if nothing says so."""
        c = self._config
        if have.found < c.join_found:
            return f", but only {have.found:.0%} of what both should show is found: waits"
        allowed = c.rival_weight * have.weight
        rival = self._rival(loop, allowed)
        return f"; another story has {rival}: waits" if rival.weight > allowed else ""

    def _denial(self, loop: Loop) -> str:
        """What the overlap of both maps has against it, whatever was recognised; empty if nothing."""
        looks, c = self._survey.overlap(loop), self._config
        if len(looks) < c.overlap_pairs:
            return f", but only {len(looks)} views overlap: waits"
        gone = sum(look.share for look in looks) / max(1, len(looks))
        if gone > c.overlap_gone:
            return f", but {gone:.0%} of the {len(looks)} views that overlap is gone: waits"
        doubts = itertools.accumulate(looks, lambda d, look: doubt(d, look, c.overlap_gone), initial=0.0)
        if (worst := max(doubts)) > c.undo_doubt:
            return f", but views in a row show things gone (doubt {worst:.1f}): waits"
        return ""

    def _places_needed(self, loop: Loop) -> int:
        """Of a map that knows few places, all but one."""
        chart, c = self._chart, self._config
        maps = [chart.nodes_of(chart.founder_of(key)) for key in (loop.a, loop.b)]
        known = min(places([chart.poses[n] for n in nodes], c, c.join_places + 1) for nodes in maps)
        return max(1, known - 1)

    def _rival(self, loop: Loop, allowed: float) -> Evidence:
        """Of the stories between the same two maps that contradict this one, the first that weighs more
        than allowed, or else the best."""
        compared = self._compared(loop, self.waiting)
        left = [other for other, chi2 in compared if chi2 > self._config.surprise_chi2]
        best = Evidence()
        while left and best.weight <= allowed:
            told = [*self._same_story(left[-1], left[:-1]), left[-1]]
            weighs = self._weigh(told)
            if weighs.weight > best.weight and not self._denial(told[-1]):
                best = weighs
            pairs = {x.pair for x in told}
            left = [x for x in left if x.pair not in pairs]
        return best

    # ------------------------------------------------------------ witnesses

    def _same_story(self, loop: Loop, others: Sequence[Loop]) -> list[Loop]:
        """Of others between the same two maps (in one map: the same stretches), those that agree."""
        return [x for x, chi2 in self._compared(loop, others) if chi2 <= self._config.agree_chi2]

    def _compared(self, loop: Loop, others: Sequence[Loop]) -> list[tuple[Loop, float]]:
        """Others between the same two maps, and by how much each disagrees."""
        facing = [turned for other in others if (turned := self._facing(loop, other)) is not None]
        if not facing:
            return []
        (a, b), ends = self._chart.ends(loop), [self._chart.ends(x) for x in facing]
        from_a = self._chart.between(a, [x for x, _ in ends])
        to_b = opposite(self._chart.between(b, [y for _, y in ends]))
        return list(zip(facing, witness_chi2(loop, from_a, facing, to_b).tolist(), strict=True))

    def _facing(self, loop: Loop, other: Loop) -> Loop | None:
        """The other loop, from where this one comes from to where it goes, if it has such ends and is
        not about the very same keyframes."""
        if loop.pair == other.pair:
            return None
        chart = self._chart
        side = chart.stretch_of if chart.founder_of(loop.a) == chart.founder_of(loop.b) else chart.founder_of
        ours = side(loop.a), side(loop.b)
        for turned in (other, other.reverse()):
            if (side(turned.a), side(turned.b)) == ours:
                return turned
        return None

    def _weigh(self, loops: Sequence[Loop]) -> Evidence:
        return weigh(loops, self._chart, self._config)

    def _unique(self, loops: Sequence[Loop]) -> Evidence:
        """Where nothing else is known to look the same."""
        seen = [loop for loop in loops if near(loop, self._config)]
        return self._weigh([loop for loop in seen if not self._looks_alike(loop)])

    def _looks_alike(self, loop: Loop) -> bool:
        chart, c = self._chart, self._config
        for number in chart.ends(loop):
            stretch = chart.trails.nodes[number].stretch
            known = [n for n in self._alike if n in chart.poses and chart.trails.nodes[n].stretch == stretch]
            if near_any(chart.poses[number], [chart.poses[n] for n in known], c.place_m, c.place_rad):
                return True
        return False

    # ------------------------------------------------------------ believing

    def _accept(self, loops: list[Loop], reason: str) -> Decision:
        chart = self._chart
        before = sorted({chart.founder_of(key) for key in (loops[-1].a, loops[-1].b)}, key=chart.rank)
        if len(before) > 1:
            chart.lay_beside(min(loops, key=lambda loop: float(loop.cov.trace())))
        self._believe(loops)
        if len(before) == 1:
            return Decision(True, reason, tied=tuple(loops))
        self._survey.begin(loops[-1])
        waited = self.settle()
        survivor, gone = (chart.trails.stretches[s].name for s in before)
        reason += f"{that_waited(waited)}: map {gone} joins {survivor}"
        return Decision(True, reason, (survivor, gone), (*loops, *waited))

    def _believe(self, loops: Sequence[Loop]) -> None:
        told = {loop.pair for loop in loops}
        self.waiting = [loop for loop in self.waiting if loop.pair not in told]
        for loop in loops:
            self._chart.tie(loop)

    def _wait(self, loop: Loop) -> None:
        self.waiting = [*self.waiting, loop][-self._config.max_pending :]


def _has_moved(before: F64, now: F64) -> bool:
    return bool(np.abs(se3.log(se3.inverse(before) @ now)).max() > _MOVED)


def taken_out(loops: Sequence[Loop]) -> str:
    """For a reason."""
    named = ", ".join(map(str, loops[:_NAMED]))
    return f"taken out: {named}" + (f" and {len(loops) - _NAMED} more" if len(loops) > _NAMED else "")


def that_waited(loops: Sequence[Loop]) -> str:
    """For a reason."""
    return f", {len(loops)} that waited fit too" if loops else ""
