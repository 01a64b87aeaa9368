"""Taking a pose out of the graph, so that the map stays bounded.

Of the odometry a - x - b one edge a - b stays; loops that end at x move to its neighbour along the
surer of the two. The odometry edge e that they move along then speaks several times: in every
moved loop, and in a - b. Each is told a share of its information, the shares sum to one, so
nothing is counted twice: it is as if x were split into as many poses that know nothing of each
other, and what is left out of a graph can only have told more. Source of the idea: covariance
intersection; Julier and Uhlmann, *A Non-divergent Estimation Algorithm*, ACC 1997.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.graph.posegraph import Edge


@dataclass(frozen=True, eq=False)
class Contracted:
    """The edges that stand for those which touched a pose that is gone.

    odometry: all but the one that the others moved along; none where a chain ended. loops: one for each
    that was given, None where it would join the neighbour to itself.
    """

    odometry: tuple[Edge, ...]
    loops: tuple[Edge | None, ...]


def contract(x: int, odometry: Sequence[Edge], loops: Sequence[Edge], share: float = 0.5) -> Contracted:
    """Take pose x out, given all the edges that touch it; they are gone then.

    share: of the information of the edge along which the others move, how much odometry is told;
    loops are told equal parts of the rest. Raises ValueError if x has no neighbour by odometry, or
    if an edge does not touch x.
    """
    stray = [edge for edge in (*odometry, *loops) if x not in (edge.a, edge.b)]
    if stray or not odometry:
        raise ValueError(f"pose {x}: {'an edge does not touch it' if stray else 'no neighbour by odometry'}")
    road = min(odometry, key=lambda edge: edge.spread)
    y = road.a if road.b == x else road.b
    others = [edge for edge in odometry if edge is not road and y not in (edge.a, edge.b)]
    moving = [edge for edge in loops if y not in (edge.a, edge.b)]
    to_odometry = share if moving else 1.0
    to_loops = 1 - share if others else 1.0
    moved = {id(edge): _moved(edge, x, y, road, to_odometry / len(others)) for edge in others}
    moved |= {id(edge): _moved(edge, x, y, road, to_loops / len(moving)) for edge in moving}
    return Contracted(tuple(moved[id(edge)] for edge in others), tuple(moved.get(id(edge)) for edge in loops))


def _moved(edge: Edge, x: int, y: int, road: Edge, share: float) -> Edge:
    """`edge` with its end at x moved to y along `road`, of whose information it is told `share`."""
    along = road if road.a == x else road.reverse()
    lead = edge if edge.b == x else edge.reverse()
    cov = se3.compose_cov(along.T_a_b, lead.cov, along.cov / share)
    moved = Edge(lead.a, y, se3.orthonormal(lead.T_a_b @ along.T_a_b), cov)
    return moved if edge.b == x else moved.reverse()


def fuse(edges: Sequence[Edge]) -> tuple[Edge, float]:
    """Edges that join the same two poses as one (their information added), and the chi-square by which
    they disagree, of 6 (K - 1) dof: where it is too large one of them is false. Directed as the first.
    Raises ValueError if they do not join the same two poses."""
    first = edges[0]
    if any({edge.a, edge.b} != {first.a, first.b} for edge in edges):
        raise ValueError("edges between different poses cannot be one")
    alike = [edge if edge.a == first.a else edge.reverse() for edge in edges]
    xi = se3.log(se3.inverse(first.T_a_b) @ np.array([edge.T_a_b for edge in alike]))
    information = np.linalg.inv(np.array([edge.cov for edge in alike]))
    cov = np.linalg.inv(information.sum(0))
    mean = cov @ np.einsum("kij,kj->i", information, xi)
    chi2 = np.einsum("ki,kij,kj->", xi - mean, information, xi - mean)
    return Edge(first.a, first.b, se3.orthonormal(first.T_a_b @ se3.exp(mean)), cov), float(chi2)
