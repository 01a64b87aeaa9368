"""Acknowledgements and durability; checks of implausible odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.hellos import hello_of

from share.config import Config
from share.geometry import se3
from share.mapping.map_changes import SaveKeyframe, SaveRun
from share.protocol import edge_events as ed
from share.protocol.edge import EdgeProtocol
from share.protocol.keyframe_intake import OdometryBase
from share.protocol.peer import RestoredRun
from share.types import F64, Keyframe, View
from share.wire import messages as m
from share.wire.codec import decode, encode

MS = 1_000_000
EMPTY = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))
HELLO = hello_of("ann", 11)


def keyframe(
    id: int,
    reference: int,
    forward_m: float = 0.2,
    stamp_ms: int | None = None,
    at_m: float | None = None,
    yaw: float = 0.0,
) -> Keyframe:
    """Keyframe of a step of 0.2 m forwards; at_m, yaw: its pose in odom instead."""
    at_m = 0.2 * (id - 1) + forward_m if at_m is None else at_m
    T, T_odom_body = (se3.from_rt(np.eye(3), np.array([x, 0.0, 0.0])) for x in (forward_m, at_m))
    T_odom_body = T_odom_body @ se3.exp(np.array([0, 0, yaw, 0, 0, 0]))
    T = T_odom_body if reference < 0 else T
    stamp_ns = (200 * id if stamp_ms is None else stamp_ms) * MS
    return Keyframe(
        id, reference, stamp_ns, T, 1e-6 * np.eye(6), T_odom_body, np.zeros(3), 0.0, EMPTY, id - 1
    )


def tell(edge: EdgeProtocol, message: m.Message) -> list[ed.EdgeEffect]:
    return edge.handle(ed.PeerMessageReceived(m.peer_id(11), [bytes(f) for f in encode(message)]), 0)


def acks(effects: list[ed.EdgeEffect]) -> list[m.Ack]:
    messages = [decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, ed.SendToPeer)]
    return [message for message in messages if isinstance(message, m.Ack)]


def of(effects: list[ed.EdgeEffect], kind: type) -> list:
    return [effect for effect in effects if isinstance(effect, kind)]


def test_nothing_is_acknowledged_before_it_is_stored() -> None:
    edge = EdgeProtocol(Config(), 7, has_store=True)
    tell(edge, HELLO)
    effects = tell(edge, keyframe(0, -1))
    (keep,) = of(effects, ed.SaveChanges)
    assert [type(change) for change in keep.changes] == [SaveRun, SaveKeyframe]
    assert of(effects, ed.AddKeyframe)  # the map need not wait for the disk
    assert not acks(effects)
    again = acks(tell(edge, keyframe(0, -1)))
    assert again == [m.Ack(0, (0,))]  # it has arrived, but is not safe
    assert acks(edge.handle(ed.ChangesSaved(keep.ticket), 0)) == [m.Ack(1)]
    assert acks(edge.handle(ed.ChangesSaved(keep.ticket), 0)) == []


def test_several_stored_at_once_are_acknowledged_once() -> None:
    edge = EdgeProtocol(Config(), 7, has_store=True)
    tell(edge, HELLO)
    keeps = [of(tell(edge, keyframe(k, k - 1)), ed.SaveChanges)[0] for k in range(3)]
    assert acks(edge.handle(ed.ChangesSaved(keeps[1].ticket), 0)) == [m.Ack(2, (2,))]
    assert acks(edge.handle(ed.ChangesSaved(keeps[2].ticket), 0)) == [m.Ack(3)]


def test_a_restored_run_continues() -> None:
    foot = OdometryBase(4, 800 * MS, at(0.8))
    edge = EdgeProtocol(Config(), 8, has_store=True, restored=[RestoredRun("ann-000b", HELLO, foot)])
    effects = tell(edge, HELLO)
    welcome, _ = [decode([bytes(f) for f in e.frames]) for e in of(effects, ed.SendToPeer)]
    assert welcome == m.Welcome(8, 5)
    assert not of(effects, ed.SaveChanges)
    assert not of(effects, ed.AddRun)  # the mapper has the run from the store
    effects = tell(edge, keyframe(5, 4))
    (keep,) = of(effects, ed.SaveChanges)
    assert keep.changes[0].keyframe.reference == 4


def test_an_implausible_jump_starts_a_segment_in_the_same_odom() -> None:
    edge = EdgeProtocol(Config(), 7)
    tell(edge, HELLO)
    tell(edge, keyframe(0, -1))
    effects = tell(edge, keyframe(1, 0, forward_m=100.0))
    (add,) = of(effects, ed.AddKeyframe)
    assert add.keyframe.reference == -1
    assert np.allclose(add.keyframe.T_ref_body[:3, 3], (100.0, 0, 0))
    (record,) = of(effects, ed.WriteEvent)
    assert record.fields["event"] == "odometry suspect"
    assert "100 m" in record.fields["reason"]
    (add,) = of(tell(edge, keyframe(2, 1, at_m=100.2)), ed.AddKeyframe)
    assert add.keyframe.reference == 1


@pytest.mark.parametrize(
    ("bad", "off"),
    [
        ({"at_m": 1.0}, "0.8 m"),
        ({"forward_m": 0.9, "at_m": 0.2}, "0.7 m"),
        ({"yaw": 0.4}, "23 degrees"),
    ],
)
def test_a_motion_that_contradicts_its_two_poses_starts_a_segment(bad: dict[str, float], off: str) -> None:
    edge = EdgeProtocol(Config(), 7)
    tell(edge, HELLO)
    tell(edge, keyframe(0, -1))
    effects = tell(edge, keyframe(1, 0, **bad))
    (add,) = of(effects, ed.AddKeyframe)
    assert add.keyframe.reference == -1
    assert np.array_equal(add.keyframe.T_ref_body, add.keyframe.T_odom_body)
    (record,) = of(effects, ed.WriteEvent)
    assert record.fields["event"] == "odometry suspect"
    assert off in record.fields["reason"]
    assert "\n" not in record.fields["reason"]
    ann = edge.report({})["agents"]["ann"]
    assert ann["suspect_keyframes"] == 1
    assert off in ann["last_suspicion"]
    assert ann["refused_messages"] == 0  # it is taken in


def test_a_keyframe_with_a_bounded_variance_is_not_refused() -> None:
    edge = EdgeProtocol(Config(), 7)
    tell(edge, HELLO)
    for id in range(12):
        sure = keyframe(id, id - 1)
        (add,) = of(tell(edge, replace(sure, cov=1e12 * np.eye(6))), ed.AddKeyframe)
        assert add.keyframe.cov.max() == pytest.approx(100.0)
    report = edge.report({})
    ann = report["agents"]["ann"]
    assert (ann["keyframes"], ann["suspect_keyframes"], ann["refused_messages"]) == (12, 12, 0)
    (line,) = report["refused"]
    assert line.startswith("agent 'ann': 12 suspect keyframes, the last: keyframe 11 has a variance of 1e+12")


def test_a_later_estimate_of_the_past_is_no_contradiction() -> None:
    """Differences larger than those measured of correct agents."""
    edge = EdgeProtocol(Config(), 7)
    tell(edge, HELLO)
    tell(edge, keyframe(0, -1))
    (add,) = of(tell(edge, keyframe(1, 0, yaw=float(np.radians(5.0)))), ed.AddKeyframe)
    assert add.keyframe.reference == 0
    T = add.keyframe.T_odom_body
    step = Keyframe(2, 1, 8400 * MS, at(6.0), 1e-6 * np.eye(6), T @ at(6.1), np.zeros(3), 0.0, EMPTY, 1)
    effects = tell(edge, step)
    assert [add.keyframe.reference for add in of(effects, ed.AddKeyframe)] == [1]
    assert not of(effects, ed.WriteEvent)


def at(x: float) -> F64:
    return se3.from_rt(np.eye(3), np.array([x, 0.0, 0.0]))


def test_a_long_motion_in_a_long_time_is_no_jump() -> None:
    edge = EdgeProtocol(Config(), 7)
    tell(edge, HELLO)
    tell(edge, keyframe(0, -1))
    (add,) = of(tell(edge, keyframe(1, 0, forward_m=20.0, stamp_ms=10_000)), ed.AddKeyframe)
    assert add.keyframe.reference == 0


def test_a_reference_that_is_not_the_last_keyframe_is_refused() -> None:
    edge = EdgeProtocol(Config(), 7)
    tell(edge, HELLO)
    tell(edge, keyframe(0, -1))
    tell(edge, keyframe(1, 0))
    effects = tell(edge, keyframe(2, 0))
    assert not of(effects, ed.AddKeyframe)
    (record,) = of(effects, ed.WriteEvent)
    assert "refers to 0" in record.fields["reason"]
    assert acks(effects) == [m.Ack(3)]  # it need not be sent again
    assert of(tell(edge, keyframe(3, -1)), ed.AddKeyframe)  # a new stretch goes on


def test_a_run_id_is_not_shared_by_two_names() -> None:
    edge = EdgeProtocol(Config(), 7)
    tell(edge, HELLO)
    effects = tell(edge, hello_of("eve", 11))
    (refused,) = [decode([bytes(f) for f in e.frames]) for e in of(effects, ed.SendToPeer)]
    assert isinstance(refused, m.Refused)
    assert "'ann'" in refused.reason


def test_keyframes_waiting_for_the_disk_are_bounded(monkeypatch) -> None:
    """Keyframes of an agent that ignores the window are deferred beyond a bound, and none is lost."""
    monkeypatch.setattr("share.protocol.peer._MAX_PENDING_SAVES", 5)
    edge = EdgeProtocol(Config(), 7, has_store=True)
    tell(edge, HELLO)
    keeps = [keep for k in range(20) for keep in of(tell(edge, keyframe(k, k - 1)), ed.SaveChanges)]
    assert len(keeps) == 5
    effects = tell(edge, keyframe(0, -1))  # again: it is answered, and held no second time
    assert not of(effects, ed.SaveChanges)
    assert acks(effects) == [m.Ack(0, tuple(range(5)))]
    assert acks(edge.handle(ed.ChangesSaved(keeps[-1].ticket), 0)) == [m.Ack(5)]
    assert (
        len([keep for k in range(5, 8) for keep in of(tell(edge, keyframe(k, k - 1)), ed.SaveChanges)]) == 3
    )


def test_a_keyframe_that_is_refused_waits_for_no_disk() -> None:
    edge = EdgeProtocol(Config(), 7, has_store=True)
    tell(edge, HELLO)
    keeps = [of(tell(edge, keyframe(k, k - 1)), ed.SaveChanges)[0] for k in range(2)]
    edge.handle(ed.ChangesSaved(keeps[-1].ticket), 0)
    effects = tell(edge, replace(keyframe(2, 0), predecessor=0))  # refers to one that is not the last
    assert not of(effects, ed.AddKeyframe)
    assert acks(effects) == [m.Ack(3)]
