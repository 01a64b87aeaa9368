"""The side panel of the live room."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from share.types import AgentKind, TrackState
from share.view import events as ev
from share.view.panel import SidePanel, sparkline
from share.view.room import DrawnRoom, LastCorrection

AGENT: dict[str, Any] = {
    "run": "ann-1",
    "kind": "ar",
    "state": "OK",
    "reason": "",
    "gone": False,
    "trouble": [],
    "pose_ms": 6.3,
    "qoe": 0.951,
    "qoe_target": 0.93,
    "rate_hz": 3.25,
    "delay_ms": 14.2,
    "map_id": "ann-1/0",
    "keyframes": 12,
}


def panel_of(*events: ev.RoomEvent, now_s: float = 10.0) -> str:
    room, panel = DrawnRoom(), SidePanel()
    for event in (ev.RunArrived("ann-1", "ann", AgentKind.AR, np.eye(4), (0.8, 0.6)), *events):
        panel.apply(event)
        room.apply(event, 0.0)
    room.corrections["ann-1"] = LastCorrection(6.0, 0.0123)
    return panel.html(room, now_s)


def words(html: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", html))


def test_it_says_of_an_agent_what_decides() -> None:
    text = words(panel_of(ev.AgentsReported({"ann": AGENT})))
    for part in ("ann ar OK", "0.95 (target 0.93)", "12, at most 3.2 Hz", "14 ms", "6.3 ms, limit 20 ms"):
        assert part in text.replace("  ", " ")
    assert "12 mm, 4 s ago" in text and "ann-1/0" in text


def test_trouble_and_decisions_are_said_with_their_reason() -> None:
    late = AGENT | {"trouble": ["poses are 3.4 s old, limit 20 ms"]}
    text = words(
        panel_of(
            ev.AgentsReported({"ann": late}, ("the disk is full",), left_out=7),
            ev.DecisionMade(1.0, "loop refused", "ann", "17 inliers of 25 needed"),
            ev.DecisionMade(2.5, "maps merged", "ann", "B into A by 3 loops"),
        )
    )
    for part in (
        "poses are 3.4 s old, limit 20 ms",
        "the disk is full",
        "7 updates were dropped: this view is too slow",
    ):
        assert part in text
    assert "maps merged: B into A by 3 loops" in text and "2.5 s maps merged: ann: B into A" in text
    assert "17 inliers" not in text  # a newer decision replaced it


def test_what_a_peer_says_is_text() -> None:
    evil = "<img src=x onerror=alert(1)>"
    html = panel_of(
        ev.AgentsReported({evil: AGENT | {"state": evil, "map_id": evil, "trouble": [evil]}}, (evil,)),
        ev.DecisionMade(1.0, "maps merged", evil, evil),
    )
    assert "<img" not in html and "&lt;img" in html


def test_poses_are_a_line_below_or_above_the_limit() -> None:
    poses = [ev.PoseArrived("ann-1", TrackState.OK, 0, np.eye(4), ms) for ms in (5.0, 6.0, 90.0, 4000.0)]
    html = panel_of(ev.AgentsReported({"ann": AGENT}), *poses)
    heights = [float(y) for _, y in re.findall(r"([\d.]+),([\d.]+)", re.search(r'points="([^"]*)"', html)[1])]  # type: ignore[index]
    limit = float(re.search(r'y1="([\d.]+)"', html)[1])  # type: ignore[index]
    assert heights[0] > heights[1] > limit > heights[2] > heights[3] == 0.0
    assert sparkline((), 20.0, "red") == ""


def test_of_many_agents_each_has_its_line_of_poses() -> None:
    names = [f"a{k}" for k in range(7)]
    arrivals = [
        event
        for name in names
        for event in (
            ev.RunArrived(f"{name}-1", name, AgentKind.AR, np.eye(4), (0.8, 0.6)),
            ev.PoseArrived(f"{name}-1", TrackState.OK, 0, np.eye(4), 5.0),
        )
    ]
    reported = ev.AgentsReported({name: AGENT | {"run": f"{name}-1"} for name in names})
    html = panel_of(reported, *arrivals)
    assert html.count("<polyline") == 7 and "limit 20 ms" not in html


def test_only_who_is_present_can_be_followed() -> None:
    panel = SidePanel()
    panel.apply(ev.AgentsReported({"ann": AGENT, "bob": AGENT | {"run": "bob-1", "gone": True}}))
    assert panel.agents == {"ann-1": "ann"}


def test_a_map_that_is_read_is_said() -> None:
    panel = SidePanel()
    panel.loading = "loading the map"
    html = panel.html(DrawnRoom(), 0.0)
    assert "loading the map" in html and "no agent yet" not in html


def test_long_times_are_in_seconds() -> None:
    late = AGENT | {"pose_ms": 19_233.7, "delay_ms": 136_871.0}
    text = words(panel_of(ev.AgentsReported({"ann": late})))
    assert "19.2 s, limit 20 ms" in text and "136.9 s" in text and "19233" not in text


def many(count: int, **troubles: list[str]) -> ev.AgentsReported:
    names = [f"agent{k}" for k in range(count)]
    return ev.AgentsReported({n: AGENT | {"run": f"{n}-1", "trouble": troubles.get(n, [])} for n in names})


def test_of_many_agents_there_is_a_line_each_the_troubled_first_and_counts() -> None:
    report = many(30, agent17=["its clock is not synchronised: unknown"])
    html = panel_of(report)
    text = words(html)
    assert "30 agents, 1 in trouble" in text.replace(" ,", ",")
    names = re.findall(r"<b>(agent\d+)</b>", html)
    assert names == ["agent17", *(f"agent{k}" for k in range(30) if k != 17)]  # agent2 before agent10
    assert html.count("<table>") == 0 and len(html) < 30 * 400
    assert panel_of(many(4)).count("<table>") == 4


def test_a_state_that_is_good_is_not_red_for_another_trouble() -> None:
    html = panel_of(ev.AgentsReported({"ann": AGENT | {"trouble": ["its clock is not synchronised"]}}))
    assert '<b style="color:inherit">OK</b>' in html
    lost = panel_of(ev.AgentsReported({"ann": AGENT | {"state": "LOST", "trouble": ["LOST: dark"]}}))
    assert '<b style="color:#e5484d">LOST</b>' in lost


def test_merges_that_are_not_listed_are_counted() -> None:
    merges = [ev.DecisionMade(float(k), "maps merged", "ann", f"number {k}") for k in range(9)]
    text = words(panel_of(*merges))
    assert "the newest of 9" in text and "number 8" in text and "number 4" not in text
