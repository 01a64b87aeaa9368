"""What an edge tells its policy of the agents, and what a headset page's server tells its edge."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from share.headset.measures import ServerReport, measured_fields
from share.headset.page_messages import PageMeasured
from share.scheduling.policies import POLICIES, AgentReport


def recorded_reports(monkeypatch: pytest.MonkeyPatch) -> list[AgentReport]:
    """Let policy `share` only record; return the list that each report is added to."""
    reports: list[AgentReport] = []

    class Recorder(POLICIES["share"]):  # type: ignore[misc]
        def evaluate(self, agent: str, report: AgentReport) -> None:
            reports.append(report)

    monkeypatch.setitem(POLICIES, "share", Recorder)
    return reports


def headset_report() -> dict[str, Any]:
    """Return the field `headset` of an edge's report, with one wearer."""
    measured = PageMeasured("align", 144, 3, 12.5, 18.0, 22.0, 4.0, 0.5)
    about = {"agent": "ann", "is_connected": True, "is_connected_to_edge": True}
    wearers = {"ann": about | measured_fields(measured)}
    return msgspec.structs.asdict(ServerReport("", "48392175", 2, 1, wearers))
