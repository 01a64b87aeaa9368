"""How surely the map knows where each agent's odometry lies in it, and whether he hears of it.

Who comes into another's map is not told where he is there while that is known badly. A join by a few loops at
one spot can be turned by degrees, which further loops put right within seconds; until then his own map
goes on. Those who were in one map together hear of the new one together. Nobody waits for more than a few
loops of his own: in a large hall, far from where its map began, nothing is known to a few centimetres.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from share.types import F64


@dataclass(frozen=True, eq=False)
class Found:
    """cov (6, 6): of T_map_odom. spread_m: 1 sigma (root of the trace) of where the agent is. answered: a
    loop of his own is new in this solution."""

    cov: F64
    spread_m: float
    answered: bool


class Surety:
    """Of stretches, by their numbers; maps by their founders'."""

    def __init__(self, enter_m: float, patience: int) -> None:
        """enter_m: who is known worse than this waits before another's map, for so many loops of his own."""
        self._enter_m, self._patience = enter_m, patience
        self._told: dict[int, tuple[int, F64]] = {}  # the founder of the map he was told of, and cov there
        self._waited: Counter[tuple[int, int]] = Counter()  # loops, of those from one map before another

    def told(self, stretch: int, founder: int) -> F64 | None:
        """cov (6, 6) of T_map_odom, as last found; None if he has not heard of this map."""
        known, cov = self._told.get(stretch, (None, None))
        return cov if known == founder else None

    def take(self, founder: int, found: Mapping[int, Found]) -> dict[int, float]:
        """What a solution of a map says of those whom it was asked for. Returns who waits: his spread, m."""
        entering: dict[int, list[int]] = {}
        for s in found:
            if s != founder and self.told(s, founder) is None:
                entering.setdefault(self._told[s][0] if s in self._told else s, []).append(s)
        waiting = [
            s for before, who in entering.items() if self._wait(before, founder, found, who) for s in who
        ]
        self._told |= {s: (founder, at.cov) for s, at in found.items() if s not in waiting}
        return {s: found[s].spread_m for s in waiting}

    def _wait(self, before: int, founder: int, found: Mapping[int, Found], who: list[int]) -> bool:
        """Those who come from one map; counted."""
        if max(found[s].spread_m for s in who) <= self._enter_m:
            return False
        self._waited[before, founder] += any(found[s].answered for s in who)
        return self._waited[before, founder] <= self._patience
