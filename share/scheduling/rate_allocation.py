"""Allocates scarce airtime to agents: rates in small steps, each to the agent with the largest QoE gain for
its airtime.

A QoE is a factor of the delay, the same for all rates of an agent, times a factor of the error, which depends
on the agent's own rate only (`share.scheduling.qoe`). So the gain of a step is an entry of a table made once,
times the delay's factor at the present load. One table serves several waits, since what is allocated before
the first limit is the same for each longer wait.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.scheduling.qoe import QoeTable
from share.types import F64

STEP_HZ = 0.25  # in which rates are allocated, and rise again
JOINING_LOAD = 0.5  # for agents that share a map with nobody: keyframes take at most twice as long as alone
MAX_LOAD = 0.95  # beyond, the formula has no meaning
_KEEP_RATIO = 1.5  # by which a step must gain another agent more than the one that has it
_LOAD_STEP = 0.01
_MIN_AIRTIME_S = 1e-6
_SATISFIED = -1.0  # gain of an agent that has all it wants: less than any


@dataclass(frozen=True, eq=False)
class AirDemand:
    """What N agents want of the air that they share, arrays (N,).

    airtime_s: T, of a keyframe alone; median_airtime_s: of the room. message_load: of all small messages.
    weight: of an agent's QoE. other_delay_ms: the part of its delay that is not airtime. error_cm: NaN if
    unknown; drift_cm: the part of it that grows between keyframes, at measured_hz. held_hz: the rate that it
    has. is_placed: see `AgentDemand`.
    """

    qoe: QoeTable
    airtime_s: F64
    median_airtime_s: float
    message_load: float
    weight: F64
    min_hz: F64
    wanted_hz: F64
    held_hz: F64
    other_delay_ms: F64
    error_cm: F64
    drift_cm: F64
    measured_hz: F64
    is_placed: NDArray[np.bool_]

    def load(self, hz: F64) -> float:
        """Return the load at these rates, at most MAX_LOAD."""
        return min(MAX_LOAD, self.message_load + float(hz @ self.airtime_s))


def load_of_wait(median_airtime_s: float, wait_ms: float) -> float:
    """Return the load at which a keyframe waits T / (1 - load) - T = `wait_ms` for others; inf if never."""
    load = wait_ms / (1e3 * median_airtime_s + wait_ms)
    return load if load < MAX_LOAD else math.inf


def allocate_rates(demand: AirDemand, waits_ms: Sequence[float]) -> list[F64]:
    """Return the rates (N,), Hz, for each of `waits_ms`, which rise.

    All begin at their least rates; each further step goes to the agent that gains most by it. While keyframes
    wait less than `wait_ms` for others, agents of the AR form come first. Beyond that only they get steps
    (all agents if there are none of them), and a step must gain more QoE than the delay that it adds costs
    all. Agents that share a map with nobody get what is left up to `JOINING_LOAD`: any of their keyframes may
    be the one that is recognised.
    """
    if not len(demand.wanted_hz):
        return [np.zeros(0) for _ in waits_ms]
    is_ar = demand.qoe.is_ar
    joining = np.flatnonzero(~demand.is_placed)
    groups = [np.flatnonzero(of_form) for of_form in (is_ar, ~is_ar) if of_form.any()]
    shared, allocated = _Allocation.least(_GainTable(demand)), list[F64]()
    for wait_ms in waits_ms:
        limit = load_of_wait(demand.median_airtime_s, wait_ms)
        for group in groups:
            if not shared.fill(group, limit, only_while_all_fit=True):
                break
        own = shared.copy()
        for group in groups:
            own.fill(group, limit)
        own.fill_while_worth_it(groups[0])
        if len(joining):
            own.fill(joining, JOINING_LOAD)
        allocated.append(own.hz)
    return allocated


class _GainTable:
    """QoE of N agents by number of steps above the least rate, without its factor of the delay.

    rates_hz (N, K): rates. worth (N, K): what one more step gains for its load, `_SATISFIED` where it is not
    wanted. error_factor (N, K): weighted."""

    def __init__(self, demand: AirDemand) -> None:
        self.demand, self.step_load = demand, STEP_HZ * demand.airtime_s
        self.rates_hz = _rates_above(demand.min_hz, demand.wanted_hz)
        growth = demand.measured_hz[:, None] / np.maximum(self.rates_hz, 1e-3) - 1  # a random walk
        error_cm = np.sqrt(demand.error_cm[:, None] ** 2 + demand.drift_cm[:, None] ** 2 * growth)
        self.error_factor = demand.weight[:, None] * demand.qoe.error_factor(error_cm.T).T
        steps_hz = self.rates_hz[:, 1:]
        self.worth = np.full(self.rates_hz.shape, _SATISFIED)
        self.worth[:, :-1] = np.where(
            steps_hz <= demand.wanted_hz[:, None],
            np.diff(self.error_factor)
            / np.maximum(demand.airtime_s, _MIN_AIRTIME_S)[:, None]
            * np.where(steps_hz <= demand.held_hz[:, None], _KEEP_RATIO, 1.0),
            _SATISFIED,
        )

    def delay_factor(self, load: float) -> F64:
        """Return the factor of the QoE due to delay of each agent (N,), at a load of the air."""
        demand = self.demand
        return demand.qoe.delay_factor(demand.other_delay_ms + 1e3 * demand.airtime_s / (1 - load))


def _rates_above(min_hz: F64, wanted_hz: F64) -> F64:
    """Return the rates (N, K) by number of steps, up to the highest wanted one and one beyond. Steps are
    added one by one, so that a rate compares equal to the one that was granted."""
    count = 1 + max(0, math.floor(float((wanted_hz - min_hz).max()) / STEP_HZ))
    steps = np.full((len(min_hz), count + 1), STEP_HZ)
    steps[:, 0] = min_hz
    return np.cumsum(steps, axis=1)


class _Allocation:
    """Rates while they are allocated: how many steps each agent has, and the load by them."""

    def __init__(self, table: _GainTable, steps: NDArray[np.intp], load: float) -> None:
        self._table, self._steps, self._load = table, steps, load

    @classmethod
    def least(cls, table: _GainTable) -> _Allocation:
        demand = table.demand
        return cls(table, np.zeros(len(demand.min_hz), np.intp), demand.load(demand.min_hz))

    def copy(self) -> _Allocation:
        return _Allocation(self._table, self._steps.copy(), self._load)

    @property
    def hz(self) -> F64:
        return _at_steps(self._table.rates_hz, self._steps)

    def fill(self, group: NDArray[np.intp], limit: float, only_while_all_fit: bool = False) -> bool:
        """Give out steps to these agents up to a load. Return whether all have what they want."""
        step_load, worth = self._table.step_load[group], _at_steps(self._table.worth, self._steps)[group]
        while self._load < MAX_LOAD:
            fits = self._load + float(step_load.max()) <= limit
            if not fits and only_while_all_fit:
                return False
            gains = self._table.delay_factor(self._load)[group] * worth
            best = int(gains.argmax())
            if not fits or gains[best] <= 0:
                is_open = worth != _SATISFIED
                if not is_open.any():
                    return True
                is_free = is_open & (self._load + step_load <= limit)
                if not is_free.any():
                    return False
                best = int(np.where(is_free, gains, -np.inf).argmax())
            worth[best] = self._give(group[best])
        return False

    def fill_while_worth_it(self, group: NDArray[np.intp]) -> None:
        """Give out steps to these agents that gain more than the delay that they cause costs all."""
        worth = _at_steps(self._table.worth, self._steps)[group]
        while self._load < MAX_LOAD:
            gains = self._table.delay_factor(self._load)[group] * worth
            best = int(gains.argmax())
            if gains[best] <= STEP_HZ * self._cost():
                return
            worth[best] = self._give(group[best])

    def _give(self, agent: np.intp) -> float:
        """Give a step to an agent. Return what the next one is worth."""
        self._steps[agent] += 1
        self._load = min(MAX_LOAD, self._load + float(self._table.step_load[agent]))
        return float(self._table.worth[agent, self._steps[agent]])

    def _cost(self) -> float:
        """Return the QoE, weighted, that all agents together lose by a load of one more."""
        now, more = (self._table.delay_factor(load) for load in (self._load, self._load + _LOAD_STEP))
        return float(_at_steps(self._table.error_factor, self._steps) @ (now - more)) / _LOAD_STEP


def _at_steps(table: F64, steps: NDArray[np.intp]) -> F64:
    """Return of each row (N, K) the entry of its agent's steps (N,)."""
    return table[np.arange(len(steps)), steps]
