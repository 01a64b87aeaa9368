"""Which look-alikes of a keyframe to try first where there is no time to try them all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from share.geometry import se3
from share.merge.chart import Chart
from share.types import F64

_FAR_M, _FAR_RAD = 4.0, 1.0  # views of one map further apart than this, or turned more, seldom share enough


def promising_first(chart: Chart, number: int, others: Sequence[int]) -> list[int]:
    """`others`, of which those of larger maps come first, for agents are to end up in one; last those that
    this keyframe cannot see if its map is right. Where it is wrong they are still tried, but later."""
    nodes = chart.trails.nodes
    sizes: Counter[int] = Counter()
    for stretch, founder in zip(chart.trails.stretches, chart.founder, strict=True):
        sizes[founder] += len(stretch.nodes)

    def rank(other: int) -> tuple[bool, int]:
        size = sizes[chart.founder[nodes[other].stretch]]
        return chart.same_map(number, other) and _are_far(chart.poses[number], chart.poses[other]), -size

    return sorted(others, key=rank)


def _are_far(T_map_a: F64, T_map_b: F64) -> bool:
    T = se3.inverse(T_map_a) @ T_map_b
    return bool(np.linalg.norm(T[:3, 3]) > _FAR_M or se3.angle(T) > _FAR_RAD)
