"""Hide the policy of an edge in a blind study: it shows the letter of the condition in place of it.

An edge describes itself by its report (edge.json, /snapshot.json, /metrics, the pages) and its events
(events.jsonl, the terminal, the live room); both are covered here. The configuration is shown as a digest,
salted so that no list of guesses finds it. Fields and events that only some policies have are left out under
all: rates and their targets, merges that the gate skipped, and refusals for lack of air.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_FULL = "the room is full"
_REASONS = re.compile(r"(?:no air (?:for one more|left beside)|made room for) .*", re.DOTALL)
_KINDS = frozenset(("room full", "merge skipped"))  # of events
_RATED = frozenset(("rate_hz", "qoe", "qoe_target"))  # of an agent
_GATED = frozenset(("requested", "skipped"))  # of merges


@dataclass(frozen=True)
class Blinding:
    """label: shown in place of the policy's name. seal: salted digest of the configuration."""

    label: str
    seal: str

    def covered(self, report: dict[str, Any]) -> dict[str, Any]:
        """Return the report of an edge (edge.json without `series`) without its policy and configuration.
        Fields that only some policies have are None."""
        agents = {name: _covered_agent(one) for name, one in report.get("agents", {}).items()}
        lines = [line for line in report.get("refused", ()) if not _REASONS.match(line)]
        merges = _emptied(report["merges"], _GATED) if report.get("merges") else None
        return (
            report
            | {"policy": self.label, "config": {"sealed_sha256": self.seal}}
            | ({"agents": agents} if agents else {})
            | ({"refused": [_neutral(line) for line in lines]} if "refused" in report else {})
            | ({} if merges is None else {"merges": merges})
        )

    def covered_event(self, fields: dict[str, Any]) -> dict[str, Any] | None:
        """Return an event in words that all policies share; None: it is left out."""
        if fields["event"] in _KINDS:
            return None
        return fields | {"reason": _neutral(str(fields.get("reason") or ""))}

    def covered_series(self, series: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """Return the agents' evaluations (`series` of edge.json) without rates and QoE."""
        return {
            name: {key: values for key, values in one.items() if key not in _RATED}
            for name, one in series.items()
        }


class NoBlinding:
    """Covers nothing: for an edge outside a blind study."""

    def covered(self, report: dict[str, Any]) -> dict[str, Any]:
        return report

    def covered_event(self, fields: dict[str, Any]) -> dict[str, Any] | None:
        return fields

    def covered_series(self, series: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Mapping[str, Any]]:
        return series


def _covered_agent(agent: Mapping[str, Any]) -> dict[str, Any]:
    covered = _emptied(agent, _RATED)
    if covered.get("merges"):
        covered["merges"] = _emptied(covered["merges"], _GATED)
    if "trouble" in covered:
        covered["trouble"] = [_neutral(line) for line in covered["trouble"]]
    return covered | {"reason": _neutral(covered["reason"])} if covered.get("reason") else covered


def _emptied(fields: Mapping[str, Any], names: frozenset[str]) -> dict[str, Any]:
    return {name: None if name in names else value for name, value in fields.items()}


def _neutral(text: str) -> str:
    return _REASONS.sub(_FULL, text)
