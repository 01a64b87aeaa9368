"""A blind edge: what only some policies say or have is the same under all."""

from __future__ import annotations

from share.protocol.edge_events import WriteEvent
from share.runtime.blinding import Blinding
from share.scheduling.room_capacity import RoomCapacity
from share.types import AgentKind

BLINDING = Blinding("B", "ab")


def event(kind: str, reason: str) -> dict[str, object]:
    return {"t_s": 1.0, "event": kind, "agent": None, "reason": reason}


def test_events_that_only_some_policies_cause_are_not_told() -> None:
    for kind in ("room full", "merge skipped"):
        assert BLINDING.covered_event(event(kind, "there is room again")) is None
    full = RoomCapacity(dict.fromkeys(AgentKind, 214.0), dict.fromkeys(AgentKind, 0))
    for kind in AgentKind:
        reason = full.objection(kind, 10**12)
        assert reason is not None and "no air" in reason
        assert BLINDING.covered_event(event("refused", reason)) == event("refused", "the room is full")
    sent_away = event("refused", "no air left beside headsets: 'ann' has joined")
    assert BLINDING.covered_event(sent_away) == event("refused", "the room is full")
    left = event("left", "made room for 'ann'")
    assert BLINDING.covered_event(left) == event("left", "the room is full")
    other = WriteEvent(event("refused", "another agent has this name")).fields
    assert BLINDING.covered_event(other) == other


def test_the_report_has_no_rates_under_any_policy() -> None:
    agent = {
        "rate_hz": 3.0,
        "qoe": 0.5,
        "qoe_target": 0.8,
        "delay_ms": 40.0,
        "reason": "made room for 'ann'",
        "merges": {"requested": 3, "skipped": 2, "done": 1},
    }
    full = "no air for one more agent: a keyframe would take 214 ms, 140 ms at most"
    report = {"agents": {"bot": agent}, "refused": [full, f"bot, 3 times: {full}", "other"]}
    covered = BLINDING.covered({**report, "merges": agent["merges"], "policy": "share", "config": {}})
    merges = {"requested": None, "skipped": None, "done": 1}
    nothing = dict.fromkeys(("rate_hz", "qoe", "qoe_target"))
    told = agent | nothing | {"reason": "the room is full", "merges": merges}
    assert covered["agents"] == {"bot": told} and covered["merges"] == merges
    assert covered["refused"] == ["bot, 3 times: the room is full", "other"]
    unlimited = BLINDING.covered({"agents": {"bot": agent | {"rate_hz": None, "qoe_target": 0.6}}})
    assert unlimited["agents"] == covered["agents"]  # as under a policy without rates


def test_the_series_has_no_rates() -> None:
    series = {"bot": {"t_s": [1.0], "rate_hz": [None], "qoe": [0.5], "delay_ms": [40.0]}}
    assert BLINDING.covered_series(series) == {"bot": {"t_s": [1.0], "delay_ms": [40.0]}}
