"""Paths over a robot's costmap: the cheapest way to a goal that keeps off obstacles, as Nav2's NavFn does.

The costmap is fixed to the room; where it lies in the map is what the robot believes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from share.lab.emulate.motion.robot import RADIUS
from share.lab.emulate.motion.route import Floor, cell_graph
from share.robot.planar import PlanarPose
from share.types import F64

_NEAREST_M = 0.5  # a start or goal in an obstacle is moved so far at most (NavFn's tolerance)
_PERSON_M = 0.4  # radius of a person, with a margin


class RoomGrid:
    """The floor of a room for robots, with its graph."""

    def __init__(self, floor: Floor) -> None:
        self.floor = floor
        self.cells = np.argwhere(floor.clearance >= RADIUS)

    @cached_property
    def graph(self) -> Any:
        """The cells' neighbours as a sparse matrix of costs, m."""
        return cell_graph(self.floor, self.cells, RADIUS)

    @cached_property
    def places(self) -> F64:
        """Places (N, 2) m of the cells, in the room."""
        return np.asarray(self.cells * self.floor.step + self.floor.origin, np.float64)

    def clearance(self, pose: PlanarPose) -> float:
        """Return the distance of a place from the nearest obstacle, m."""
        return float(self.floor.clearance_at(np.array([[pose.x, pose.y]]))[0])

    def lengths_from(self, xy: F64) -> F64:
        """Return the costs (N,) of the ways from a place (2,) to all cells; infinite without one."""
        from scipy.sparse.csgraph import dijkstra

        out: F64 = dijkstra(self.graph, indices=int(np.argmin(_distances(self.places, xy))))
        return out


@dataclass(frozen=True, eq=False)
class Costmap:
    """The room around a robot as its lidar sees it: `grid`, and T_base_room, which takes the room's
    coordinates to base_link. people (P, 2): in the room, m."""

    grid: RoomGrid
    T_base_room: PlanarPose
    people: F64

    def plan(self, T_map_base: PlanarPose, goal: PlanarPose) -> F64 | None:
        """Return the way (N, 2) m, in the map, from where the robot believes to be to a goal in the map; None
        where there is none."""
        from scipy.sparse.csgraph import dijkstra

        T_map_room = T_map_base @ self.T_base_room
        start, end = self.T_base_room.inverse(), T_map_room.inverse() @ goal
        places = self.grid.places
        is_free = np.ones(len(places), bool)
        for person in self.people:
            is_free &= _distances(places, person) > RADIUS + _PERSON_M
        free = np.flatnonzero(is_free)
        if not len(free):
            return None
        first, last = (_nearest(places[free], np.array([pose.x, pose.y])) for pose in (start, end))
        if first is None or last is None:
            return None
        graph = self.grid.graph if len(free) == len(places) else self.grid.graph[free][:, free]
        costs, before = dijkstra(graph, indices=last, return_predecessors=True)
        if not np.isfinite(costs[first]):
            return None
        nodes = [first]
        while nodes[-1] != last:
            nodes.append(int(before[nodes[-1]]))
        way = places[free][nodes]
        way[0] = start.x, start.y
        if self.grid.clearance(end) >= RADIUS:
            way[-1] = end.x, end.y
        return _in_map(T_map_room, way)


def _nearest(places: F64, xy: F64) -> int | None:
    distances = _distances(places, xy)
    best = int(np.argmin(distances))
    return best if distances[best] <= _NEAREST_M else None


def _distances(places: F64, xy: F64) -> F64:
    out: F64 = np.linalg.norm(places - xy, axis=1)
    return out


def _in_map(T: PlanarPose, points: F64) -> F64:
    c, s = np.cos(T.yaw), np.sin(T.yaw)
    out: F64 = points @ np.array([[c, s], [-s, c]]) + (T.x, T.y)
    return out
