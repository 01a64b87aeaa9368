"""Offsets between clocks, by time servers or by this machine's chronyd, checked against a limit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from share.devices import chrony
from share.devices.time_client import TimeServerResult, query_servers
from share.net.udp import HostPort


@dataclass(frozen=True)
class ClockCheck:
    """Check of one clock. Numbers are None if unknown. offset_ms: that clock minus this machine's, with an
    error of at most uncertainty_ms. note: further information. wrong: why the check fails and what to do,
    None if it passes. to_follow: following that clock would fix this machine's."""

    name: str
    offset_ms: float | None = None
    uncertainty_ms: float | None = None
    delay_ms: float | None = None
    jitter_ms: float | None = None
    stratum: int | None = None
    answers: int | None = None
    asked: int | None = None
    took_s: float | None = None
    note: str | None = None
    wrong: str | None = None
    host: HostPort | None = None
    to_follow: bool = False

    def to_plain(self) -> dict[str, Any]:
        return {key: value for key, value in asdict(self).items() if key not in ("host", "to_follow")}


def check_servers(
    hosts: Sequence[HostPort], count: int, limit_ms: float, step: Callable[[int], None] = lambda done: None
) -> list[ClockCheck]:
    """Check time servers, see `query_servers`. Raises UsageError for an unknown host."""
    return [_check_server(finding, limit_ms) for finding in query_servers(hosts, count, step)]


def check_chrony(limit_ms: float) -> ClockCheck | None:
    """Check by this machine's chronyd; None if none runs. Raises DataError if its output cannot be parsed."""
    tracking = chrony.read_tracking()
    if tracking is None:
        return None
    name = f"chronyd, by {tracking.source}" if tracking.source else "chronyd"
    if not tracking.synchronised:
        return ClockCheck(name, wrong="follows no other clock yet; see `chronyc sources`")
    if tracking.local:
        return ClockCheck(
            name, wrong="follows its own clock; fine if others follow it: check on their machines"
        )
    offset_ms, uncertainty_ms = tracking.offset_s * 1e3, tracking.uncertainty_s * 1e3
    return ClockCheck(
        name,
        offset_ms,
        uncertainty_ms,
        tracking.delay_s * 1e3,
        tracking.rms_s * 1e3,
        tracking.stratum,
        wrong=_limit_problem(offset_ms, uncertainty_ms, limit_ms, "see `chronyc sources`"),
    )


def _check_server(finding: TimeServerResult, limit_ms: float) -> ClockCheck:
    estimate, name = finding.estimate, str(finding.host)
    if estimate is None:
        return ClockCheck(
            name, answers=0, asked=finding.questions, took_s=finding.duration_s, wrong=finding.trouble
        )
    offset_ms, uncertainty_ms = estimate.offset_ns / 1e6, estimate.uncertainty_ns / 1e6
    return ClockCheck(
        name,
        offset_ms,
        uncertainty_ms,
        estimate.delay_ns / 1e6,
        estimate.jitter_ns / 1e6,
        estimate.stratum,
        estimate.answers,
        finding.questions,
        finding.duration_s,
        finding.trouble,
        _limit_problem(offset_ms, uncertainty_ms, limit_ms, "let chrony follow it"),
        finding.host,
        to_follow=_is_clock_off(offset_ms, uncertainty_ms, limit_ms),
    )


def _limit_problem(offset_ms: float, uncertainty_ms: float, limit_ms: float, fix: str) -> str | None:
    if abs(offset_ms) + uncertainty_ms <= limit_ms:
        return None
    if not _is_clock_off(offset_ms, uncertainty_ms, limit_ms):
        return (
            f"uncertain by ±{uncertainty_ms:.3f} ms, the limit is {limit_ms:g} ms; "
            "use a cable, a quieter network or a larger --count, or give a larger --limit-ms"
        )
    return f"off by {offset_ms:+.3f} ± {uncertainty_ms:.3f} ms, the limit is {limit_ms:g} ms; {fix}"


def _is_clock_off(offset_ms: float, uncertainty_ms: float, limit_ms: float) -> bool:
    """Return whether the clock itself is off, not only its offset too uncertain."""
    max_ms, min_ms = abs(offset_ms) + uncertainty_ms, abs(offset_ms) - uncertainty_ms
    return min_ms > limit_ms or uncertainty_ms < limit_ms < max_ms
