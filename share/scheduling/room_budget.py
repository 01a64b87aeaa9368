"""The room's budget: what each agent may send where the air that all share is short.

The air is a server whose turns all agents share, so a keyframe that alone takes T s takes T / (1 - load)
(M/G/1 with processor sharing: L. Kleinrock, *Queueing Systems* II, 1976, section 4.4). T follows from what is
measured, A, the time that keyframes take, and what arrives a second: L keyframes, and M small messages of
c + k T each. The load is L T + M (c + k T), so T = A (1 - M c) / (1 + A (L + k M)). It does not depend on the
load, so rates that follow from it do not swing.

Where keyframes at the rates that all want would wait for each other for more than `FREE_WAIT_MS`, every agent
begins with its least rate. What is left goes in small steps to whom a step gains most for its air, as long
as they wait for less; then only where a step gains a headset more QoE than the delay that it causes costs
all. What a keyframe takes alone on slow air, no rate changes, so it does not count.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import median

import numpy as np
from numpy.typing import NDArray

from share.scheduling.qoe import QoeParameters, QoeTable
from share.types import F64, AgentKind

LEAST_HZ = {AgentKind.AR: 0.5, AgentKind.ROBOT: 0.2}  # by form: enough to stay placed; robots yield first
JOINING_HZ = 1.0  # Hz, of an agent that is alone in its map
SLOW_START_HZ = 2.0  # Hz, of an agent that sends its first keyframes
FREE_WAIT_MS = 5.0  # a quarter of the delay that a wearer notices
SCARCE_POSE_HZ = {AgentKind.AR: 5.0, AgentKind.ROBOT: 2.0}  # what draws them interpolates
_WEIGHT = {AgentKind.AR: 1.0, AgentKind.ROBOT: 0.25}  # of an agent's QoE, by form
# air of a small message: turn, preamble and acknowledgement, and its bytes as a part of a keyframe's
_MESSAGE_S, _MESSAGE_PART = 3e-4, 0.006
OTHER_HZ = (
    8.0  # small messages of an agent, both ways, that are no poses: pings, status, evaluations, answers
)
FULL_POSE_HZ = 30.0  # of an agent that sends one a frame
_LOAD_STEP = 0.01
MAX_LOAD = 0.95  # beyond, the formula has no meaning
STEP_HZ = 0.25  # in which rates are allocated, and rise again
_HELD = 1.5  # how much more a step must gain another agent than one that has it already
_TIME_CONSTANT_S = 5.0  # of measured times and rates: with 2 s rates swing where the air is just short
_MOST_RISE = 4.0  # of a measured time in one report: more is the edge's doing or the agent's, not the air's
_LEAST_AIR_S = 1e-3
_LEAST_AIR_PART = 0.75  # of the usual T: an agent takes at least this, since all share one air
SILENT_S = 3.0  # an agent that has not reported for so long takes no air


@dataclass(frozen=True)
class AgentAir:
    """What the room knows of one agent. wanted_hz: rate by its own QoE. keyframe_s: A. delay_ms, error_cm:
    as in `qoe`. drift_cm: part of the error that grows between keyframes. hz: rate of its keyframes, poses
    that it sends a second, both filtered. is_placed: it shares a map with somebody, or nobody is there."""

    terms: QoeParameters
    wanted_hz: float
    keyframe_s: float
    delay_ms: float
    error_cm: float | None
    drift_cm: float
    hz: float
    pose_hz: float
    updated_ns: int
    is_placed: bool = True

    @property
    def other_delay_ms(self) -> float:
        """Part of the delay that is not the air's, ms."""
        return max(0.0, self.delay_ms - 1e3 * self.keyframe_s)

    @property
    def messages_hz(self) -> float:
        """Its small messages a second."""
        return self.pose_hz + OTHER_HZ

    @property
    def least_hz(self) -> float:
        least_hz = LEAST_HZ[self.terms.form] if self.is_placed else JOINING_HZ
        return min(least_hz, self.wanted_hz)


@dataclass(frozen=True)
class RateGrant:
    """What an agent may send: keyframes and poses a second. pose_hz None: every pose."""

    hz: float
    pose_hz: float | None = None


