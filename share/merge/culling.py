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
from enum import Enum, auto

import numpy as np

from share.config import MergeConfig
from share.merge.bridges import bridging
from share.merge.chart import Chart
from share.merge.owners import Owners, dues
from share.merge.thinning import redundant

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
