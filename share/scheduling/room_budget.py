"""The room's budget: what each agent may send where the air that all share is short.

The air is a server whose turns all agents share, so a keyframe that alone takes T s takes T / (1 - load)
(M/G/1 with processor sharing: L. Kleinrock, *Queueing Systems* II, 1976, section 4.4). T follows from what is
measured, A, the time that keyframes take, and what arrives a second: L keyframes, and M small messages of
c + k T each. The load is L T + M (c + k T), so T = A (1 - M c) / (1 + A (L + k M)). It does not depend on the
load, so rates that follow from it do not swing.

A is reported by the agents. The edge itself observes D, the time from the message before a keyframe until
the keyframe has arrived; one transmission arrives at once, so D + 4 ms is compared with A. The budget uses
D + 4 ms of each agent, scaled by the room's median ratio of A to it, and at least the median of the other
delay. So an agent that reports wrong times gains nothing over others (docs/understand/scheduling.md).

Where keyframes at all wanted rates would wait for each other for more than `FREE_WAIT_MS`, every agent begins
with its least rate. The rest is allocated in small steps, each to the agent with the largest QoE gain for its
airtime, while the wait stays below that; beyond it only where a step gains a headset more QoE than the delay
it adds costs all. What a keyframe takes alone on slow air does not depend on the rates, so it does not count.

Before that, pictures are compressed more: where keyframes with full pictures at all wanted rates would wait
for more than `FREE_WAIT_MS`, or take more than `SLOW_KEYFRAME_MS` alone, all agents send small ones. Whether
they do follows from T at full size, T / s with s the size of a keyframe as sent, so it does not swing either.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import median
from typing import TypeVar

import numpy as np

from share.scheduling.qoe import QoeParameters, QoeTable
from share.scheduling.rate_allocation import MAX_LOAD, AirDemand, allocate_rates, load_of_wait
from share.types import F64, AgentKind

MIN_HZ = {AgentKind.AR: 0.5, AgentKind.ROBOT: 0.2}  # by form: enough to stay placed; robots yield first
JOINING_HZ = 1.0  # Hz, of an agent that is alone in its map
SLOW_START_HZ = 2.0  # Hz, of an agent that sends its first keyframes
FREE_WAIT_MS = 5.0  # a quarter of the delay that a wearer notices
SLOW_KEYFRAME_MS = 10.0  # on the air: half of what a wearer notices
SMALL_JPEG_QUALITY = 20  # of small pictures; those that agents make have 50
SMALL_SIZE = 0.57  # of a keyframe with a small picture, beside one with a full one (110 recordings)
SCARCE_POSE_HZ = {AgentKind.AR: 5.0, AgentKind.ROBOT: 2.0}  # viewers interpolate
_WEIGHT = {AgentKind.AR: 1.0, AgentKind.ROBOT: 0.25}  # of an agent's QoE, by form
# air of a small message: turn, preamble and acknowledgement, and its bytes as a part of a full keyframe's
_MESSAGE_S, _MESSAGE_PART = 3e-4, 0.008
OTHER_HZ = 8.0  # small messages of an agent, both ways, but poses: pings, status, evaluations, answers
FULL_POSE_HZ = 30.0  # of an agent that sends one a frame
_TIME_CONSTANT_S = 5.0  # of measured times and rates: with 2 s rates swing where the air is just short
_MAX_RISE = 4.0  # of a measured time in one report: a larger one is not caused by the air
_MIN_AIRTIME_S = 1e-3
_AT_ONCE_S = 4e-3  # longest transmission of Wi-Fi: what is in one arrives at once
_MAX_OTHER_DELAY_MS = 200.0  # of the median that counts as the least of any agent
Seconds = TypeVar("Seconds", float, F64)
SILENT_S = 3.0  # an agent that has not reported for so long takes no air


@dataclass(frozen=True)
class AgentDemand:
    """One agent's demand. wanted_hz: rate by its own QoE. keyframe_s: A, as it reports it. arrival_s: D, from
    the message before a keyframe until the keyframe has arrived, as the edge observes it. delay_ms,
    error_cm: as in `qoe`. drift_cm: part of the error that grows between keyframes. hz: rate of its
    keyframes, pose_hz: of poses. Times, rates, size are filtered. is_placed: it shares a map with somebody,
    or nobody is there. size: s, of its keyframes, beside ones with full pictures."""

    qoe: QoeParameters
    wanted_hz: float
    keyframe_s: float
    arrival_s: float
    delay_ms: float
    error_cm: float | None
    drift_cm: float
    hz: float
    pose_hz: float
    updated_ns: int
    is_placed: bool = True
    size: float = 1.0

    @property
    def observed_s(self) -> float:
        """Time that its keyframes take as observed, s: the message before one arrives with its beginning."""
        return self.arrival_s + _AT_ONCE_S

    @property
    def reported_ratio(self) -> float:
        """Ratio of the reported to the observed time; no keyframe is acknowledged before it has arrived."""
        return max(self.keyframe_s, self.arrival_s) / self.observed_s

    @property
    def messages_hz(self) -> float:
        """Its small messages a second."""
        return self.pose_hz + OTHER_HZ

    @property
    def min_hz(self) -> float:
        min_hz = MIN_HZ[self.qoe.form] if self.is_placed else JOINING_HZ
        return min(min_hz, self.wanted_hz)


@dataclass(frozen=True)
class RateGrant:
    """What an agent may send: keyframes and poses a second, and the quality of pictures. pose_hz None: every
    pose. jpeg_quality None: full pictures."""

    hz: float
    pose_hz: float | None = None
    jpeg_quality: int | None = None

    @property
    def size(self) -> float:
        """Size of its keyframes, beside ones with full pictures."""
        return 1.0 if self.jpeg_quality is None else SMALL_SIZE


@dataclass(frozen=True)
class RoomBudget:
    """State of the room: agents by name. Immutable: `with_report` returns the next one."""

    agents: Mapping[str, AgentDemand] = field(default_factory=dict)

    def with_report(self, name: str, reported: AgentDemand, before: AgentDemand | None = None) -> RoomBudget:
        """Return the budget after an agent's report, whose times and rates are filtered here. Agents
        that are silent are dropped. before: what was known of this one before it fell silent."""
        now_ns, before = reported.updated_ns, self.agents.get(name, before)
        if before is not None:
            elapsed_s = max(0.0, (now_ns - before.updated_ns) / 1e9)
            weight = -math.expm1(-elapsed_s / _TIME_CONSTANT_S)
            most = {
                key: _MAX_RISE * max(getattr(before, key), _MIN_AIRTIME_S)
                for key in ("keyframe_s", "arrival_s")
            }
            filtered = {
                key: then + weight * (min(getattr(reported, key), most.get(key, math.inf)) - then)
                for key in ("keyframe_s", "arrival_s", "hz", "pose_hz", "size")
                for then in [getattr(before, key)]
            }
            reported = replace(reported, **filtered)
        present = {n: a for n, a in self.agents.items() if now_ns - a.updated_ns < SILENT_S * 1e9}
        return RoomBudget({**present, name: reported})

    def without(self, name: str) -> RoomBudget:
        """Return the budget of a room that an agent has left."""
        return RoomBudget({n: a for n, a in self.agents.items() if n != name})

    def airtime_s(self, agent: AgentDemand) -> float:
        """Return T of an agent, s: the observed time, scaled by the room's median ratio of reported to
        observed time, at an idle channel."""
        keyframe_time_s = self._keyframe_time_s(agent)
        return keyframe_time_s * self._idle / (1 + keyframe_time_s * self._keyframes_hz)

    def _keyframe_time_s(self, agent: AgentDemand) -> float:
        """Return the scaled A of an agent, s."""
        return self._median_reported_ratio * agent.observed_s

    @property
    def load(self) -> float:
        """Part of the air in use, at most MAX_LOAD."""
        usual_s = self.median_airtime_s or 0.0
        return min(MAX_LOAD, 1 - self._idle + usual_s * self._keyframes_hz)

    @cached_property
    def _keyframes_hz(self) -> float:
        """L + k M."""
        return sum(a.hz + _MESSAGE_PART / a.size * a.messages_hz for a in self.agents.values())

    @cached_property
    def _idle(self) -> float:
        """1 - M c, bounded where an agent claims what no air carries."""
        return max(1 - MAX_LOAD, 1 - _MESSAGE_S * sum(a.messages_hz for a in self.agents.values()))

    @cached_property
    def _median_reported_ratio(self) -> float:
        """Median of `reported_ratio`, of agents whose keyframes take longer than one transmission."""
        agents = self.agents.values()
        telling = [agent for agent in agents if agent.arrival_s >= _AT_ONCE_S] or agents
        return _low_median([agent.reported_ratio for agent in telling]) or 0.0

    @cached_property
    def median_airtime_s(self) -> float | None:
        """Median of T, s; None without an agent."""
        return _low_median([self.airtime_s(agent) for agent in self.agents.values()])

    def other_delays_ms(self) -> F64:
        """Return the part of each agent's delay (N,) that is not airtime, at least the median of its form, of
        two the longer: an agent that reports a short delay is not served first for it."""
        agents = list(self.agents.values())
        other_ms = [max(0.0, agent.delay_ms - 1e3 * self._keyframe_time_s(agent)) for agent in agents]
        median_ms = dict[AgentKind, float]()
        for form in {agent.qoe.form for agent in agents}:
            of_form = [ms for agent, ms in zip(agents, other_ms, strict=True) if agent.qoe.form is form]
            median_ms[form] = median(of_form) if len(of_form) > 2 else max(of_form)
        least_ms = [min(_MAX_OTHER_DELAY_MS, median_ms[agent.qoe.form]) for agent in agents]
        return np.maximum(other_ms, least_ms)

    def is_short(self, wait_ms: float = FREE_WAIT_MS) -> bool:
        """Whether not everyone can send what it wants with a wait of less than `wait_ms` for others."""
        agents = self.agents.values()
        return self._is_short([(self.airtime_s(agent), agent.size) for agent in agents], wait_ms)

    def needs_small_pictures(self, part: float = 1.0) -> bool:
        """Whether the air is short, or slow, for full pictures. part: of both limits, for a hysteresis."""
        full_s = [self.airtime_s(agent) / agent.size for agent in self.agents.values()]
        is_slow = 1e3 * (_low_median(full_s) or 0.0) > part * SLOW_KEYFRAME_MS
        return is_slow or self._is_short([(one, 1.0) for one in full_s], part * FREE_WAIT_MS)

    def _is_short(self, keyframes: Sequence[tuple[float, float]], wait_ms: float) -> bool:
        """Return `is_short` if the keyframes of `agents`, in their order, had these T, s, and sizes."""
        messages_hz, load = FULL_POSE_HZ + OTHER_HZ, 0.0
        for agent, (airtime_s, size) in zip(self.agents.values(), keyframes, strict=True):
            load += agent.wanted_hz * airtime_s + messages_hz * message_s(airtime_s, size)
        return load > load_of_wait(_low_median([one for one, _ in keyframes]) or 0.0, wait_ms)

    def allocate(
        self, waits_ms: Sequence[float] = (FREE_WAIT_MS,), before: Mapping[str, RateGrant] | None = None
    ) -> list[dict[str, RateGrant]]:
        """Return what every agent may send where the air is short, for each of these waits, which rise.
        before: what they have, which changes hands only for a much larger gain."""
        allocated = allocate_rates(self._demand(before or {}), waits_ms)
        forms = [(name, agent.qoe.form) for name, agent in self.agents.items()]
        return [
            {name: scarce_grant(form, hz) for (name, form), hz in zip(forms, rates.tolist(), strict=True)}
            for rates in allocated
        ]

    def _demand(self, before: Mapping[str, RateGrant]) -> AirDemand:
        """Return what all want where poses are thinned, in the order of `agents`."""
        agents = list(self.agents.values())
        forms = [agent.qoe.form for agent in agents]
        airtime_s = np.array([self.airtime_s(agent) for agent in agents])
        sizes = np.array([agent.size for agent in agents])
        pose_hz = np.array([SCARCE_POSE_HZ[form] for form in forms])
        error_cm = np.array([math.nan if a.error_cm is None else a.error_cm for a in agents])
        return AirDemand(
            qoe=QoeTable.of([agent.qoe for agent in agents]),
            airtime_s=airtime_s,
            median_airtime_s=self.median_airtime_s or 0.0,
            message_load=float((pose_hz + OTHER_HZ) @ message_s(airtime_s, sizes)),
            weight=np.array([_WEIGHT[form] for form in forms]),
            min_hz=np.array([agent.min_hz for agent in agents]),
            wanted_hz=np.array([agent.wanted_hz for agent in agents]),
            held_hz=np.array([before[name].hz if name in before else 0.0 for name in self.agents]),
            other_delay_ms=self.other_delays_ms(),
            error_cm=error_cm,
            drift_cm=np.minimum([agent.drift_cm for agent in agents], error_cm),
            measured_hz=np.maximum([agent.hz for agent in agents], 1e-3),
            is_placed=np.array([agent.is_placed for agent in agents]),
        )


def _low_median(values: Sequence[float]) -> float | None:
    """Return the median, of two the lesser, so that no single agent decides it; None of none."""
    return None if not values else median(values) if len(values) > 2 else min(values)


def message_s(keyframe_s: Seconds, size: Seconds | float = 1.0) -> Seconds:
    """Return how long a small message takes on the air on which a keyframe of this size takes keyframe_s."""
    return _MESSAGE_S + _MESSAGE_PART * keyframe_s / size


def min_load(form: AgentKind, keyframe_s: float) -> float:
    """Return the load of an agent that sends as little as it may, keyframes with small pictures."""
    return MIN_HZ[form] * keyframe_s + (SCARCE_POSE_HZ[form] + OTHER_HZ) * message_s(keyframe_s, SMALL_SIZE)


def first_grant(form: AgentKind, hz: float = SLOW_START_HZ) -> RateGrant:
    """Return what an agent may send until its air is known, if there are `hz` for it."""
    return scarce_grant(form, min(SLOW_START_HZ, max(MIN_HZ[form], hz)))


def scarce_grant(form: AgentKind, hz: float) -> RateGrant:
    """Return what an agent may send where the air is short: few poses and small pictures."""
    return RateGrant(hz, SCARCE_POSE_HZ[form], SMALL_JPEG_QUALITY)
