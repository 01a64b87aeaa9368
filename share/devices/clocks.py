"""Offsets between clocks, by time servers or by this machine's chronyd, checked against a limit."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from share.devices.time_client import TimeServerResult, query_servers
from share.errors import DataError
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
    tracking = read_tracking()
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


# ---- chronyd

_LOCAL_REFERENCE = "7F7F0101"  # reference id of a chronyd that follows its local clock
_FIELDS = 14  # of `chronyc -c tracking`, chrony 2.2 and later
_TIMEOUT_S = 10.0


@dataclass(frozen=True)
class ChronyTracking:
    """Output of `chronyc tracking`. offset_s: reference clock minus this one. rms_s: of that over recent
    updates. delay_s, dispersion_s: root delay and dispersion. source: its reference, may be empty.
    synchronised: it follows a reference. local: the reference is its own clock."""

    source: str
    synchronised: bool
    local: bool
    stratum: int
    offset_s: float
    rms_s: float
    delay_s: float
    dispersion_s: float

    @property
    def uncertainty_s(self) -> float:
        """Largest error of the offset: half the root delay plus the root dispersion (chronyc(1),
        tracking)."""
        return self.delay_s / 2 + self.dispersion_s


def read_tracking() -> ChronyTracking | None:
    """Ask chronyd; None if none runs. Raises DataError for output that cannot be parsed."""
    try:
        result = subprocess.run(
            ["chronyc", "-c", "tracking"], capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return parse_tracking(result.stdout) if result.returncode == 0 else None


def parse_tracking(text: str) -> ChronyTracking:
    """Parse the line that `chronyc -c tracking` prints. Raises DataError."""
    row = text.strip().split(",")
    try:
        if len(row) < _FIELDS:
            raise ValueError(f"{len(row)} fields, expected {_FIELDS}")
        offset_s, _last, rms_s = (float(cell) for cell in row[4:7])
        delay_s, dispersion_s = float(row[10]), float(row[11])
        stratum = int(row[2])
    except ValueError as error:
        raise DataError(f"chronyc -c tracking: cannot be parsed ({error}): {text.strip()!r}") from None
    synchronised, local = row[13] != "Not synchronised", row[0].upper() == _LOCAL_REFERENCE
    return ChronyTracking(row[1], synchronised, local, stratum, offset_s, rms_s, delay_s, dispersion_s)


def follow_lines(server: HostPort) -> list[str]:
    """Return the lines of chrony.conf that make a machine follow `server`: polled every 1 to 16 s, stepped
    only at the start if more than 10 ms off. `prefer trust`, because the internet servers of chrony's
    packages would outvote the room's server."""
    return [
        f"server {server.name} port {server.port} iburst minpoll 0 maxpoll 4 prefer trust",
        "makestep 0.01 3",
        "rtcsync",
    ]
