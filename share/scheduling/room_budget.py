"""The room's budget: what each agent may send where the air that all share is short.

The air is a server whose turns all agents share, so a keyframe that alone takes T s takes T / (1 - load)
(M/G/1 with processor sharing: L. Kleinrock, *Queueing Systems* II, 1976, section 4.4). T follows from what is
measured, A, the time that keyframes take, and L, how many a second arrive: T = A / (1 + A L). It does not
depend on the load, so rates that follow from it do not swing.

Where keyframes at the rates that all want take longer than a wearer notices, every agent begins with its
least rate. What is left goes in small steps to whom a step gains most for its air, as long as nobody notices;
then only where a step gains a headset more QoE than the delay that it causes costs all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from statistics import median

from share.scheduling.qoe import ACCEPTED_DELAY_MS, QoeParameters, qoe
from share.types import AgentKind

LEAST_HZ = {AgentKind.AR: 0.5, AgentKind.ROBOT: 0.2}  # by form: enough to stay placed; robots yield first
JOINING_HZ = 1.0  # of who shares a map with nobody yet
SLOW_START_HZ = 2.0  # of who sends its first keyframes
SCARCE_POSE_HZ = {AgentKind.AR: 5.0, AgentKind.ROBOT: 2.0}  # what draws them interpolates
_WEIGHT = {AgentKind.AR: 1.0, AgentKind.ROBOT: 0.25}  # of an agent's QoE, by form
POSE_COST = 0.017  # of a keyframe: air that a pose takes at 5 to 8 Mbit/s
FULL_POSE_HZ = 30.0  # of an agent that sends one a frame
_LOAD_STEP = 0.01
MAX_LOAD = 0.95  # beyond, the formula has no meaning
_STEP_HZ = 0.25
_TIME_CONSTANT_S = 5.0  # of measured times and rates: with 2 s rates swing where the air is just short
_MOST_RISE = 4.0  # of a measured time in one report: more is the edge's doing or the agent's, not the air's
_LEAST_AIR_S = 1e-3
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
    def elsewhere_ms(self) -> float:
        """Part of the delay that is not the air's, ms."""
        return max(0.0, self.delay_ms - 1e3 * self.keyframe_s)

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
        """Return T of an agent, s."""
        keyframes_hz = sum(a.hz + POSE_COST * a.pose_hz for a in self.agents.values())
        return agent.keyframe_s / (1 + agent.keyframe_s * keyframes_hz)

    @property
    def usual_air_s(self) -> float | None:
        """T in the median of all agents, s: that of one is noisy. None without an agent."""
        return median(map(self.air_s, self.agents.values())) if self.agents else None

    def is_short(self, noticed_ms: float = ACCEPTED_DELAY_MS) -> bool:
        """Whether not everyone can send what it wants with less than `noticed_ms` on the air."""
        wanted = {name: agent.wanted_hz for name, agent in self.agents.items()}
        return _Prediction(self, is_thinned=False).is_noticed(wanted, noticed_ms)

    def allocate(self, noticed_ms: float = ACCEPTED_DELAY_MS) -> dict[str, RateGrant]:
        """Return what every agent may send where the air is short."""
        rates = _Prediction(self, is_thinned=True).allocate(noticed_ms)
        return {name: scarce_grant(self.agents[name].terms.form, hz) for name, hz in rates.items()}


def first_grant(form: AgentKind, hz: float = SLOW_START_HZ) -> RateGrant:
    """Return what an agent may send until its air is known, if there are `hz` for it."""
    return scarce_grant(form, min(SLOW_START_HZ, max(LEAST_HZ[form], hz)))


def scarce_grant(form: AgentKind, hz: float) -> RateGrant:
    """Return what an agent may send where the air is short: few poses."""
    return RateGrant(hz, SCARCE_POSE_HZ[form])


