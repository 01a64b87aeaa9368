"""Fewer keyframes, the same room: those that show what others show as well are taken out.

What is left covers the same views; odometry and loops of a keyframe that goes are moved to its neighbour
(`share.graph.contract`), so what was known stays known, a little less surely.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.graph.contract import contract
from share.graph.posegraph import Edge
from share.merge.chart import Chart
from share.merge.join import Key, Loop
from share.merge.trails import Node
from share.types import F64, Keyframe

_ROWS = 256
_ALONE = 1e9  # as unlike as that is who has no other beside it


@dataclass(frozen=True, eq=False)
class Link:
    """The odometry edge that leads to keyframe `key` now, from keyframe `reference` of the same agent; None:
    it is the first of its stretch now, and T_ref_body (4, 4) is its T_odom_body. cov (6, 6): of it."""

    key: Key
    reference: Key | None
    T_ref_body: F64
    cov: F64


@dataclass(frozen=True, eq=False)
class TakenOut:
    """A keyframe that is gone, what leads to the one after it now, and loops that were moved elsewhere."""

    number: int
    key: Key
    link: Link | None
    moved: tuple[Loop, ...]


def redundant(
    poses: F64, whose: Sequence[str | None], due: Counter[str], apart_m: float, apart_rad: float, below: float
) -> list[int]:
    """Which of poses (N, 4, 4) to take out: again and again one of the two that are most alike, the one that
    has the nearer second neighbour, while they are no less alike than `below`.

    whose: of each pose; of those of None none goes. due: how many go of each name; counted down. Two poses
    are as unlike as |shift| / apart_m + angle / apart_rad.
    """
    gap = _unlike(poses, apart_m, apart_rad)
    np.fill_diagonal(gap, np.inf)
    names = np.array([name or "" for name in whose])
    free = np.array([name is not None and due[name] > 0 for name in whose], bool)
    nearest = np.concatenate([_two_least(gap[rows]) for rows in _blocks(len(poses))])
    out: list[int] = []
    while free.any():
        rank = np.minimum(nearest[:, 0] + 1e-3 * nearest[:, 1], _ALONE)
        gone = int(np.where(free, rank, np.inf).argmin())
        if nearest[gone, 0] > below:
            break
        out.append(gone)
        free[gone] = False
        due[str(names[gone])] -= 1
        if not due[str(names[gone])]:
            free[names == names[gone]] = False
        stale = np.flatnonzero(gap[gone] <= nearest[:, 1])
        gap[gone], gap[:, gone] = np.inf, np.inf
        nearest[stale] = _two_least(gap[stale])
    return out


def across(T_odom_before: F64, lost: int, keyframe: Keyframe) -> tuple[F64, F64]:
    """T_before_body (4, 4) of a keyframe whose reference is not there any more, from one before it on its
    stretch, and its covariance (6, 6). lost: how many steps lie between that and the reference.

    Both stand in one odometry, so their relative pose is known: T_odom_before^-1 T_odom_body. Of the steps in
    between nothing is left; each is taken to be as uncertain as the step that is known.
    """
    cov: F64 = se3.compose_cov(keyframe.T_ref_body, max(1, lost) * keyframe.cov, keyframe.cov)
    return se3.orthonormal(se3.inverse(T_odom_before) @ keyframe.T_odom_body), (cov + cov.T) / 2


def tied_again(agent: str, keyframe: Keyframe, before: Node | None) -> Link:
    """The odometry edge to such a keyframe from the newest that is left of its stretch, if one is."""
    key = Key(agent, keyframe.id)
    if before is None:
        return Link(key, None, keyframe.T_odom_body, keyframe.cov)
    return Link(key, before.key, *across(before.T_odom_body, keyframe.reference - before.key.id, keyframe))


def take_out(chart: Chart, number: int, most_loops: int) -> TakenOut:
    """Of a keyframe with an odometry neighbour; one without takes its loops along. No keyframe is given
    more than `most_loops` loops, but for the last between two stretches. `chart.find_maps` is due
    afterwards."""
    trails, ties = chart.trails, chart.ties
    key, before, after = trails.nodes[number].key, trails.before(number), trails.after(number)
    touching = ties.touching(number)
    loops = [(ties.loops[n], ties.edges[n]) for n in touching if n in ties.loops]
    odometry = [ties.edges[n] for n in touching if n not in ties.loops]
    for n in touching:
        if n in ties.loops:
            chart.unbind(n)
        else:
            ties.remove(n)
    chart.forget(number)
    if not odometry:
        return TakenOut(number, key, None, ())
    left = contract(number, odometry, [edge for _, edge in loops])
    for edge in left.odometry:
        ties.add(edge)
    link = None if after is None else _link(chart, before, after)
    pairs = [(old, edge) for (old, _), edge in zip(loops, left.loops, strict=True) if edge is not None]
    moved = [_move(chart, old, edge, most_loops) for old, edge in pairs]
    return TakenOut(number, key, link, tuple(loop for loop in moved if loop is not None))


def _unlike(poses: F64, apart_m: float, apart_rad: float) -> F64:
    gap: F64 = np.empty((len(poses), len(poses)))
    for rows in _blocks(len(poses)):
        shift, angle = se3.apart(poses[rows], poses)
        gap[rows] = shift / apart_m + angle / apart_rad
    return gap


def _blocks(count: int) -> list[slice]:
    """Of rows: what is made on the way for all of thousands at once would take five times the result."""
    return [slice(k, k + _ROWS) for k in range(0, count, _ROWS)]


def _two_least(gap: F64) -> F64:
    """Of each row, (N, 2); inf where there are none."""
    if gap.shape[1] < 2:
        return np.full((len(gap), 2), np.inf)
    return np.partition(gap, 1, axis=1)[:, :2].copy()


def _link(chart: Chart, before: int | None, after: int) -> Link:
    node = chart.trails.nodes[after]
    if before is None:
        return Link(node.key, None, node.T_odom_body, np.zeros((6, 6)))
    edge = chart.step(before, after)
    return Link(node.key, chart.trails.nodes[before].key, edge.T_a_b, edge.cov)


def _move(chart: Chart, old: Loop, edge: Edge, most_loops: int) -> Loop | None:
    """The loop at its new ends; None where there is one already, or enough."""
    ties, nodes = chart.ties, chart.trails.nodes
    at_a, at_b = ({n for n in ties.touching(end) if n in ties.loops} for end in (edge.a, edge.b))
    if at_a & at_b or (max(len(at_a), len(at_b)) >= most_loops and chart.bonds[chart.bond(edge)]):
        return None
    loop = Loop(nodes[edge.a].key, nodes[edge.b].key, edge.T_a_b, edge.cov, old.inliers, old.found)
    chart.bind(edge, loop)
    return loop
