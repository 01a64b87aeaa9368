"""The room of one edge over time: what each agent may send, when it begins, and whether one more has room."""

from __future__ import annotations

from dataclasses import dataclass, replace

from share.scheduling.qoe import QoeParameters
from share.scheduling.rate_allocation import STEP_HZ
from share.scheduling.room_budget import (
    FREE_WAIT_MS,
    SILENT_S,
    SMALL_JPEG_QUALITY,
    SMALL_SIZE,
    AgentDemand,
    RateGrant,
    RoomBudget,
    first_grant,
)
from share.scheduling.room_capacity import RoomCapacity
from share.timing import SECOND_NS, seconds_to_ns
from share.types import AgentKind
from share.wire.messages import Evaluation

UNKNOWN_KEYFRAME_S = 0.03  # default before any measurement: a small picture, 12 kB, at 5 Mbit/s
MAX_HOLD_S = 2.0  # after which a keyframe is stale, and is sent even if the air is full
_MIN_SLOT_S = 0.002


class StaggeredStart:
    """When agents that begin together send their first keyframe: one after another, as the air takes them.

    Twelve first keyframes at once make each other late, each by all of them; in turns, each by those before
    it. An agent that joins alone starts at once. Times: the edge's clock, ns.
    """

    def __init__(self) -> None:
        self._free_ns = 0  # when the air is done with the first keyframes that have a turn

    def hold_ms(self, slot_s: float, now_ns: int) -> float:
        """Give an agent that begins its turn, and return how far off that is, ms. slot_s: until the next
        one's."""
        slot_s = max(slot_s, _MIN_SLOT_S)
        turn_ns = min(max(now_ns, self._free_ns), now_ns + seconds_to_ns(MAX_HOLD_S))
        self._free_ns = turn_ns + seconds_to_ns(min(slot_s, MAX_HOLD_S))
        return 1e3 * (turn_ns - now_ns) / SECOND_NS


_PERIOD_NS = 500_000_000  # between two allocations
_SLOW_START_KEYFRAMES = 2  # before, an agent's air is not known
_STARTING_NS = 10_000_000_000  # after this time an agent without keyframes no longer reserves a share
_STARTING_LOAD = 0.5  # of the air that is free, for all that begin
_HYSTERESIS = 0.75  # part of a limit below which the air is no longer short


@dataclass(frozen=True)
class AirtimeMeasurement:
    """What is measured of an agent's air. keyframe_ms: A, as it reports. arrival_ms: from the message before
    its newest keyframe until that had arrived, by the edge's clock. keyframes, poses: that have arrived so
    far."""

    keyframe_ms: float
    arrival_ms: float
    keyframes: int
    poses: int


