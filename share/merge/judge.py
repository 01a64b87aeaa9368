"""Which loops are believed: those that fit the map, or that others, elsewhere, bear witness to.

A verified loop may still be false: two places can look alike. Within a map it has to agree with what the
map knows; between two maps, or against the map, other loops have to tell the same story.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.config import MergeConfig
from share.merge.chart import Chart
from share.merge.cut import fewest
from share.merge.join import Disagreement, Known, Loop, disagreement, witness_disagreement
from share.merge.places import distinct
from share.types import F64


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

    waiting: for a witness, oldest first. rebels: those that contradict their map.
    """

    def __init__(self, config: MergeConfig, chart: Chart) -> None:
        self.waiting: list[Loop] = []
        self.rebels: list[Loop] = []
        self._config, self._chart = config, chart

    def decide(self, loop: Loop) -> Decision:
        """Accepted, waiting, or refused, with the reason. Raises ValueError if a keyframe is unknown."""
        a, b = self._chart.ends(loop)
        ties, gap = self._chart.ties, self._config.min_loop_gap
        if any(n in ties.loops and {a, b} == {ties.edges[n].a, ties.edges[n].b} for n in ties.touching(b)):
            return Decision(False, f"loop {loop}: joined already")
        if self._chart.trails.are_neighbours(a, b, gap):
            need = f"at least {gap} keyframes apart needed"
            return Decision(False, f"loop {loop}: neighbours by odometry, {need}")
        return self._close(loop) if self._chart.same_map(a, b) else self._join(loop)

    def settle(self) -> tuple[Loop, ...]:
        """Those that waited and fit the map that they are in by now are believed."""
        inside = [loop for loop in self.waiting if self._chart.same_map(*self._chart.ends(loop))]
        fitting = [loop for loop in inside if self._gap(loop).chi2 <= self._config.agree_chi2]
        self._believe(fitting)
        return tuple(fitting)

    # ------------------------------------------------------------ within a map

    def _close(self, loop: Loop) -> Decision:
        gap = self._gap(loop)
        if gap.chi2 <= self._config.agree_chi2:
            return self._accept([loop], f"loop {loop}: fits the map, {gap}")
        if gap.chi2 > self._config.surprise_chi2:
            return self._rebel(loop, f"loop {loop}: contradicts the map, {gap}")
        return self._seek_witness(loop, f"fits the map badly ({gap})")

    def _gap(self, loop: Loop) -> Disagreement:
        """Between what the loop says and what its map knows."""
        return disagreement(self._chart.between(*self._chart.ends(loop)), Known(loop.T_a_b, loop.cov))

    def _rebel(self, loop: Loop, why: str) -> Decision:
        """If more places contradict the map than tie the two stretches as they lie, the map is wrong."""
        a, b = (self._chart.stretch_of(key) for key in (loop.a, loop.b))
        if a == b:
            return Decision(False, why)
        allies = [*self._allies(loop), loop]
        self.rebels = [*self.rebels, loop][-self._config.max_pending :]
        against = self._ties_between(a, b)
        standing = self._places([self._chart.ties.loops[n] for n in against])
        have, need = self._places(allies), max(standing + 1, self._config.rebel_places)
        if have < need:
            return Decision(False, f"{why}; {have} places say so, {need} needed")
        return self._overthrow(allies, against, f"{why}; {have} places say so")

    def _allies(self, loop: Loop) -> list[Loop]:
        """Rebels between the same two stretches that tell the same story."""
        ours = {self._chart.stretch_of(key) for key in (loop.a, loop.b)}
        return [
            other
            for other in self.rebels
            if {self._chart.stretch_of(key) for key in (other.a, other.b)} == ours
            and not {loop.a, loop.b} & {other.a, other.b}
            and self._against(loop, other).chi2 <= self._config.agree_chi2
        ]

    def _ties_between(self, a: int, b: int) -> list[int]:
        """The fewest loops without which stretches a and b are not of one map."""
        loops = {
            n: tuple(self._chart.stretch_of(key) for key in (loop.a, loop.b))
            for n, loop in self._chart.ties.loops.items()
            if self._chart.founder_of(loop.a) == self._chart.founder[a]
        }
        numbers = list(loops)
        return [numbers[i] for i in fewest([(x, y) for x, y in loops.values()], a, b)]

    def _places(self, loops: Sequence[Loop]) -> int:
        """How many places they tie: counted on either side, the lesser."""
        sides: dict[int, list[F64]] = {}
        for loop in loops:
            for number in self._chart.ends(loop):
                stretch = self._chart.trails.nodes[number].stretch
                sides.setdefault(stretch, []).append(self._chart.poses[number])
        apart = self._config.place_m, self._config.place_rad
        counts = [distinct(np.array(poses), *apart) for poses in sides.values()]
        return min(counts, default=0)

    def _overthrow(self, loops: list[Loop], against: list[int], why: str) -> Decision:
        dropped = self._chart.drop(against)
        names = ", ".join(map(str, dropped))
        self.rebels, waiting = [], self.rebels
        self.waiting += [loop for loop in waiting if loop not in loops]
        accepted = self._accept(loops, f"{why}; taken out: {names}")
        return Decision(True, accepted.reason, accepted.joined, accepted.tied, dropped)

    # ------------------------------------------------------------ between two maps

    def _join(self, loop: Loop) -> Decision:
        alone = self._config.sole_witness_inliers
        if 0 < alone <= loop.inliers:
            return self._accept([loop], f"loop {loop}: {loop.inliers} inliers, {alone} join alone")
        return self._seek_witness(loop, "would join two maps")

    def _seek_witness(self, loop: Loop, why: str) -> Decision:
        heard = [
            (self._against(loop, other), other) for other in self.waiting if self._may_witness(loop, other)
        ]
        self.waiting = [*self.waiting, loop][-self._config.max_pending :]
        if not heard:
            return Decision(False, f"loop {loop}: {why}: first witness, waits for a second")
        gap, other = min(heard, key=lambda pair: pair[0].chi2)
        if gap.chi2 > self._config.agree_chi2:
            nobody = f"none of {len(heard)} witnesses agrees, best {gap}; waits"
            return Decision(False, f"loop {loop}: {why}: {nobody}")
        return self._accept([other, loop], f"loop {loop}: {why}: agrees with {other}, {gap}")

    def _may_witness(self, loop: Loop, other: Loop) -> bool:
        """It ties the same two maps, by other keyframes on either side."""
        maps = [{self._chart.founder_of(key) for key in (x.a, x.b)} for x in (loop, other)]
        return maps[0] == maps[1] and not {loop.a, loop.b} & {other.a, other.b}

    def _against(self, loop: Loop, other: Loop) -> Disagreement:
        chart = self._chart
        if chart.stretch_of(other.a) != chart.stretch_of(loop.a) == chart.stretch_of(other.b):
            other = other.reverse()
        if not chart.same_map(*(chart.trails.number(x.a) for x in (loop, other))):
            other = other.reverse()
        (a1, b1), (a2, b2) = chart.ends(loop), chart.ends(other)
        return witness_disagreement(loop, chart.between(a1, a2), other, chart.between(b2, b1))

    # ------------------------------------------------------------ believing

    def _accept(self, loops: list[Loop], reason: str) -> Decision:
        chart = self._chart
        before = sorted({chart.founder_of(key) for key in (loops[-1].a, loops[-1].b)})
        if len(before) > 1:
            chart.lay_beside(min(loops, key=lambda loop: float(loop.cov.trace())))
        self._believe(loops)
        if len(before) == 1:
            return Decision(True, reason, tied=tuple(loops))
        waited = self.settle()
        survivor, gone = (chart.trails.stretches[s].name for s in before)
        reason += f"{that_waited(waited)}: map {gone} joins {survivor}"
        return Decision(True, reason, (survivor, gone), (*loops, *waited))

    def _believe(self, loops: Sequence[Loop]) -> None:
        self.waiting = [loop for loop in self.waiting if loop not in loops]
        for loop in loops:
            self._chart.tie(loop)


def that_waited(loops: Sequence[Loop]) -> str:
    """For a reason."""
    return f", {len(loops)} that waited fit too" if loops else ""
