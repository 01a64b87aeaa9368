"""Troubles of an agent as its edge sees them: late poses, late corrections, a large error, a clock that
is not synchronised, keyframes that are not acknowledged.

A low QoE is no trouble: scheduling controls it, and it falls with each millisecond of delay. What a wearer
notices is the age of the poses and their error. A late correction shows only as drift until it comes, which
the error includes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from statistics import median
from typing import Any

from share.metrics.frame_log import NOTICEABLE_LATENCY_MS, summary
from share.scheduling.room_capacity import TOLERATED_DELAY_MS
from share.timing import seconds_to_ns
from share.types import AgentKind, TrackState

_KEPT_POSES = 600  # half a minute at 20 Hz
_RECENT_S = 2.0  # poses in what is usual now
_SUMMARY_S = 1.0  # lifetime of a summary


class PoseAges:
    """Ages of an agent's newest poses: from the arrival of the frame at the agent until its pose was sent."""

    def __init__(self) -> None:
        self._ages: deque[tuple[int, float]] = deque(maxlen=_KEPT_POSES)  # arrival at the edge, ns; ms
        self._summary: dict[str, Any] = self._summarise(())
        self._summary_due_ns = 0

    def add(self, age_ms: float, now_ns: int) -> None:
        self._ages.append((now_ns, age_ms))

    def usual_ms(self, now_ns: int) -> float | None:
        """Return the median of the last 2 s, of at most 60 poses; None without one."""
        since_ns = now_ns - seconds_to_ns(_RECENT_S)
        recent = [ms for t_ns, ms in islice(reversed(self._ages), 60) if t_ns >= since_ns]
        return round(median(recent), 1) if recent else None

    def report(self, now_ns: int) -> dict[str, Any]:
        """Return `pose_ms` and `pose_ages_ms` of edge.json; the latter is at most 1 s old."""
        if now_ns >= self._summary_due_ns:
            self._summary_due_ns = now_ns + seconds_to_ns(_SUMMARY_S)
            self._summary = self._summarise([ms for _, ms in self._ages])
        return {"pose_ms": self.usual_ms(now_ns), "pose_ages_ms": self._summary}

    @staticmethod
    def _summarise(ages_ms: list[float] | tuple[()]) -> dict[str, Any]:
        over = sum(ms > NOTICEABLE_LATENCY_MS for ms in ages_ms)
        return {**summary(ages_ms).report(), "over_20ms": over / len(ages_ms) if ages_ms else None}


@dataclass(frozen=True)
class KindLimits:
    """Limits of a kind of agent. pose_ms: usual age of its poses; others as in `Evaluation`."""

    pose_ms: float
    delay_ms: float
    error_cm: float


# a headset's wearer notices 20 ms; a robot tolerates ten times that, and an error that its distance to
# obstacles covers
LIMITS = {
    AgentKind.AR: KindLimits(NOTICEABLE_LATENCY_MS, TOLERATED_DELAY_MS, 5.0),
    AgentKind.ROBOT: KindLimits(10 * NOTICEABLE_LATENCY_MS, 100 * NOTICEABLE_LATENCY_MS, 10.0),
}
_CLOCK_ERROR_MS = 10.0
_CLOCK_GRACE_S = 10.0  # after joining; an estimate needs some exchanges
_UNACKNOWLEDGED_MS = 5000.0
SILENT = "SILENT"  # an agent's state where it has sent nothing for a while
MISSED_S = 60.0  # for which an agent that went without a bye is trouble


def agent_troubles(kind: AgentKind, report: Mapping[str, Any], joined_s: float) -> list[str]:
    """Return what is wrong with a present agent, a line each.

    report: its entry in edge.json. joined_s: since it joined.
    """
    limits, state = LIMITS[kind], report["state"]
    out = []
    if is_lost(report):
        out.append(f"{state}: {report['reason']}" if report["reason"] else state)
    pose_ms = report["pose_ms"] if joined_s > _RECENT_S else None  # the first poses are not what is usual
    for before, ms, after, limit_ms in (
        ("poses are", pose_ms, " old", limits.pose_ms),
        ("its delay is", report["delay_ms"], "", limits.delay_ms),
    ):
        if ms is not None and ms > limit_ms:
            late = f"{ms / 1e3:.1f} s" if ms >= 1000 else f"{ms:.0f} ms"
            out.append(f"{before} {late}{after}, limit {limit_ms:.0f} ms")
    if (error_cm := report["error_cm"]) is not None and error_cm > limits.error_cm:
        out.append(f"its place is off by {error_cm:.0f} cm, limit {limits.error_cm:.0f} cm")
    clock_error_ms = report["clock_error_ms"]
    if joined_s > _CLOCK_GRACE_S and (clock_error_ms is None or clock_error_ms > _CLOCK_ERROR_MS):
        known = "unknown" if clock_error_ms is None else f"known to {clock_error_ms:.0f} ms"
        out.append(f"its clock is not synchronised: {known}")
    if report["unacknowledged_ms"] > _UNACKNOWLEDGED_MS:
        out.append(f"a keyframe has waited {report['unacknowledged_ms'] / 1e3:.0f} s to be acknowledged")
    return out


def is_lost(report: Mapping[str, Any]) -> bool:
    """Return whether an agent with this entry in edge.json has no current pose, or sends none."""
    return report.get("state") in (TrackState.LOST, SILENT)


def has_left(report: Mapping[str, Any]) -> bool:
    """Return whether an agent is gone and not missed: it said bye, or has been silent for long."""
    return bool(report.get("gone")) and not report.get("trouble")


def trouble_lines(agents: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the troubles of all agents, by label, a line each."""
    return [f"agent '{label}': {line}" for label, agent in agents.items() for line in agent["trouble"]]
