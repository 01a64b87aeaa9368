"""What loops that tell one story are worth together.

Neighbouring views of one spot are one witness, not many, so places are counted. And copies match worse than
the place itself: of what two views should share if they stand as the loop says, they share less. A story
weighs its places times the square of that share.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from share.config import MergeConfig
from share.mapping.loops import Loop, distinct
from share.mapping.map_graph import Chart
from share.types import F64, I64

_USUAL = 0.5  # found where nobody has looked: what most true loops have


@dataclass(frozen=True)
class Evidence:
    """Of a story, as seen from near: at how many places, the mean share that was found, and how many
    keyframes there are on either side, the lesser (one view can fool us many times)."""

    places: int = 0
    found: float = 0.0
    keyframes: int = 0

    @property
    def weight(self) -> float:
        return self.places * self.found**2

    def __str__(self) -> str:
        return f"{self.places} places (weight {self.weight:.2f})"


def near(loop: Loop, config: MergeConfig) -> bool:
    """Whether both views were from about the same spot: copies are told apart from near, if at all."""
    away, turned = loop.apart
    return away <= config.near_m and turned <= config.near_rad


def weigh(loops: Sequence[Loop], chart: Chart, config: MergeConfig) -> Evidence:
    """Places are counted on either side, the lesser; loops that were not seen from near say nothing."""
    seen = [loop for loop in loops if near(loop, config)]
    if not seen:
        return Evidence()
    sides: dict[int, list[F64]] = {}
    for loop in seen:
        for number in chart.ends(loop):
            sides.setdefault(chart.trails.nodes[number].stretch, []).append(chart.poses[number])
    count = min(places(poses, config) for poses in sides.values())
    told = [loop.found for loop in seen if loop.found is not None]
    found = float(np.mean(told)) if told else _USUAL
    keyframes = min(len({loop.a for loop in seen}), len({loop.b for loop in seen}))
    return Evidence(count, found, keyframes)


def places(poses: Sequence[F64], config: MergeConfig, enough: int | None = None) -> int:
    """How many places these poses (4, 4) are; counted no further than `enough`."""
    return distinct(np.array(poses), config.place_m, config.place_rad, enough)


# ---- The fewest loops that would have to be false for two stretches not to belong together.


def fewest(pairs: Sequence[tuple[int, int]], start: int, goal: int) -> list[int]:
    """Indices of the pairs (loops, by the stretches that they tie) without which no way leads from
    `start` to `goal`: a minimum cut (Ford and Fulkerson 1956). Raises ValueError if start is goal.
    """
    if start == goal:
        raise ValueError("a stretch cannot be cut from itself")
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    names = sorted({start, goal, *(end for pair in pairs for end in pair)})
    place = {name: i for i, name in enumerate(names)}
    ends: I64 = np.array([(place[a], place[b]) for a, b in pairs], np.int64).reshape(-1, 2)
    both = np.concatenate([ends, ends[:, ::-1]])
    n = len(names)
    capacity = csr_array((np.ones(len(both), np.int32), (both[:, 0], both[:, 1])), shape=(n, n))
    capacity.sum_duplicates()
    flow = maximum_flow(capacity, place[start], place[goal]).flow
    left = capacity - flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    near = np.zeros(n, bool)
    near[breadth_first_order(left, place[start], return_predecessors=False)] = True
    return [int(i) for i in np.flatnonzero(near[ends[:, 0]] != near[ends[:, 1]])]


# ---- Which stretches hold a map together.


def bridging(bonds: Iterable[tuple[int, int]]) -> set[int]:
    """Stretches without which others of their map were not tied any more: the articulation points of the
    graph of `bonds` (Hopcroft and Tarjan, CACM 1973)."""
    beside: dict[int, list[int]] = {}
    for a, b in bonds:
        if a != b:
            beside.setdefault(a, []).append(b)
            beside.setdefault(b, []).append(a)
    depth: dict[int, int] = {}
    low: dict[int, int] = {}
    out: set[int] = set()
    for root in beside:
        if root in depth:
            continue
        depth[root] = low[root] = 0
        way, children = [(root, iter(beside[root]))], 0
        while way:
            here, others = way[-1]
            for other in others:
                if other not in depth:
                    depth[other] = low[other] = len(way)
                    way.append((other, iter(beside[other])))
                    break
                low[here] = min(low[here], depth[other])
            else:
                way.pop()
                if not way:
                    continue
                before = way[-1][0]
                low[before] = min(low[before], low[here])
                if before == root:
                    children += 1
                elif low[here] >= depth[before]:
                    out.add(before)
        if children > 1:
            out.add(root)
    return out