@dataclass(frozen=True)
class RoomBudget:
    """State of the room: agents by name. Immutable: `with_report` returns the next one."""

    agents: Mapping[str, AgentAir] = field(default_factory=dict)

    def with_report(self, name: str, reported: AgentAir, before: AgentAir | None = None) -> RoomBudget:
        """Return the budget after an agent's report, whose keyframe_s, hz and pose_hz are filtered here.
        Agents that are silent are dropped. before: what was known of this one before it fell silent."""
        now_ns, before = reported.updated_ns, self.agents.get(name, before)
        if before is not None:
            elapsed_s = max(0.0, (now_ns - before.updated_ns) / 1e9)
            weight = -math.expm1(-elapsed_s / _TIME_CONSTANT_S)
            most_s = _MOST_RISE * max(before.keyframe_s, _LEAST_AIR_S)
            reported = replace(reported, keyframe_s=min(reported.keyframe_s, most_s))
            reported = replace(
                reported,
                **{
                    key: getattr(before, key) + weight * (getattr(reported, key) - getattr(before, key))
                    for key in ("keyframe_s", "hz", "pose_hz")
                },
            )
        present = {n: a for n, a in self.agents.items() if now_ns - a.updated_ns < SILENT_S * 1e9}
        return RoomBudget({**present, name: reported})

    def without(self, name: str) -> RoomBudget:
        """Return the budget of a room that an agent has left."""
        return RoomBudget({n: a for n, a in self.agents.items() if n != name})

    def air_s(self, agent: AgentAir) -> float:
        """Return T of an agent, s: at least a part of what is usual, since all share the air."""
        return max(self._own_air_s(agent), _LEAST_AIR_PART * (self.usual_air_s or 0.0))

    def _own_air_s(self, agent: AgentAir) -> float:
        """Return T of an agent by its own report, s."""
        return agent.keyframe_s * self._idle / (1 + agent.keyframe_s * self._keyframes_hz)

    @property
    def load(self) -> float:
        """Part of the air in use, at most MAX_LOAD."""
        usual_s = self.usual_air_s or 0.0
        return min(MAX_LOAD, 1 - self._idle + usual_s * self._keyframes_hz)

    @cached_property
    def _keyframes_hz(self) -> float:
        """L + k M."""
        return sum(a.hz + _MESSAGE_PART * a.messages_hz for a in self.agents.values())

    @cached_property
    def _idle(self) -> float:
        """1 - M c, bounded where an agent claims what no air carries."""
        return max(1 - MAX_LOAD, 1 - _MESSAGE_S * sum(a.messages_hz for a in self.agents.values()))

    @cached_property
    def usual_air_s(self) -> float | None:
        """T in the median of all agents, s: that of one is noisy, or false; of two the lesser. None without
        an agent."""
        times = [self._own_air_s(agent) for agent in self.agents.values()]
        return None if not times else median(times) if len(times) > 2 else min(times)

    def is_short(self, wait_ms: float = FREE_WAIT_MS) -> bool:
        """Whether not everyone can send what it wants with a wait of less than `wait_ms` for others."""
        return _RatePrediction(self, is_thinned=False).waits(wait_ms)

    def allocate(
        self, wait_ms: float = FREE_WAIT_MS, before: Mapping[str, RateGrant] | None = None
    ) -> dict[str, RateGrant]:
        """Return what every agent may send where the air is short. before: what they have, which changes
        hands only for a much larger gain."""
        held_hz = np.array([before[n].hz if before and n in before else 0.0 for n in self.agents])
        rates = _RatePrediction(self, is_thinned=True).allocate(wait_ms, held_hz)
        return {name: scarce_grant(self.agents[name].terms.form, hz) for name, hz in rates.items()}


def message_s(keyframe_s: float) -> float:
    """Return how long a small message takes on the air on which a keyframe takes keyframe_s."""
    return _MESSAGE_S + _MESSAGE_PART * keyframe_s


def least_load(form: AgentKind, keyframe_s: float) -> float:
    """Return the load of an agent that sends as little as it may."""
    return LEAST_HZ[form] * keyframe_s + (SCARCE_POSE_HZ[form] + OTHER_HZ) * message_s(keyframe_s)


def first_grant(form: AgentKind, hz: float = SLOW_START_HZ) -> RateGrant:
    """Return what an agent may send until its air is known, if there are `hz` for it."""
    return scarce_grant(form, min(SLOW_START_HZ, max(LEAST_HZ[form], hz)))


def scarce_grant(form: AgentKind, hz: float) -> RateGrant:
    """Return what an agent may send where the air is short: few poses."""
    return RateGrant(hz, SCARCE_POSE_HZ[form])


