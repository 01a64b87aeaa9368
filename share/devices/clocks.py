"""How far clocks are from this machine's, by servers or by its own chronyd, and whether that will do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from share.devices import chrony
from share.devices.time_client import TimeServerResult, query_servers
from share.net.udp import HostPort


@dataclass(frozen=True)
class ClockCheck:
    """One clock. Numbers are None where nothing is known. offset_ms: it minus this machine's, wrong by at
    most uncertainty_ms. note: what else to know. wrong: why it will not do, and what to do; None: it
    will. to_follow: this machine's clock would agree if it followed that one."""

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
    """As `query_servers`. Raises UsageError for a host that is unknown."""
    return [_check_server(finding, limit_ms) for finding in query_servers(hosts, count, step)]


def check_chrony(limit_ms: float) -> ClockCheck | None:
    """None where no chronyd runs. Raises DataError where it is not understood."""
    tracking = chrony.read_tracking()
    if tracking is None:
        return None
    name = f"chronyd, by {tracking.source}" if tracking.source else "chronyd"
    if not tracking.synchronised:
        return ClockCheck(name, wrong="follows no other clock yet; see `chronyc sources`")
    if tracking.local:
        return ClockCheck(
            name, wrong="follows its own clock; right where others follow it: check from theirs"
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
            f"known to no better than ±{uncertainty_ms:.3f} ms, the limit is {limit_ms:g} ms; "
            "a cable, a quieter network or a larger --count tell more; or give a larger --limit-ms"
        )
    return f"off by {offset_ms:+.3f} ± {uncertainty_ms:.3f} ms, the limit is {limit_ms:g} ms; {fix}"


def _is_clock_off(offset_ms: float, uncertainty_ms: float, limit_ms: float) -> bool:
    """Whether it is the clock that will not do, rather than what is known of it."""
    max_ms, min_ms = abs(offset_ms) + uncertainty_ms, abs(offset_ms) - uncertainty_ms
    return min_ms > limit_ms or uncertainty_ms < limit_ms < max_ms
