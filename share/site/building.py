"""Where the maps of rooms lie to each other, by the agents that walked between them.

An agent that leaves one map and enters another carries its odometry through the door: both maps say where its
odom frame is. Each such crossing is an edge between two maps; maps that edges tie have a common frame, that
of the first of them. The graph has a node for each map, so no solution spans the keyframes of a building.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from share.geometry import se3
from share.mapping.graph.edges import PoseEdge
from share.mapping.graph.solver import GraphUpdate, PoseGraphSolver
from share.types import F64, Correction

_MAX_PER_PAIR = 16  # newest crossings between two maps
# Added to each crossing: odometry since the last correction, and what a map bends later.
_FLOOR_COV = np.diag([np.radians(0.5) ** 2] * 3 + [0.02**2] * 3)


class RoomMap(NamedTuple):
    """A map of a room."""

    room: str
    map_id: str


@dataclass(frozen=True, eq=False)
class BuildingPose:
    """T_building_map (4, 4), in the frame of the map `reference`."""

    reference: RoomMap
    T_building_map: F64


@dataclass(frozen=True, eq=False)
class _Crossing:
    a: RoomMap
    b: RoomMap
    T_a_b: F64
    cov: F64


class BuildingGraph:
    """The maps of a site, and the crossings between them."""

    def __init__(self) -> None:
        self._crossings: dict[tuple[RoomMap, RoomMap], deque[_Crossing]] = {}
        self.poses: dict[RoomMap, BuildingPose] = {}  # of all maps with a crossing

    def add_crossing(self, a: RoomMap, in_a: Correction, b: RoomMap, in_b: Correction) -> None:
        """Add that one odom frame is at both corrections, in the maps a and b; solve again."""
        if a == b:
            return
        T_odom_b = se3.inverse(in_b.T_map_odom)
        cov = se3.compose_cov(T_odom_b, in_a.cov, se3.inverse_cov(in_b.T_map_odom, in_b.cov)) + _FLOOR_COV
        crossing = _Crossing(a, b, se3.orthonormal(in_a.T_map_odom @ T_odom_b), cov)
        pair = (a, b) if a <= b else (b, a)
        self._crossings.setdefault(pair, deque(maxlen=_MAX_PER_PAIR)).append(crossing)
        self._solve()

    def keep(self, may_exist: Callable[[RoomMap], bool]) -> None:
        """Forget the maps that do not exist: they have become part of others, or are gone."""
        gone = {one for pair in self._crossings for one in pair if not may_exist(one)}
        if gone:
            self._crossings = {
                pair: crossings for pair, crossings in self._crossings.items() if not gone & {*pair}
            }
            self._solve()

    def _solve(self) -> None:
        crossings = [one for pair in self._crossings.values() for one in pair]
        initial = _spanning_poses(crossings)
        ids = {one: id for id, one in enumerate(initial)}
        edges = [
            (n, PoseEdge(ids[one.a], ids[one.b], one.T_a_b, one.cov), True) for n, one in enumerate(crossings)
        ]
        solver = PoseGraphSolver()
        solver.update(
            GraphUpdate.from_edges({ids[one]: pose.T_building_map for one, pose in initial.items()}, edges)
        )
        solved: dict[int, F64] = {}
        for reference in dict.fromkeys(pose.reference for pose in initial.values()):
            solution = solver.solve(ids[reference])
            solved |= dict(zip(solution.pose_ids.tolist(), solution.poses, strict=True))
        self.poses = {one: BuildingPose(pose.reference, solved[ids[one]]) for one, pose in initial.items()}


def _spanning_poses(crossings: list[_Crossing]) -> dict[RoomMap, BuildingPose]:
    """Poses by chains of crossings, each component in the frame of its first map."""
    out: dict[RoomMap, BuildingPose] = {}
    for first in crossings:
        if first.a in out or first.b in out:
            continue
        out[first.a] = BuildingPose(first.a, np.eye(4))
        has_grown = True
        while has_grown:
            has_grown = False
            for one in crossings:
                for known, new, T in ((one.a, one.b, one.T_a_b), (one.b, one.a, se3.inverse(one.T_a_b))):
                    if known in out and new not in out:
                        T_building_new = se3.orthonormal(out[known].T_building_map @ T)
                        out[new] = BuildingPose(out[known].reference, T_building_new)
                        has_grown = True
    return out
