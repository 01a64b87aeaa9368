"""Which keyframes go where there are too many: fair between names, and what is over before what goes on.

The unit is the name, not the run: nobody has more by starting again and again. Of a name that has to give
go, in this order: what looks like another keyframe in maps that are over, the same in the others, whole maps
that are over, the smallest first, and then what is most alike. A map is over where nobody walks in it any
more and only one name ever did.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from share.config import MergeConfig
from share.merge.bridges import bridging
from share.merge.chart import Chart
from share.merge.owners import Owners, dues
from share.merge.thinning import redundant

_ALIKE = 1.0  # nearer than this in the measure of `redundant` two keyframes are of one place


class Culling:
    """Of one chart."""

    def __init__(self, config: MergeConfig, chart: Chart, owners: Owners) -> None:
        self._config, self._chart, self._owners = config, chart, owners

    def choose(self, count: int) -> list[int]:
        """Numbers of so many keyframes, if there are as many that may go. The newest of a run that is away
        stay for its return, unless there is no other way."""
        chosen = self._chosen(count, return_expected=True)
        return chosen if len(chosen) >= count else self._chosen(count, return_expected=False)

    def may_go(self, number: int) -> bool:
        """Whether a keyframe can be taken out now."""
        chart = self._chart
        stretch = chart.trails.nodes[number].stretch
        nodes, founder = chart.trails.stretches[stretch].nodes, chart.founder[stretch]
        if self._walks(stretch, return_expected=False) and number in nodes[-self._config.min_loop_gap :]:
            return False
        if self._is_over(chart.stretches_of(founder)):
            return True
        return number != chart.anchor(founder) and (len(nodes) > 1 or stretch not in bridging(chart.bonds))

    def _chosen(self, count: int, return_expected: bool) -> list[int]:
        maps = self._maps()
        over = [founder for founder, stretches in maps.items() if self._is_over(stretches)]
        others = [founder for founder in maps if founder not in set(over)]
        stay = self._staying(others, return_expected)
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
        return dues(held, free, count, self._owners.heard_of())

    def _staying(self, founders: Iterable[int], return_expected: bool) -> set[int]:
        """The newest of every agent that walks on, and of these maps what holds their gauge, or them
        together."""
        chart, trails = self._chart, self._chart.trails
        out = {chart.anchor(founder) for founder in founders}
        for stretch in trails.live:
            if self._walks(stretch, return_expected):
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

    def _is_over(self, stretches: Sequence[int]) -> bool:
        """Whether nobody walks in the map of these any more and only one name ever did."""
        agents = {self._chart.trails.stretches[s].agent for s in stretches}
        return len(set(map(self._owners.name, agents))) == 1 and not any(
            self._walks(s, return_expected=True) for s in stretches
        )

    def _walks(self, stretch: int, return_expected: bool) -> bool:
        """Whether keyframes come to this stretch; return_expected: or would if its agent came back, which has
        not begun another run."""
        agent, owners = self._chart.trails.stretches[stretch].agent, self._owners
        here = not (owners.is_ended(agent) if return_expected else owners.is_absent(agent))
        return here and self._chart.trails.current(agent) == stretch

    def _name(self, number: int) -> str:
        return self._owners.name(self._chart.trails.nodes[number].key.agent)
