"""Which keyframes go where there are too many: fair between names, and what is over before what goes on.

The unit is the name, not the run: nobody has more by starting again and again. All names that are away count
as one beside those that are heard: any number of them takes no more of these than one would. Of a name that
has to give go, in this order: what looks like another keyframe in maps that are over, the same in the others,
whole maps that are over, the smallest first, and then what is most alike. A map is over where nobody walks in
it any more and only one name ever did.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from share.config import MergeConfig
from share.geometry import se3
from share.mapping.graph.edges import Edge
from share.mapping.graph.updates import contract
from share.mapping.loop_consistency import bridging
from share.mapping.loops import Key, Loop
from share.mapping.map_graph import Chart
from share.mapping.segments import Node, Owners, dues
from share.types import F64, Keyframe

# ---- Fewer keyframes, the same room: those that show what others show as well are taken out.
#
# What is left covers the same views; odometry and loops of a keyframe that goes are moved to its neighbour
# (`share.mapping.graph.updates`), so what was known stays known, a little less surely.

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


_AWAY = ""  # no name
_ALIKE = 1.0  # nearer than this in the measure of `redundant` two keyframes are of one place


class Awaited(Enum):
    """What stays for the return of who is away, the most first: its newest keyframes, and something of its
    map; only this; nothing."""

    WITH_PLACES = auto()
    IN_MAPS = auto()
    NOBODY = auto()


class Culling:
    """Of one chart."""

    def __init__(self, config: MergeConfig, chart: Chart, owners: Owners) -> None:
        self._config, self._chart, self._owners = config, chart, owners

    def choose(self, count: int) -> list[int]:
        """Numbers of so many keyframes, if there are as many that may go. The newest of a run that is away
        stay for its return, and something of a map in which nobody is heard, if there is another way."""
        for awaited in Awaited:
            if len(chosen := self._chosen(count, awaited)) >= count:
                break
        return chosen

    def may_go(self, number: int) -> bool:
        """Whether a keyframe can be taken out now."""
        chart = self._chart
        stretch = chart.trails.nodes[number].stretch
        nodes, founder = chart.trails.stretches[stretch].nodes, chart.founder[stretch]
        if self._walks(stretch, Awaited.NOBODY) and number in nodes[-self._config.min_loop_gap :]:
            return False
        if self._is_over(chart.stretches_of(founder), Awaited.NOBODY):
            return True
        return number != chart.anchor(founder) and (len(nodes) > 1 or stretch not in bridging(chart.bonds))

    def _chosen(self, count: int, awaited: Awaited) -> list[int]:
        maps = self._maps()
        over = [founder for founder, stretches in maps.items() if self._is_over(stretches, awaited)]
        others = [founder for founder in maps if founder not in set(over)]
        stay = self._staying(others, awaited)
        due, out = self._due(count, stay), dict[int, None]()
        for founders, below in ((over, _ALIKE), (others, _ALIKE)):
            for founder in founders:
                self._thin(maps[founder], stay, due, out, below)
        for founder in (*reversed(over), *others):
            self._thin(maps[founder], stay, due, out)
        return list(out)

    def _thin(
        self,
        stretches: Sequence[int],
        stay: set[int],
        due: Counter[str],
        out: dict[int, None],
        below: float = np.inf,
    ) -> None:
        """Into `out`, of one map and those that may go, as many of each name as are due, while two are more
        alike than `below`."""
        chart, c = self._chart, self._config
        numbers = [n for s in stretches for n in chart.trails.stretches[s].nodes if n not in out]
        whose = [None if n in stay else self._name(n) for n in numbers]
        if any(name is not None and due[name] for name in whose):
            poses = np.array([chart.poses[n] for n in numbers])
            gone = redundant(poses, whose, due, c.place_m, c.place_rad, below)
            out |= dict.fromkeys(numbers[i] for i in gone)

    def _due(self, count: int, stay: set[int]) -> Counter[str]:
        """How many keyframes each name gives."""
        held = Counter(map(self._name, self._chart.poses))
        free = Counter(self._name(n) for n in self._chart.poses if n not in stay)
        owners, heard_of = self._owners, self._owners.heard_of()
        away = {name for name in held if owners.is_away(name)}
        least = (held.total() - count) // (len(held.keys() - away) + 1) if away else 0
        for name in held.keys() - away:
            free[name] = min(free[name], max(0, held[name] - least))

        def of_all(counts: Counter[str]) -> Counter[str]:
            here = Counter({name: n for name, n in counts.items() if name not in away})
            here[_AWAY] = sum(counts[name] for name in away)
            return here

        out = dues(of_all(held), of_all(free), count, heard_of)
        held, free = (Counter({name: counts[name] for name in away}) for counts in (held, free))
        return out + dues(held, free, out.pop(_AWAY, 0), heard_of)

    def _staying(self, founders: Iterable[int], awaited: Awaited) -> set[int]:
        """The newest of every agent that walks on, and of these maps what holds their gauge, or them
        together."""
        chart, trails = self._chart, self._chart.trails
        out = {chart.anchor(founder) for founder in founders}
        for stretch in trails.live:
            if self._walks(stretch, awaited):
                out.update(trails.stretches[stretch].nodes[-self._config.min_loop_gap :])
        for stretch in bridging(chart.bonds):
            nodes = trails.stretches[stretch].nodes
            out.add(max(nodes, key=lambda n: len(chart.ties.touching(n))))
        return out

    def _maps(self) -> dict[int, list[int]]:
        """Stretches by the founder of their map, the largest map first; of maps alike the newest."""
        chart, maps = self._chart, dict[int, list[int]]()
        for stretch in sorted(chart.trails.live, reverse=True):
            maps.setdefault(chart.founder[stretch], []).append(stretch)
        return dict(sorted(maps.items(), key=lambda one: -sum(map(self._size, one[1]))))

    def _size(self, stretch: int) -> int:
        return len(self._chart.trails.stretches[stretch].nodes)

    def _is_over(self, stretches: Sequence[int], awaited: Awaited) -> bool:
        """Whether nobody walks in the map of these any more and only one name ever did."""
        agents = {self._chart.trails.stretches[s].agent for s in stretches}
        if awaited is Awaited.IN_MAPS:
            awaited = Awaited.WITH_PLACES
        alone = awaited is Awaited.NOBODY or len(set(map(self._owners.name, agents))) == 1
        return alone and not any(self._walks(s, awaited) for s in stretches)

    def _walks(self, stretch: int, awaited: Awaited) -> bool:
        """Whether keyframes come to this stretch, or would if its agent came back and is awaited, which has
        not begun another run."""
        agent, owners = self._chart.trails.stretches[stretch].agent, self._owners
        away = owners.is_ended if awaited is Awaited.WITH_PLACES else owners.is_absent
        return not away(agent) and self._chart.trails.current(agent) == stretch

    def _name(self, number: int) -> str:
        return self._owners.name(self._chart.trails.nodes[number].key.agent)
