"""The edges of the pose graph by number, and what of it the solver does not know yet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from share.graph.change import Change
from share.graph.path import Roads
from share.graph.posegraph import Edge
from share.merge.join import Loop
from share.types import F64


class Ties:
    """Odometry and loops between numbered poses."""

    def __init__(self) -> None:
        self.roads = Roads()
        self.edges: dict[int, Edge] = {}
        self.loops: dict[int, Loop] = {}  # of those edges that are loops, oldest first
        self._touching: dict[int, set[int]] = {}
        self._next = 0
        self.anew = True  # the solver knows nothing yet
        self._fresh: set[int] = set()  # edges that the solver does not have
        self._known: set[int] = set()  # poses that the solver has
        self._moved: set[int] = set()  # poses that it has otherwise, or not at all
        self._gone: set[int] = set()  # edges that it has, but should not
        self._lost: set[int] = set()  # poses that it has, but should not

    def add(self, edge: Edge, loop: Loop | None = None) -> int:
        """The number of the new edge; with a loop, it may be false."""
        number, self._next = self._next, self._next + 1
        self.edges[number] = edge
        self._fresh.add(number)
        if loop is not None:
            self.loops[number] = loop
        for end in (edge.a, edge.b):
            self._touching.setdefault(end, set()).add(number)
        self.roads.add(edge)
        return number

    def remove(self, number: int) -> None:
        edge = self.edges.pop(number)
        self.loops.pop(number, None)
        for end in (edge.a, edge.b):
            self._touching[end].discard(number)
        self.roads.remove(edge)
        if number in self._fresh:
            self._fresh.discard(number)
        else:
            self._gone.add(number)

    def touching(self, pose: int) -> list[int]:
        """Edges that end there, oldest first."""
        return sorted(self._touching.get(pose, ()))

    def moved(self, poses: Iterable[int]) -> None:
        """These lie elsewhere than the solver would think."""
        self._moved.update(poses)

    def forget(self, pose: int) -> None:
        """A pose without edges goes."""
        self._touching.pop(pose, None)
        self._moved.discard(pose)
        if pose in self._known:
            self._known.discard(pose)
            self._lost.add(pose)

    def news(self, poses: Mapping[int, F64], plumb: Mapping[int, F64]) -> Change:
        """All that the solver has not been told yet; it is taken as told. poses: of all numbers, as is
        plumb (`share.graph.plumb`)."""
        edges = [(n, self.edges[n], n in self.loops) for n in sorted(self._fresh)]
        change = Change.of(
            {number: poses[number] for number in sorted(self._moved)},
            edges,
            sorted(self._gone),
            sorted(self._lost),
            plumb,
        )
        self.anew = False
        self._known |= self._moved
        for done in (self._fresh, self._moved, self._gone, self._lost):
            done.clear()
        return change

    def untold(self) -> None:
        """The solver has lost everything."""
        self.anew = True
        self._fresh = set(self.edges)
        self._moved |= self._known
        for nothing in (self._known, self._gone, self._lost):
            nothing.clear()