class RoomController:
    """The budget of one edge over time."""

    def __init__(self) -> None:
        self._budget = RoomBudget()
        self._counts: dict[str, tuple[int, tuple[int, int]]] = {}  # time, ns, keyframes and poses
        self._last: dict[str, AgentDemand] = {}  # newest report of each, of the silent too
        self._grants: dict[str, RateGrant] = {}
        self._allocated_ns, self._is_short, self._has_small_pictures = 0, False, False
        self._cut: dict[str, tuple[float, int]] = {}  # rates that were cut, and since when they may rise
        self._start = StaggeredStart()
        self._starting: dict[str, int] = {}  # agents whose air is not known, and when they joined
        self._capacity, self._assessed_ns = RoomCapacity(), 0

    def first_grant(self, form: AgentKind, now_ns: int) -> RateGrant:
        """Return what an agent may send whose air is not known: its part of what all that begin have."""
        self._starting = {n: at for n, at in self._starting.items() if now_ns - at < _STARTING_NS}
        return first_grant(form, _STARTING_LOAD / (self._keyframe_s * max(1, len(self._starting))))

    def hold_ms(self, name: str, now_ns: int) -> float:
        """Return how long an agent that joins now holds its keyframes, ms."""
        self._starting[name] = now_ns
        free = _STARTING_LOAD if self._budget.agents else 1.0  # nobody is there who would be made late
        return self._start.hold_ms(self._keyframe_s / free, now_ns)

    @property
    def _keyframe_s(self) -> float:
        """How long a keyframe of an agent that begins takes beside what others send, s."""
        return (self._budget.median_airtime_s or UNKNOWN_KEYFRAME_S) / (1 - self._budget.load)

    def grant(
        self,
        name: str,
        qoe: QoeParameters,
        wanted_hz: float,
        evaluation: Evaluation,
        air: AirtimeMeasurement,
        now_ns: int,
        is_placed: bool = True,
    ) -> RateGrant:
        """Return what an agent may send, by its evaluation. is_placed: see `AgentDemand`."""
        hz, pose_hz = self._rates(name, (air.keyframes, air.poses), now_ns)
        reported = AgentDemand(
            qoe=qoe,
            wanted_hz=wanted_hz,
            keyframe_s=air.keyframe_ms / 1e3,
            arrival_s=air.arrival_ms / 1e3,
            delay_ms=evaluation.delay_ms,
            error_cm=evaluation.error_cm,
            drift_cm=evaluation.drift_cm,
            hz=hz,
            pose_hz=pose_hz,
            updated_ns=now_ns,
            is_placed=is_placed,
            size=self._grants[name].size if name in self._grants else SMALL_SIZE,
        )
        if not air.keyframes:  # no keyframe has arrived that would confirm its report
            return self.first_grant(qoe.form, now_ns)
        self._budget = self._budget.with_report(name, reported, self._last.get(name))
        self._last[name] = self._budget.agents[name]
        self._reassess_capacity(now_ns)
        if air.keyframes < _SLOW_START_KEYFRAMES:
            return self.first_grant(qoe.form, now_ns)
        self._starting.pop(name, None)
        if not self._is_short or name not in self._grants or now_ns - self._allocated_ns >= _PERIOD_NS:
            self._allocate(now_ns)
        return self._limit_rise(name, self._grants[name], now_ns)

    def _allocate(self, now_ns: int) -> None:
        """Allocate the airtime anew, with hysteresis: once scarce, the air counts as scarce until keyframes
        wait for less than `_HYSTERESIS` of the limit; a rate stays while it is between what both waits
        allow."""
        budget, self._allocated_ns, plenty_ms = self._budget, now_ns, _HYSTERESIS * FREE_WAIT_MS
        self._has_small_pictures = budget.needs_small_pictures(
            _HYSTERESIS if self._has_small_pictures else 1.0
        )
        is_short = budget.is_short(plenty_ms if self._is_short else FREE_WAIT_MS)
        self._is_short = self._has_small_pictures and is_short
        if not self._is_short:
            quality = SMALL_JPEG_QUALITY if self._has_small_pictures else None
            self._grants = {n: RateGrant(a.wanted_hz, None, quality) for n, a in budget.agents.items()}
            return
        before = self._grants
        least, most = self._budget.allocate((plenty_ms, FREE_WAIT_MS), before)
        self._grants = {
            name: replace(grant, hz=min(grant.hz, max(least[name].hz, before.get(name, grant).hz)))
            for name, grant in most.items()
        }

    def _limit_rise(self, name: str, grant: RateGrant, now_ns: int) -> RateGrant:
        """Return the grant with a rate that rises slowly after a cut, since others rise as well."""
        if self._is_short and name not in self._cut:
            self._cut[name] = grant.hz, now_ns
        if (cut := self._cut.get(name)) is None:
            return grant
        before_hz, since_ns = cut
        hz = min(grant.hz, before_hz + STEP_HZ * int((now_ns - since_ns) / _PERIOD_NS))
        if hz != before_hz or hz >= grant.hz:
            self._cut[name] = hz, now_ns
        if not self._is_short and hz >= grant.hz:
            del self._cut[name]
        return replace(grant, hz=hz)

    def objection(self, form: AgentKind, now_ns: int) -> str | None:
        """Return why the room cannot serve one more agent of a form, for a person; None if it can."""
        return self._recent_capacity(now_ns).objection(form, now_ns)

    def displaced(self, form: AgentKind, now_ns: int) -> tuple[str, ...]:
        """Return the robots that have to leave for one more agent of a form, by name."""
        return self._recent_capacity(now_ns).displaced(form, now_ns)

    def _reassess_capacity(self, now_ns: int) -> None:
        if now_ns - self._assessed_ns >= _PERIOD_NS:
            self._capacity, self._assessed_ns = self._capacity.reassess(self._budget, now_ns), now_ns

    def _recent_capacity(self, now_ns: int) -> RoomCapacity:
        """Return the capacity; an empty one once no agent reports any more."""
        return self._capacity if now_ns - self._assessed_ns < seconds_to_ns(SILENT_S) else RoomCapacity()

    def forget(self, name: str) -> None:
        """Drop an agent."""
        self._budget = self._budget.without(name)
        for kept in (self._counts, self._last, self._grants, self._starting, self._cut):
            kept.pop(name, None)

    def _rates(self, name: str, counts: tuple[int, int], now_ns: int) -> tuple[float, float]:
        """Return keyframes and poses a second since the agent's last report."""
        since_ns, before = self._counts.get(name, (now_ns, counts))
        self._counts[name] = now_ns, counts
        elapsed_s = (now_ns - since_ns) / 1e9
        if elapsed_s <= 0:
            return 0.0, 0.0
        hz, pose_hz = ((now - then) / elapsed_s for now, then in zip(counts, before, strict=True))
        return hz, pose_hz
