"""What an edge finds wrong with an agent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.hellos import hello_of
from helpers.model_edge import MS, S

from share.config import Config
from share.protocol.agent_health import PoseAges, agent_troubles, trouble_lines
from share.protocol.common_events import Tick
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import PeerMessageReceived
from share.types import AgentKind, TrackState
from share.wire import messages as wire
from share.wire.codec import encode

WELL: dict[str, Any] = {
    "state": "OK",
    "reason": "",
    "pose_ms": 6.0,
    "delay_ms": 15.0,
    "error_cm": 1.2,
    "unacknowledged_ms": 120.0,
    "clock_error_ms": 0.4,
}


@pytest.mark.parametrize(
    ("kind", "change", "line"),
    [
        ("ar", {"pose_ms": 21.0}, "poses are 21 ms old, limit 20 ms"),
        ("ar", {"pose_ms": 3400.0}, "poses are 3.4 s old, limit 20 ms"),
        ("robot", {"pose_ms": 201.0}, "poses are 201 ms old, limit 200 ms"),
        ("ar", {"delay_ms": 250.0}, "its delay is 250 ms, limit 200 ms"),
        ("robot", {"delay_ms": 2500.0}, "its delay is 2.5 s, limit 2000 ms"),
        ("ar", {"state": "LOST", "reason": "lost for 0.7 s"}, "LOST: lost for 0.7 s"),
        ("ar", {"state": "SILENT", "reason": ""}, "SILENT"),
        ("ar", {"error_cm": 7.2}, "its place is off by 7 cm, limit 5 cm"),
        ("robot", {"error_cm": 12.0}, "its place is off by 12 cm, limit 10 cm"),
        ("ar", {"clock_error_ms": None}, "its clock is not synchronised: unknown"),
        ("ar", {"clock_error_ms": 11.0}, "its clock is not synchronised: known to 11 ms"),
        ("ar", {"unacknowledged_ms": 5100.0}, "a keyframe has waited 5 s to be acknowledged"),
    ],
)
def test_each_fault_has_a_line(kind: str, change: dict[str, Any], line: str) -> None:
    assert agent_troubles(AgentKind(kind), WELL | change, joined_s=60.0) == [line]


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("ar", {"pose_ms": 20.0, "delay_ms": 200.0}),
        ("robot", {"pose_ms": 200.0, "delay_ms": 2000.0}),
        ("ar", {"pose_ms": None, "delay_ms": None, "error_cm": None}),
        ("ar", {"error_cm": 5.0}),
        ("robot", {"error_cm": 10.0}),
    ],
)
def test_what_a_kind_tolerates_is_no_trouble(kind: str, change: dict[str, Any]) -> None:
    assert agent_troubles(AgentKind(kind), WELL | change, joined_s=60.0) == []


def test_a_clock_needs_some_seconds() -> None:
    assert agent_troubles(AgentKind.AR, WELL | {"clock_error_ms": None}, joined_s=5.0) == []


def test_the_first_poses_of_who_has_just_come_are_no_trouble() -> None:
    """A headset that joined was red for half a second."""
    late = WELL | {"pose_ms": 41.0}
    assert agent_troubles(AgentKind.AR, late, joined_s=0.5) == []
    assert agent_troubles(AgentKind.AR, late, joined_s=2.5) == ["poses are 41 ms old, limit 20 ms"]


def test_the_usual_age_is_that_of_the_last_two_seconds() -> None:
    ages = PoseAges()
    assert ages.report(0)["pose_ms"] is None
    for k in range(100):
        ages.add(5.0, k * 50 * MS)
    for k in range(100, 130):
        ages.add(300.0, k * 50 * MS)
    assert ages.usual_ms(129 * 50 * MS) == 300.0
    assert ages.usual_ms(129 * 50 * MS + 3 * S) is None
    seen = ages.report(200 * S)["pose_ages_ms"]
    assert (seen["n"], seen["p50"], seen["p95"]) == (130, 5.0, 300.0)
    assert seen["over_20ms"] == 30 / 130


def edge_with(*messages: wire.UplinkMessage) -> EdgeProtocol:
    edge = EdgeProtocol(Config(), session=5)
    for k, message in enumerate((hello_of("ann", 1), *messages)):
        edge.handle(PeerMessageReceived(wire.peer_id(1), encode(message)), S + k * 50 * MS)
    return edge


def test_an_edge_sees_how_late_the_poses_of_a_headset_are() -> None:
    """A state of OK with poses of long ago was shown as ok."""
    poses = [wire.PoseUpdate(k, TrackState.OK, -1, np.eye(4), 3400.0) for k in range(60)]
    edge = edge_with(wire.Status(TrackState.OK, 3400.0), *poses)
    report = edge.report({})
    assert report["agents"]["ann"]["trouble"] == ["poses are 3.4 s old, limit 20 ms"]
    assert trouble_lines(report["agents"]) == ["agent 'ann': poses are 3.4 s old, limit 20 ms"]
    assert edge.latest_poses()[report["agents"]["ann"]["run"]].stamp_ns == 59


def test_a_low_quality_of_experience_is_no_trouble() -> None:
    """Corrections after 120 ms with a good place: scheduling does what it can, the wearer sees nothing."""
    edge = edge_with(wire.Status(TrackState.OK, 3.0), *[wire.Evaluation(k, 120.0, 1.0) for k in range(100)])
    agent = edge.report({})["agents"]["ann"]
    assert agent["qoe"] < 0.5 * agent["qoe_target"] and agent["trouble"] == []


def test_a_place_that_is_off_is_trouble() -> None:
    edge = edge_with(wire.Status(TrackState.OK, 3.0), wire.Evaluation(0, 60.0, 9.0))
    assert edge.report({})["agents"]["ann"]["trouble"] == ["its place is off by 9 cm, limit 5 cm"]


def test_who_left_is_in_no_trouble() -> None:
    edge = edge_with(wire.Status(TrackState.LOST, 3.0, "lost for 1 s"), wire.Bye())
    edge.handle(Tick(), 60 * S)
    assert trouble_lines(edge.report({})["agents"]) == [] and edge.latest_poses() == {}
