"""Allocates the room's air in the plainest way: before each step all gains anew, by the QoE itself."""

from __future__ import annotations

import math

from share.scheduling.qoe import qoe
from share.scheduling.room_budget import OTHER_HZ, SCARCE_POSE_HZ, AgentDemand, RoomBudget, message_s
from share.types import AgentKind

STEP_HZ, LOAD_STEP, MAX_LOAD, HELD, JOINING_LOAD = 0.25, 0.01, 0.95, 1.5, 0.5
WEIGHT = {AgentKind.AR: 1.0, AgentKind.ROBOT: 0.25}


class StepwiseAllocation:
    """What every agent of a room may send, Hz by name. held_hz: what it has."""

    def __init__(self, budget: RoomBudget, held_hz: dict[str, float]) -> None:
        self._budget, self._agents, self._held_hz = budget, budget.agents, held_hz
        self._airtime_s = {name: budget.airtime_s(one) for name, one in budget.agents.items()}
        other_ms = budget.other_delays_ms().tolist()
        self._other_delay_ms = dict(zip(budget.agents, other_ms, strict=True))
        forms = {one.qoe.form for one in self._agents.values()}
        self._first_form = AgentKind.AR if AgentKind.AR in forms else AgentKind.ROBOT

    def rates(self, wait_ms: float) -> dict[str, float]:
        hz = {name: one.min_hz for name, one in self._agents.items()}
        while (load := self._load(hz)) < MAX_LOAD:
            is_open = [n for n, one in self._agents.items() if hz[n] + STEP_HZ <= one.wanted_hz]
            free = [n for n in is_open if not self._waits(load + STEP_HZ * self._airtime_s[n], wait_ms)]
            gain = {n: self._gain(n, hz[n], load) for n in is_open}
            steps = [n for n in free if self._is_first(n)] or free
            if not steps:
                cost = STEP_HZ * self._cost(hz, load)
                steps = [n for n in is_open if self._is_first(n) and gain[n] > cost]
            if not steps:
                steps = [n for n in is_open if self._is_joining(n, load)]
            if not steps:
                break
            hz[max(steps, key=lambda n: gain[n])] += STEP_HZ
        return hz

    def _is_first(self, name: str) -> bool:
        return self._agents[name].qoe.form is self._first_form

    def _is_joining(self, name: str, load: float) -> bool:
        """Whether an agent that shares a map with nobody gets one more step."""
        return not self._agents[name].is_placed and load + STEP_HZ * self._airtime_s[name] <= JOINING_LOAD

    def _load(self, hz: dict[str, float]) -> float:
        messages = sum(
            (SCARCE_POSE_HZ[one.qoe.form] + OTHER_HZ) * message_s(self._airtime_s[n], one.size)
            for n, one in self._agents.items()
        )
        return min(MAX_LOAD, messages + sum(hz[n] * self._airtime_s[n] for n in hz))

    def _waits(self, load: float, wait_ms: float) -> bool:
        part = min(MAX_LOAD, load)
        return 1e3 * (self._budget.median_airtime_s or 0.0) * part / (1 - part) > wait_ms

    def _gain(self, name: str, hz: float, load: float) -> float:
        gain = self._qoe(name, hz + STEP_HZ, load) - self._qoe(name, hz, load)
        held = HELD if hz + STEP_HZ <= self._held_hz.get(name, 0.0) else 1.0
        return held * gain / max(self._airtime_s[name], 1e-6)

    def _cost(self, hz: dict[str, float], load: float) -> float:
        lost = (self._qoe(n, hz[n], load) - self._qoe(n, hz[n], load + LOAD_STEP) for n in hz)
        return sum(lost) / LOAD_STEP

    def _qoe(self, name: str, hz: float, load: float) -> float:
        """Return an agent's QoE, weighted, by its rate and the load of the air."""
        one = self._agents[name]
        delay_ms = self._other_delay_ms[name] + 1e3 * self._airtime_s[name] / (1 - load)
        return WEIGHT[one.qoe.form] * qoe(delay_ms, _error_cm(one, hz), one.qoe)


def _error_cm(one: AgentDemand, hz: float) -> float | None:
    if one.error_cm is None:
        return None
    growth = max(one.hz, 1e-3) / max(hz, 1e-3) - 1
    return math.sqrt(one.error_cm**2 + min(one.drift_cm, one.error_cm) ** 2 * growth)
