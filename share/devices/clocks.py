"""How far clocks are from this machine's, by servers or by its own chronyd, and whether that will do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from share.devices import chrony
from share.devices.time_client import Finding, check
from share.net.udp import Host


@dataclass(frozen=True)
class Row:
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
    host: Host | None = None
    to_follow: bool = False

    def plain(self) -> dict[str, Any]:
        return {key: value for key, value in asdict(self).items() if key not in ("host", "to_follow")}


def of_servers(
    hosts: Sequence[Host], count: int, limit_ms: float, step: Callable[[int], None] = lambda done: None
) -> list[Row]:
    """As `check`. Raises UsageError for a host that is unknown."""
    return [_of_server(finding, limit_ms) for finding in check(hosts, count, step)]


def of_chrony(limit_ms: float) -> Row | None:
    """None where no chronyd runs. Raises DataError where it is not understood."""
    found = chrony.tracking()
    if found is None:
        return None
    name = f"chronyd, by {found.source}" if found.source else "chronyd"
    if not found.synchronised:
        return Row(name, wrong="follows no other clock yet; see `chronyc sources`")
    if found.local:
        return Row(name, wrong="follows its own clock; right where others follow it: check from theirs")
    offset_ms, uncertainty_ms = found.offset_s * 1e3, found.uncertainty_s * 1e3
    return Row(
        name,
        offset_ms,
        uncertainty_ms,
        found.delay_s * 1e3,
        found.rms_s * 1e3,
        found.stratum,
        wrong=_too_far(offset_ms, uncertainty_ms, limit_ms, "see `chronyc sources`"),
    )


def _of_server(finding: Finding, limit_ms: float) -> Row:
    found, name = finding.estimate, str(finding.host)
    if found is None:
        return Row(name, answers=0, asked=finding.asked, took_s=finding.took_s, wrong=finding.trouble)
    offset_ms, uncertainty_ms = found.offset_ns / 1e6, found.uncertainty_ns / 1e6
    return Row(
        name,
        offset_ms,
        uncertainty_ms,
        found.delay_ns / 1e6,
        found.jitter_ns / 1e6,
        found.stratum,
        found.answers,
        finding.asked,
        finding.took_s,
        finding.trouble,
        _too_far(offset_ms, uncertainty_ms, limit_ms, "let chrony follow it"),
        finding.host,
        to_follow=_is_off(offset_ms, uncertainty_ms, limit_ms),
    )


def _too_far(offset_ms: float, uncertainty_ms: float, limit_ms: float, mend: str) -> str | None:
    if abs(offset_ms) + uncertainty_ms <= limit_ms:
        return None
    if not _is_off(offset_ms, uncertainty_ms, limit_ms):
        return (
            f"known to no better than ±{uncertainty_ms:.3f} ms, the limit is {limit_ms:g} ms; "
            "a cable, a quieter network or a larger --count tell more; or give a larger --limit-ms"
        )
    return f"off by {offset_ms:+.3f} ± {uncertainty_ms:.3f} ms, the limit is {limit_ms:g} ms; {mend}"


def _is_off(offset_ms: float, uncertainty_ms: float, limit_ms: float) -> bool:
    """Whether it is the clock that will not do, rather than what is known of it."""
    most_ms, least_ms = abs(offset_ms) + uncertainty_ms, abs(offset_ms) - uncertainty_ms
    return least_ms > limit_ms or uncertainty_ms < limit_ms < most_ms