class _Prediction:
    """Predicts the QoE of all agents by their rates. is_thinned: with fewer poses."""

    def __init__(self, budget: RoomBudget, is_thinned: bool) -> None:
        self._agents = budget.agents
        self._air_s = {name: budget.air_s(agent) for name, agent in self._agents.items()}
        self._pose_load = 0.0
        for name, agent in self._agents.items():
            pose_hz = SCARCE_POSE_HZ[agent.terms.form] if is_thinned else FULL_POSE_HZ
            self._pose_load += POSE_COST * pose_hz * self._air_s[name]

    def load(self, rates: Mapping[str, float]) -> float:
        load = self._pose_load + sum(hz * self._air_s[name] for name, hz in rates.items())
        return min(load, MAX_LOAD)

    def is_noticed(self, rates: Mapping[str, float], noticed_ms: float = ACCEPTED_DELAY_MS) -> bool:
        """Return whether keyframes would take longer on the air than a wearer notices."""
        return median(self._air_s.values()) / (1 - self.load(rates)) > noticed_ms / 1e3

    def allocate(self, noticed_ms: float) -> dict[str, float]:
        """Return the rates, Hz: least ones, then steps to whom they gain most; while nobody notices, those of
        who comes first before those of others."""
        rates = {name: agent.least_hz for name, agent in self._agents.items()}
        while True:
            load = self.load(rates)
            cost = self._cost(rates, load)
            gains = {
                name: self._gain(name, hz, load) / max(self._air_s[name], 1e-6)
                for name, hz in rates.items()
                if hz + _STEP_HZ <= self._agents[name].wanted_hz
            }
            free = {n: gain for n, gain in gains.items() if not self._is_step_noticed(rates, n, noticed_ms)}
            first = {n: gain for n, gain in gains.items() if self._comes_first(n)}
            worth = {n: gain for n, gain in first.items() if gain > _STEP_HZ * cost}
            steps = {n: gain for n, gain in free.items() if n in first} or free or worth
            if not steps or load >= MAX_LOAD:
                return rates
            best = max(steps, key=lambda name: steps[name])
            rates = {**rates, best: rates[best] + _STEP_HZ}

    def _is_step_noticed(self, rates: Mapping[str, float], name: str, noticed_ms: float) -> bool:
        return self.is_noticed({**rates, name: rates[name] + _STEP_HZ}, noticed_ms)

    def _comes_first(self, name: str) -> bool:
        """Return whether others may be delayed for an agent: for headsets, and among robots alone."""
        form = self._agents[name].terms.form
        return form is AgentKind.AR or all(agent.terms.form is form for agent in self._agents.values())

    def _gain(self, name: str, hz: float, load: float) -> float:
        """Return what a step of its rate gains an agent, weighted, at the same load."""
        more, now = (self._qoe(name, rate, load) for rate in (hz + _STEP_HZ, hz))
        return _WEIGHT[self._agents[name].terms.form] * (more - now)

    def _cost(self, rates: Mapping[str, float], load: float) -> float:
        """Return the QoE, weighted, that all agents together lose by a load of one more."""
        return (
            sum(
                _WEIGHT[agent.terms.form]
                * (self._qoe(name, rates[name], load) - self._qoe(name, rates[name], load + _LOAD_STEP))
                for name, agent in self._agents.items()
            )
            / _LOAD_STEP
        )

    def _qoe(self, name: str, hz: float, load: float) -> float:
        """Return the QoE of an agent, by its rate and the load of the air."""
        agent = self._agents[name]
        delay_ms = agent.elsewhere_ms + 1e3 * self._air_s[name] / (1 - load)
        if agent.error_cm is None:
            return qoe(delay_ms, None, agent.terms)
        drift = min(agent.drift_cm, agent.error_cm)
        drift_square = drift**2 * max(agent.hz, 1e-3) / max(hz, 1e-3)  # a random walk between keyframes
        error_cm = math.sqrt(agent.error_cm**2 - drift**2 + drift_square)
        return qoe(delay_ms, error_cm, agent.terms)
