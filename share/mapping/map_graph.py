"""Where everything lies: poses by map, the edges between them, and which stretches are one map.

A map is a set of stretches that loops connect; it is named after its founder, the first to have come of
those of the least rank. The founder's oldest keyframe stays where its odometry says: that
is the gauge. Maps are derived from the loops alone, so taking a loop back takes its join back.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from share.geometry import se3
from share.mapping.graph.covariance import Roads
from share.mapping.graph.edges import Edge
from share.mapping.graph.updates import Change
from share.mapping.loops import Key, Known, Loop
from share.mapping.segments import Trails
from share.types import F64, Keyframe

# ---- The edges of the pose graph by number, and what of it the solver does not know yet.


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
        plumb (`share.mapping.graph.edges`)."""
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


def shortened(T: F64, log: float) -> F64:
    """T (4, 4) whose way was too long by this."""
    return se3.compose(T[:3, :3], T[:3, 3] * np.exp(-log)) if log else T


class Chart:
    """poses: T_map_body (4, 4) of every node, by its number. plumb: which way is up there, if it is known
    (`share.mapping.graph.edges`). founder: of the map of each stretch. parted: stretches that were left in
    another map when loops were taken back, since somebody last asked. scale: log of what each agent's
    odometry is shortened by; width: by what its variances are multiplied; nothing where it is not there."""

    def __init__(self) -> None:
        self.trails = Trails()
        self.ties = Ties()
        self.poses: dict[int, F64] = {}
        self.plumb: dict[int, F64] = {}
        self.founder: list[int] = []
        self.parted: set[int] = set()
        self.bonds: Counter[tuple[int, int]] = Counter()  # loops by the two stretches that they tie
        self.scale: dict[str, float] = {}
        self.width: dict[str, float] = {}
        self.unsolved: dict[int, None] = {}  # founders of maps with news, the oldest first

    def add(self, agent: str, keyframe: Keyframe, cov: F64, plumb: F64, rank: int = 0) -> int:
        """The number of the new node. cov (6, 6): of its step from the one before, as it is believed; so is
        plumb (3,). rank: of a stretch that it begins."""
        number = self.trails.add(agent, keyframe, rank)
        self.place(number, keyframe.T_ref_body, cov, plumb)
        return number

    def place(self, number: int, T_ref_body: F64, cov: F64, plumb: F64) -> None:
        """Give a new node its pose, by odometry as its agent told it, and tie it to the one before it, if
        there is one."""
        node, before = self.trails.nodes[number], self.trails.before(number)
        agent = self.trails.stretches[node.stretch].agent
        T_ref_body = shortened(T_ref_body, self.scale.get(agent, 0.0))
        self.founder += range(len(self.founder), len(self.trails.stretches))
        if before is None:
            self.poses[number] = node.T_odom_body
        else:
            self.ties.add(Edge(before, number, T_ref_body, cov * self.width.get(agent, 1.0)))
            self.poses[number] = se3.orthonormal(self.poses[before] @ T_ref_body)
        if plumb.any():
            self.plumb[number] = plumb
        self.ties.moved([number])

    def forget(self, number: int) -> None:
        """A node without edges goes."""
        self.ties.forget(number)
        self.trails.take_out(number)
        del self.poses[number]
        self.plumb.pop(number, None)

    # ------------------------------------------------------------ changes

    def tie(self, loop: Loop) -> None:
        """Two maps that it ties are one from now on."""
        a, b = self.ends(loop)
        self.bind(Edge(a, b, loop.T_a_b, loop.cov), loop)
        if not self.same_map(a, b):
            self.find_maps()
        self.unsolved = dict.fromkeys([*(self.founder[f] for f in self.unsolved), self.founder_of(loop.a)])

    def bind(self, edge: Edge, loop: Loop) -> None:
        """A loop as an edge; if it ties what no other does, `find_maps` is due."""
        self.ties.add(edge, loop)
        self.bonds[self.bond(edge)] += 1

    def unbind(self, number: int) -> None:
        """Take a loop's edge out; if it was the last of its bond, `find_maps` is due."""
        bond = self.bond(self.ties.edges[number])
        self.bonds[bond] -= 1
        if not self.bonds[bond]:
            del self.bonds[bond]
        self.ties.remove(number)

    def drop(self, numbers: Sequence[int]) -> tuple[Loop, ...]:
        """Take loops, by their edges' numbers, back, and the joins that hung on them."""
        dropped = tuple(self.ties.loops[n] for n in numbers)
        touched = {self.founder_of(key) for loop in dropped for key in (loop.a, loop.b)}
        stretches = [s for founder in touched for s in self.stretches_of(founder)]
        for number in numbers:
            self.unbind(number)
        before = self.founder
        self.find_maps()
        self.parted |= {s for s in stretches if self.founder[s] != before[s]}
        for founder in sorted({self.founder[s] for s in stretches}):
            anchor = self.anchor(founder)
            self.move(founder, self.trails.nodes[anchor].T_odom_body @ se3.inverse(self.poses[anchor]))
            self.unsolved[founder] = None
        return dropped

    def lay_beside(self, loop: Loop) -> None:
        """Of the two maps that it would tie, move that of the lesser founder rigidly to where it says."""
        if self.rank(self.founder_of(loop.a)) > self.rank(self.founder_of(loop.b)):
            loop = loop.reverse()
        a, b = self.ends(loop)
        self.move(self.founder_of(loop.b), self.poses[a] @ loop.T_a_b @ se3.inverse(self.poses[b]))

    def move(self, founder: int, T: F64) -> None:
        """The whole map, rigidly, by T (4, 4) from the left."""
        numbers = self.nodes_of(founder)
        moved = se3.orthonormal(T @ np.array([self.poses[n] for n in numbers]))
        self.poses.update(zip(numbers, moved, strict=True))
        self.ties.moved(numbers)

    def rescale(self, agent: str, log: float, width: float) -> None:
        """All odometry of this agent is to be shortened by log, and its variances multiplied by width; its
        maps are due."""
        by, wider = log - self.scale.get(agent, 0.0), width / self.width.get(agent, 1.0)
        self.scale[agent], self.width[agent] = log, width
        for number, stretch in enumerate(self.trails.stretches):
            if stretch.agent != agent or not stretch.nodes:
                continue
            for before, after in itertools.pairwise(stretch.nodes):
                old, edge = self._step(before, after)
                self.ties.remove(old)
                self.ties.add(replace(edge, T_a_b=shortened(edge.T_a_b, by), cov=wider * edge.cov))
            self.unsolved.setdefault(self.founder[number])

    def follow(self, numbers: Iterable[int]) -> None:
        """These go where odometry takes them from the ones before them."""
        for number in numbers:
            before = self.trails.before(number)
            if before is not None:
                T = self.poses[before] @ self.step(before, number).T_a_b
                self.poses[number] = se3.orthonormal(T)

    # ------------------------------------------------------------ looking things up

    def ends(self, loop: Loop) -> tuple[int, int]:
        """The nodes of its keyframes. Raises ValueError if one is unknown."""
        return self.trails.number(loop.a), self.trails.number(loop.b)

    def step(self, before: int, number: int) -> Edge:
        """The odometry edge from a node to the next of its stretch."""
        _, edge = self._step(before, number)
        return edge if edge.a == before else edge.reverse()

    def _step(self, before: int, number: int) -> tuple[int, Edge]:
        for n in self.ties.touching(number):
            edge = self.ties.edges[n]
            if n not in self.ties.loops and before in (edge.a, edge.b):
                return n, edge
        raise ValueError(f"odometry does not lead from node {before} to {number}")

    def stretch_of(self, key: Key) -> int:
        return self.trails.nodes[self.trails.number(key)].stretch

    def founder_of(self, key: Key) -> int:
        return self.founder[self.stretch_of(key)]

    def same_map(self, a: int, b: int) -> bool:
        stretch_a, stretch_b = self.trails.nodes[a].stretch, self.trails.nodes[b].stretch
        return self.founder[stretch_a] == self.founder[stretch_b]

    def name(self, stretch: int) -> str:
        """Of the map that this stretch is in."""
        lost = stretch >= len(
            self.founder
        )  # of a damaged file that has none of its keyframes, nor later ones
        return self.trails.stretches[stretch if lost else self.founder[stretch]].name

    def named(self, map_id: str) -> int:
        """The founder of a map. Raises ValueError if there is none of that name."""
        for founder in {self.founder[stretch] for stretch in self.trails.live}:
            if self.trails.stretches[founder].name == map_id:
                return founder
        raise ValueError(f"there is no map {map_id}")

    def rank(self, stretch: int) -> tuple[int, int]:
        """Of the stretches of a map, the least founds it."""
        return self.trails.stretches[stretch].rank, stretch

    def stretches_of(self, founder: int) -> list[int]:
        """Those of a map that have keyframes, its founder first, if that has any."""
        return sorted((s for s in self.trails.live if self.founder[s] == founder), key=self.rank)

    def nodes_of(self, founder: int) -> list[int]:
        return [n for s in self.stretches_of(founder) for n in self.trails.stretches[s].nodes]

    def anchor(self, founder: int) -> int:
        """The keyframe that holds the gauge of a map."""
        return self.trails.stretches[founder].nodes[0]

    def placement(self, number: int) -> F64:
        """T_map_odom (4, 4) as this node has it."""
        T_odom_body = self.trails.nodes[number].T_odom_body
        return se3.orthonormal(self.poses[number] @ se3.inverse(T_odom_body))

    def lie(self, a: int, b: int) -> F64:
        """T_a_b (4, 4) of two nodes of a map."""
        return se3.inverse(self.poses[a]) @ self.poses[b]

    def between(self, a: int, goals: Sequence[int]) -> Known:
        """Poses (N, 4, 4) of the goals in node a of the same map, as the map has them now."""
        covs = self.ties.roads.known_from(a, goals, self.poses)
        for goal, cov in zip(goals, covs, strict=True):
            if cov is None:
                raise ValueError(f"nodes {a} and {goal} are not in one map")
        return Known(se3.inverse(self.poses[a]) @ np.array([self.poses[n] for n in goals]), np.array(covs))

    def bond(self, edge: Edge) -> tuple[int, int]:
        """The stretches at its ends, the older first."""
        a, b = (self.trails.nodes[end].stretch for end in (edge.a, edge.b))
        return (a, b) if a < b else (b, a)

    def find_maps(self) -> None:
        """Every stretch's founder, from the loops: the connected parts."""
        root = list(range(len(self.founder)))

        def find(i: int) -> int:
            while root[i] != i:
                i = root[i]
            return i

        for pair in self.bonds:
            low, high = sorted(map(find, pair), key=self.rank)
            root[high] = low
        self.founder = [find(i) for i in range(len(root))]
