"""What a device must have for SHARE, judged from plain facts: what was found, and how to mend it.

Nothing here looks at the machine: `share.io.host` reads the facts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum


class State(Enum):
    OK = "OK"
    WARN = "WARN"  # it works, but not as well as it could
    FAIL = "FAIL"  # it does not work
    SKIPPED = "SKIPPED"  # it could not be seen, or is not asked for


@dataclass(frozen=True)
class Finding:
    """name: what was looked at. what: what was found, for a person. mend: lines to paste or to read, none
    where nothing is to be done."""

    name: str
    state: State
    what: str
    mend: tuple[str, ...] = ()


def ok(name: str, what: str) -> Finding:
    return Finding(name, State.OK, what)


def warn(name: str, what: str, *mend: str) -> Finding:
    return Finding(name, State.WARN, what, mend)


def fail(name: str, what: str, *mend: str) -> Finding:
    return Finding(name, State.FAIL, what, mend)


def skipped(name: str, why: str) -> Finding:
    return Finding(name, State.SKIPPED, why)


def failures(findings: Iterable[Finding]) -> list[Finding]:
    return [finding for finding in findings if finding.state is State.FAIL]
