"""What an edge tells its policy of the agents."""

from __future__ import annotations

import pytest

from share.scheduling.policies import POLICIES, AgentReport


def recorded_reports(monkeypatch: pytest.MonkeyPatch) -> list[AgentReport]:
    """Let policy `share` only record; return the list that each report is added to."""
    reports: list[AgentReport] = []

    class Recorder(POLICIES["share"]):  # type: ignore[misc]
        def evaluate(self, agent: str, report: AgentReport) -> None:
            reports.append(report)

    monkeypatch.setitem(POLICIES, "share", Recorder)
    return reports