class _RatePrediction:
    """Predicts the QoE of all agents by their rates (N,), in the budget's order. is_thinned: with fewer
    poses."""

    def __init__(self, budget: RoomBudget, is_thinned: bool) -> None:
        agents = list(budget.agents.values())
        self._names = list(budget.agents)
        self._air_s = np.array([budget.air_s(agent) for agent in agents])
        self._usual_air_s = budget.usual_air_s or 0.0
        forms = [agent.terms.form for agent in agents]
        pose_hz = np.array([SCARCE_POSE_HZ[form] if is_thinned else FULL_POSE_HZ for form in forms])
        self._message_load = float((pose_hz + OTHER_HZ) @ (_MESSAGE_S + _MESSAGE_PART * self._air_s))
        self._weight = np.array([_WEIGHT[form] for form in forms])
        is_headset = np.array([form is AgentKind.AR for form in forms])
        self._has_priority = is_headset | ~is_headset.any()  # others may be delayed for it
        self._least_hz = np.array([agent.least_hz for agent in agents])
        self._wanted_hz = np.array([agent.wanted_hz for agent in agents])
        self._other_delay_ms = np.array([agent.other_delay_ms for agent in agents])
        self._terms = QoeTable.of([agent.terms for agent in agents])
        self._error_cm = np.array([math.nan if a.error_cm is None else a.error_cm for a in agents])
        self._drift_cm = np.minimum([agent.drift_cm for agent in agents], self._error_cm)
        self._measured_hz = np.maximum([agent.hz for agent in agents], 1e-3)

    def waits(self, wait_ms: float) -> bool:
        """Return whether keyframes at the wanted rates wait for others for longer."""
        return bool(self._waits(self._load(self._wanted_hz), wait_ms))

    def allocate(self, wait_ms: float, held_hz: F64) -> dict[str, float]:
        """Return the rates, Hz: the least ones, then a step at a time to the agent that gains most by it.
        While waits are short, agents with priority come before others."""
        hz = self._least_hz.copy()
        while len(hz) and (load := self._load(hz)) < MAX_LOAD:
            is_open = hz + STEP_HZ <= self._wanted_hz
            gain = self._gain(hz, load) / np.maximum(self._air_s, 1e-6)
            gain *= np.where(hz + STEP_HZ <= held_hz, _HELD, 1.0)
            is_free = is_open & ~self._waits(self._capped(load + STEP_HZ * self._air_s), wait_ms)
            steps = is_free & self._has_priority
            if not steps.any():
                steps = is_free
            if not steps.any():
                steps = is_open & self._has_priority & (gain > STEP_HZ * self._cost(hz, load))
            if not steps.any():
                break
            hz[np.argmax(np.where(steps, gain, -np.inf))] += STEP_HZ
        return dict(zip(self._names, hz.tolist(), strict=True))

    def _load(self, hz: F64) -> float:
        return float(self._capped(self._message_load + hz @ self._air_s))

    def _capped(self, load: F64 | float) -> F64:
        return np.minimum(load, MAX_LOAD)

    def _waits(self, load: F64 | float, wait_ms: float) -> NDArray[np.bool_]:
        """Return whether a keyframe waits for others for longer: T / (1 - load) - T."""
        part = np.asarray(load)
        return np.asarray(1e3 * self._usual_air_s * part / (1 - part) > wait_ms)

    def _gain(self, hz: F64, load: float) -> F64:
        """Return what a step of its rate gains each agent (N,), weighted, at the same load."""
        return self._weight * (self._qoe(hz + STEP_HZ, load) - self._qoe(hz, load))

    def _cost(self, hz: F64, load: float) -> float:
        """Return the QoE, weighted, that all agents together lose by a load of one more."""
        return float(self._weight @ (self._qoe(hz, load) - self._qoe(hz, load + _LOAD_STEP))) / _LOAD_STEP

    def _qoe(self, hz: F64, load: float) -> F64:
        """Return the QoE of each agent (N,), by its rate and the load of the air."""
        delay_ms = self._other_delay_ms + 1e3 * self._air_s / (1 - load)
        growth = self._measured_hz / np.maximum(hz, 1e-3) - 1  # a random walk between keyframes
        return self._terms.qoe(delay_ms, np.sqrt(self._error_cm**2 + self._drift_cm**2 * growth))
