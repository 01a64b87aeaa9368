"""Whether two maps look alike wherever they overlap, not only where somebody recognised something.

A copy of a room is recognised as well as the room, so loops alone speak for it. What speaks against it are
views that, by the map, should show the same and do not: things are gone
(`share.mapping.recognition.missing`). Nobody proposes those, so they are looked for: before two maps are
joined, in all of their overlap, and after that for as long as the join is on probation, wherever an agent
comes to where the other has been."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from share.geometry import se3
from share.mapping.loops import Loop
from share.mapping.map_graph import Chart
from share.mapping.recognition.missing import Gone, gone, missing
from share.mapping.recognition.verification import Sight
from share.types import F64

_NEAR_M, _NEAR_RAD = 1.0, 0.5  # of one spot: views this near ought to look alike
_POINTS = 20  # a pair of views that share fewer says nothing
_PAIRS = 40  # looked at before a join
_PROBATION = 40  # views after a join, without a doubt at the last of them
_SAME_M, _SAME_RAD = 0.02, 0.01  # a pair that has moved by less is not looked at again
_REMEMBERED = 4000  # pairs


@dataclass(eq=False)
class Probation:
    """Of a join between two stretches. doubt: see the function."""

    doubt: float = 0.0
    looks: int = 0


class Survey:
    """Of one chart. sights: what each node saw, as far as it is known."""

    def __init__(self, chart: Chart, sights: Mapping[int, Sight]) -> None:
        self._chart, self._sights = chart, sights
        self._seen: dict[tuple[int, int], tuple[F64, Gone]] = {}
        self._probations: dict[tuple[int, int], Probation] = {}

    def looked_at(self, loop: Loop) -> Loop:
        """With what is found of it, if both its views are known."""
        a, b = (self._sights.get(n) for n in self._chart.ends(loop))
        if loop.found is not None or a is None or b is None:
            return loop
        return replace(loop, found=1 - missing(b, a, loop.T_a_b).share)

    def overlap(self, loop: Loop) -> list[Gone]:
        """Of two maps (in one map: two stretches), if they lay as the loop says: pairs of views from about
        one spot, each view in one of them, in the order of b's."""
        chart, (a, b) = self._chart, self._chart.ends(loop)
        ours, theirs = (self._known(self._side(n, chart.same_map(a, b))) for n in (a, b))
        if not ours or not theirs:
            return []
        T_b = chart.poses[a] @ loop.T_a_b @ se3.inverse(chart.poses[b])  # map of b in that of a
        x, y = (np.array([chart.poses[n] for n in nodes]) for nodes in (ours, theirs))
        pairs = _near_pairs(x, T_b @ y)
        looks = ((j, self._look(ours[i], theirs[j], T)) for i, j, T in pairs)
        return [look for _, look in sorted(_telling(looks, _PAIRS))]

    def begin(self, loop: Loop) -> None:
        """A join that this loop made is on probation."""
        self._probations[self._stretches(loop)] = Probation()

    def review(self, number: int, allowed: float) -> Iterator[tuple[tuple[int, int], float]]:
        """A new node: for each stretch to which its own was joined not long ago, where it comes to what that
        has seen, the join as both stretches, and its doubt. allowed: share of a view that may be gone."""
        own = self._chart.trails.nodes[number].stretch
        for pair, probation in list(self._probations.items()):
            if own in pair and self._one_map(pair):
                look = self._nearest(number, pair[0] if own == pair[1] else pair[1])
                if look is None:
                    continue
                probation.looks += 1
                probation.doubt = doubt(probation.doubt, look, allowed)
                yield pair, probation.doubt
                if probation.looks >= _PROBATION and not probation.doubt:
                    self._probations.pop(pair, None)

    def end(self, pair: tuple[int, int]) -> None:
        """The join of these stretches is undone."""
        self._probations.pop(pair, None)

    def _side(self, number: int, of_stretch: bool) -> list[int]:
        stretch = self._chart.trails.nodes[number].stretch
        if of_stretch:
            return self._chart.trails.stretches[stretch].nodes
        return self._chart.nodes_of(self._chart.founder[stretch])

    def _stretches(self, loop: Loop) -> tuple[int, int]:
        a, b = sorted(self._chart.stretch_of(key) for key in (loop.a, loop.b))
        return a, b

    def _one_map(self, pair: tuple[int, int]) -> bool:
        return self._chart.founder[pair[0]] == self._chart.founder[pair[1]]

    def _nearest(self, number: int, stretch: int) -> Gone | None:
        """What the nearest view of this stretch shows of what the node shows, if it is near enough."""
        nodes = self._known(self._chart.trails.stretches[stretch].nodes)
        if not nodes or number not in self._sights:
            return None
        poses = self._chart.poses
        pairs = _near_pairs(np.array([poses[n] for n in nodes]), poses[number][None])
        looks = _telling(((j, self._look(nodes[i], number, T)) for i, j, T in pairs), 1)
        return looks[0][1] if looks else None

    def _known(self, nodes: Sequence[int]) -> list[int]:
        return [n for n in nodes if n in self._sights]

    def _look(self, a: int, b: int, T_a_b: F64) -> Gone:
        """Remembered, for the same pairs are asked for whenever another loop tells the same story."""
        if (known := self._seen.get((a, b))) is not None:
            off = se3.inverse(known[0]) @ T_a_b
            if np.linalg.norm(off[:3, 3]) < _SAME_M and se3.angle(off) < _SAME_RAD:
                return known[1]
        look = gone(self._sights[b], self._sights[a], T_a_b)
        if len(self._seen) >= _REMEMBERED:
            self._seen.clear()
        self._seen[a, b] = T_a_b, look
        return look


def doubt(before: float, look: Gone, allowed: float) -> float:
    """What was gone beyond the share that is allowed, summed up over views as long as it is above 0 (Page's
    CUSUM, Biometrika 1954)."""
    return max(0.0, before + look.share - allowed)


def _telling(looks: Iterator[tuple[int, Gone]], most: int) -> list[tuple[int, Gone]]:
    """The first of those that say something."""
    return list(itertools.islice((look for look in looks if look[1].visible >= _POINTS), most))


def _near_pairs(x: F64, y: F64) -> Iterator[tuple[int, int, F64]]:
    """Pairs of poses x (N, 4, 4), y (K, 4, 4) from about one spot, as i, j, T_x_y; nearest first, each pose
    in one of them."""
    a, b = x[:, :3, 3], y[:, :3, 3]
    square = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
    rows, cols = np.nonzero(square < _NEAR_M**2)
    cosine = ((x[rows, :3, :3] * y[cols, :3, :3]).sum((1, 2)) - 1) / 2
    alike = cosine > np.cos(_NEAR_RAD)
    rows, cols = rows[alike], cols[alike]
    used_x, used_y = set[int](), set[int]()
    for k in np.argsort(square[rows, cols], kind="stable"):
        i, j = int(rows[k]), int(cols[k])
        if i not in used_x and j not in used_y:
            used_x.add(i)
            used_y.add(j)
            yield i, j, se3.inverse(x[i]) @ y[j]
