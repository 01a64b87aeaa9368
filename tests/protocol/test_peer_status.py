"""The state that an edge shows of an agent, and its age."""

from __future__ import annotations

import numpy as np
from helpers.hellos import hello_of
from helpers.model_edge import MS, S

from share.config import Config
from share.protocol.agent_health import MISSED_S
from share.protocol.common_events import Tick
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import PeerMessageReceived
from share.protocol.keyframe_intake import OdometryBase
from share.protocol.peer import PeerStatus, RestoredRun
from share.types import TrackState
from share.wire import messages as wire
from share.wire.codec import encode

OK = wire.Status(TrackState.OK, 20.0)
GONE = wire.Status(TrackState.LOST, 2100.0, "no image for 2.1 s")


def test_state_age_and_reason_are_those_of_the_last_status() -> None:
    status = PeerStatus()
    status.update(GONE, 5 * S)
    report = status.report(5 * S + 100 * MS, 5 * S)
    assert {k: report[k] for k in ("state", "reason", "pose_age_ms", "last_received_s")} == {
        "state": "LOST",
        "reason": "no image for 2.1 s",
        "pose_age_ms": 2200.0,
        "last_received_s": 0.1,
    }


def test_a_pose_resets_the_age_to_that_of_the_last_status() -> None:
    status = PeerStatus()
    status.update(OK, 5 * S)
    status.add_pose(TrackState.OK, 5 * S + 400 * MS)
    assert status.report(5 * S + 450 * MS, 5 * S + 400 * MS)["pose_age_ms"] == 70


def test_a_pose_ends_the_reason_for_having_none() -> None:
    status = PeerStatus()
    status.update(GONE, 5 * S)
    status.add_pose(TrackState.OK, 6 * S)
    assert status.report(6 * S, 6 * S)["reason"] == ""


def test_no_age_is_shown_before_the_first_status() -> None:
    report = PeerStatus().report(9 * S, 9 * S)
    assert (report["state"], report["pose_age_ms"]) == ("INITIALISING", None)


def test_a_restored_run_has_no_age() -> None:
    """The machine has run for long before the edge starts."""
    known = RestoredRun("ann-000b", hello_of("ann", 1), OdometryBase(0, 0, np.eye(4)))
    edge = EdgeProtocol(Config(), session=5, restored=[known])
    edge.handle(Tick(), 6600 * S)
    seen = shown(edge)
    assert (seen["state"], seen["last_received_s"], seen["gone"]) == ("SILENT", None, True)
    assert "no message since" in str(seen["reason"])
    edge.handle(PeerMessageReceived(wire.peer_id(1), encode(hello_of("ann", 1))), 6601 * S)
    assert shown(edge)["last_received_s"] == 0.0


def edge_with(status: wire.Status, at_ns: int) -> EdgeProtocol:
    edge = EdgeProtocol(Config(), session=5)
    for message in (hello_of("ann", 1), status):
        edge.handle(PeerMessageReceived(wire.peer_id(1), encode(message)), at_ns)
    return edge


def shown(edge: EdgeProtocol) -> dict[str, object]:
    return edge.report({})["agents"]["ann"]


def test_a_silent_agent_is_shown_as_silent() -> None:
    edge = edge_with(OK, S)
    edge.handle(Tick(), S + 650 * MS)
    assert (shown(edge)["state"], shown(edge)["reason"]) == ("OK", "")
    for at_s in (1.75, 3.3, 60.0):  # and after it was taken as gone
        edge.handle(Tick(), round(at_s * S))
        assert shown(edge)["state"] == "SILENT"
        assert shown(edge)["reason"] == f"silent for {at_s - 1:.1f} s; its last state was OK"
        assert shown(edge)["pose_age_ms"] == round(20 + (at_s - 1) * 1000, 1)
    edge.handle(PeerMessageReceived(wire.peer_id(1), encode(OK)), 61 * S)
    assert shown(edge)["state"] == "OK"


def test_an_agent_that_went_without_a_bye_is_trouble_for_a_minute() -> None:
    """A crash and a bye do not look alike."""
    edge = edge_with(OK, S)
    for at_s in (1.75, 4.5, 60.0):
        edge.handle(Tick(), round(at_s * S))
        assert shown(edge)["trouble"] == [f"SILENT: silent for {at_s - 1:.1f} s; its last state was OK"]
        assert shown(edge)["gone"] == (at_s > 4)
    edge.handle(Tick(), round((1 + MISSED_S + 0.1) * S))
    assert (shown(edge)["gone"], shown(edge)["trouble"]) == (True, [])
    assert shown(edge)["reason"] == "gone without a word; its last state was OK"


def test_nobody_misses_who_said_bye_or_came_again() -> None:
    edge = edge_with(OK, S)
    edge.handle(PeerMessageReceived(wire.peer_id(1), encode(wire.Bye())), 2 * S)
    edge.handle(Tick(), 10 * S)
    assert shown(edge)["trouble"] == []
    edge = edge_with(OK, S)
    edge.handle(Tick(), 10 * S)
    for message in (hello_of("ann", 2), OK):  # it crashed, and was started again
        edge.handle(PeerMessageReceived(wire.peer_id(2), encode(message)), 10 * S)
    (earlier,) = (one for label, one in edge.report({})["agents"].items() if label != "ann")
    assert (earlier["gone"], earlier["trouble"], shown(edge)["trouble"]) == (True, [], [])


def test_an_agent_that_left_keeps_its_last_state() -> None:
    edge = edge_with(OK, S)
    edge.handle(PeerMessageReceived(wire.peer_id(1), encode(wire.Bye())), 2 * S)
    edge.handle(Tick(), 60 * S)
    assert (shown(edge)["state"], shown(edge)["gone"]) == ("OK", True)
