"""Whether the room can serve one more agent: how long keyframes would then take on the air.

All send at their least rates; beyond what headsets tolerate nothing is left to yield. Only the air counts:
an agent that is slow or far away is late whoever else is there. Robots leave first: a headset that finds no
room takes the place of robots, and is refused where that is not enough.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

from share.scheduling.rate_allocation import MAX_LOAD
from share.scheduling.room_budget import SMALL_SIZE, RoomBudget, min_load
from share.timing import seconds_to_ns
from share.types import AgentKind

TOLERATED_DELAY_MS = 200.0  # of a headset's corrections; more is shown as its trouble
TOLERATED_AIR_MS = TOLERATED_DELAY_MS - 60.0  # the air's part: the rest is what they take on ample air
_MIN_REPORTS = 2  # agents: the report of a single one refuses nobody
_MAX_TOLD_MS = 10_000.0  # a longer time is not told in ms
_SETTLED_S = 10.0  # for which the room must have been full: pauses of the edge or of the air do not count


@dataclass(frozen=True)
class RoomCapacity:
    """Capacity at the last check. air_ms: how long a keyframe would take on the air with one more agent, by
    its form. full_since_ns: since when that has been too much. leaving: robots that would make room for
    one more headset, by name, the newest first; leaving_since_ns: since when there have been any."""

    air_ms: Mapping[AgentKind, float] = field(default_factory=dict)
    full_since_ns: Mapping[AgentKind, int] = field(default_factory=dict)
    leaving: tuple[str, ...] = ()
    leaving_since_ns: int | None = None

    def reassess(self, budget: RoomBudget, now_ns: int) -> RoomCapacity:
        """Return what the room can take now."""
        robots = [name for name, one in budget.agents.items() if one.qoe.form is AgentKind.ROBOT]
        has_headset = len(robots) < len(budget.agents)
        leaving = list[str]()
        headset_ms = crowded_air_ms(budget, AgentKind.AR)
        while headset_ms > TOLERATED_AIR_MS and robots:
            leaving.append(robots.pop())
            headset_ms = crowded_air_ms(budget, AgentKind.AR, leaving)
        robot_ms = crowded_air_ms(budget, AgentKind.ROBOT) if has_headset else 0.0
        air_ms = {AgentKind.AR: headset_ms, AgentKind.ROBOT: robot_ms}
        if headset_ms > TOLERATED_AIR_MS:
            leaving.clear()  # it would not be enough
        full_since_ns = {
            form: self.full_since_ns.get(form, now_ns) for form, ms in air_ms.items() if ms > TOLERATED_AIR_MS
        }
        before_ns = now_ns if self.leaving_since_ns is None else self.leaving_since_ns
        return RoomCapacity(air_ms, full_since_ns, tuple(leaving), before_ns if leaving else None)

    def objection(self, form: AgentKind, now_ns: int) -> str | None:
        """Return why the room cannot serve one more agent of a form, for a person; None if it can."""
        if not _is_settled(self.full_since_ns.get(form), now_ns):
            return None
        ms = self.air_ms[form]
        how_long = f"{ms:.0f} ms" if ms < _MAX_TOLD_MS else "seconds"
        return (
            f"no air for one more agent: a keyframe would take {how_long}, {TOLERATED_AIR_MS:.0f} ms at most"
        )

    def displaced(self, form: AgentKind, now_ns: int) -> tuple[str, ...]:
        """Return the robots that have to leave for one more agent of a form."""
        is_crowded = form is AgentKind.AR and _is_settled(self.leaving_since_ns, now_ns)
        return self.leaving if is_crowded else ()


def crowded_air_ms(budget: RoomBudget, joining: AgentKind, leaving: Collection[str] = ()) -> float:
    """Return how long a keyframe takes on the air, T / (1 - load), once one agent has joined and others have
    left, all at their least rates, with small pictures; inf beyond what the air carries, 0 where too few know
    the air."""
    if len(budget.agents) < _MIN_REPORTS:
        return 0.0
    staying = [agent.qoe.form for name, agent in budget.agents.items() if name not in leaving]
    airtime_s = _lower_quartile(
        SMALL_SIZE * budget.airtime_s(agent) / agent.size for agent in budget.agents.values()
    )
    load = sum(min_load(form, airtime_s) for form in [joining, *staying])
    return math.inf if load >= MAX_LOAD else 1e3 * airtime_s / (1 - load)


def _lower_quartile(values: Iterable[float]) -> float:
    """Return what three quarters of the agents report or exceed: few false reports remove none."""
    ordered = sorted(values)
    return ordered[(len(ordered) - 1) // 4]


def _is_settled(since_ns: int | None, now_ns: int) -> bool:
    return since_ns is not None and now_ns - since_ns >= seconds_to_ns(_SETTLED_S)
