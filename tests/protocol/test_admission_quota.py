"""Keyframe quota of an agent, and the order in which keyframes are added."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.hellos import hello_of

from share.config import Config, with_policy
from share.geometry.camera import Camera
from share.mapping.query_queue import QueryQueue
from share.mapping.recognition.patch_alignment import ORB_FEATURES
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import AddKeyframe, PeerMessageReceived, SendToPeer
from share.protocol.keyframe_intake import FairQueue, KeyframeQuota
from share.types import AgentKind, Keyframe, KeyframeImage, View
from share.wire import messages as m
from share.wire.codec import decode, encode

HELLO = hello_of("ann", 1)
S = 1_000_000_000
MS = S // 1000


def keyframe(id: int, points: int) -> Keyframe:
    view = View(np.zeros((points, 2)), np.zeros((points, 3)), np.zeros((points, 32), np.uint8))
    T = np.eye(4)
    return Keyframe(id, id - 1, id * S, T, 1e-6 * np.eye(6), T, np.zeros(3), 0.0, view, id - 1)


def taken_in(allowance: KeyframeQuota, points: int, hz: float, seconds: float, name: str = "eve") -> int:
    times = (round(k * S / hz) for k in range(int(seconds * hz)))
    one = keyframe(1, points)
    hello = hello_of(name, 1)
    return sum(allowance.objection(hello, one, at_ns) is None for at_ns in times)


def with_image(id: int, surfaces: int = 80) -> Keyframe:
    none = np.zeros((surfaces, 3), np.float32)
    image = KeyframeImage(np.zeros(9, np.uint8), none[:, :2], none, none[:, 0])
    return replace(keyframe(id, 0), image=image)


def accepted(one: Keyframe, hello: m.Hello = HELLO) -> int:
    """Of so many at once."""
    allowance = KeyframeQuota(5.0)
    return sum(allowance.objection(hello, one, 0) is None for _ in range(2000))


@pytest.mark.parametrize("has_image", [True, False], ids=["images", "views"])
def test_an_agent_within_its_rate_is_never_refused(has_image: bool) -> None:
    """The whole ledger at once, and from then on twice control.rate_max_hz."""
    config = Config()
    one = with_image(1) if has_image else keyframe(1, 500)
    allowance, hz = KeyframeQuota(5.0), 2 * config.control.rate_max_hz
    assert not any(allowance.objection(HELLO, one, 0) for _ in range(config.agent.keep_keyframes))
    assert not any(allowance.objection(HELLO, one, round(k * S / hz)) for k in range(60 * int(hz)))


def test_an_image_counts_about_as_the_keypoints_that_are_found_in_it() -> None:
    as_keypoints = accepted(keyframe(1, ORB_FEATURES))
    assert accepted(with_image(1)) == pytest.approx(as_keypoints, rel=0.05)
    both = replace(keyframe(1, 800), image=with_image(1).image)
    assert accepted(both) < 0.6 * accepted(with_image(1))


def test_pixels_and_surfaces_count_as_what_they_cost() -> None:
    """The largest image takes twice the mapper's time of a headset's; its camera's agent still has 5 Hz."""
    camera = Camera(1920, 1200, 900.0, 900.0, 959.5, 599.5)
    large = replace(HELLO, rig=replace(HELLO.rig, cam0=camera))
    usual = accepted(with_image(1))
    assert 0.45 * usual < accepted(with_image(1, 256), large) < 0.65 * usual
    assert 0.7 * usual < accepted(with_image(1, 256)) < 0.85 * usual
    allowance = KeyframeQuota(5.0)
    times = (round(k * S / 5) for k in range(600))
    assert not any(allowance.objection(large, with_image(1), at_ns) for at_ns in times)


def test_the_quota_counts_keypoints() -> None:
    allowance = KeyframeQuota(5.0)
    assert taken_in(allowance, 2000, 50, 60) < 60 * 50 / 4
    after = taken_in(allowance, 2000, 50, 60)
    assert 60 * 4 <= after <= 60 * 5
    assert taken_in(KeyframeQuota(5.0), 0, 50, 600) < 600 * 44 + 2000


def test_the_quota_is_per_name_and_not_per_run() -> None:
    allowance = KeyframeQuota(5.0)
    taken_in(allowance, 2000, 50, 60)
    assert taken_in(allowance, 2000, 50, 1) <= 5
    assert taken_in(allowance, 500, 5, 20, name="ann") == 100


def test_a_keyframe_beyond_the_quota_is_not_acknowledged_and_is_reported() -> None:
    edge = EdgeProtocol(Config(), 7)
    hello, now_ns = hello_of("eve", 5), S

    def tell(message: m.Message) -> list[Any]:
        return edge.handle(PeerMessageReceived(m.peer_id(5), [bytes(f) for f in encode(message)]), now_ns)

    tell(hello)
    applied, acked = 0, m.Ack(0)
    for k in range(400):
        effects = tell(keyframe(k, 2000))
        applied += sum(isinstance(effect, AddKeyframe) for effect in effects)
        (acked,) = [decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, SendToPeer)]
    assert 200 < applied < 350
    assert acked == m.Ack(applied)
    report = edge.report({})
    eve = report["agents"]["eve"]
    assert "the work of 10 keyframes a second" in eve["reason"]
    assert eve["refused_messages"] == 400 - applied
    assert report["refused"] == [f"agent 'eve': {400 - applied} messages refused, the last: {eve['reason']}"]
    now_ns += 10 * S  # sent again, it is taken in
    assert any(isinstance(effect, AddKeyframe) for effect in tell(keyframe(applied, 2000)))
    now_ns += 10 * S
    tell(m.Ping(0, 0))
    assert edge.report({})["agents"]["eve"]["reason"] == ""


def test_the_fair_queue_serves_names_in_turn() -> None:
    turns = FairQueue[int]()
    for k in range(100):
        turns.add("eve", k)
    turns.add("ann", 1000)
    turns.add("ann", 1001)
    turns.add("bob", 2000)
    assert [turns.take_next() for _ in range(6)] == [0, 1000, 2000, 1, 1001, 2]
    assert len(turns) == 97
    assert [turns.take_next() for _ in range(97)] == list(range(3, 100))
    assert turns.take_next() is None


@pytest.mark.parametrize("spent_ms", [10.0, 1e6])
def test_the_fair_queue_leaves_time_for_queries(spent_ms: float) -> None:
    turns = FairQueue[int]()
    turns.add("eve", 1)
    assert turns.take_next(spent_ms) is None
    assert turns.take_next(9.9) == 1


def test_keyframes_beyond_the_rate_are_queried_last() -> None:
    allowance = KeyframeQuota(5.0)
    honest = [allowance.is_over_rate("ann", round(k * S / 5.5)) for k in range(600)]
    assert not any(honest)
    eager = [allowance.is_over_rate("eve", k * S // 40) for k in range(40 * 60)]
    assert 0.8 < sum(eager) / len(eager) < 0.9
    assert not any(KeyframeQuota(None).is_over_rate("eve", k * MS) for k in range(1000))


def test_an_extra_keyframe_is_skipped_at_once() -> None:
    lookups = QueryQueue(Config().edge)
    lookups.add("eve", AgentKind.AR, 1, is_extra=True)
    lookups.add("ann", AgentKind.ROBOT, 0)
    assert (lookups.next_query(), lookups.next_query(), lookups.next_skipped()) == (0, None, 1)
    assert lookups.skipped == {"eve": 1}


@pytest.mark.parametrize(("policy", "some"), [("share", True), ("covins-g", False)])
def test_the_edge_marks_keyframes_beyond_the_rate(policy: str, some: bool) -> None:
    edge = EdgeProtocol(with_policy(Config(), policy), 8)
    edge.handle(PeerMessageReceived(m.peer_id(1), encode(hello_of("eve", 1))), 0)
    effects = []
    for k in range(100):
        one = replace(keyframe(k, 0), stamp_ns=k * 20 * MS)
        effects += edge.handle(PeerMessageReceived(m.peer_id(1), encode(one)), k * 20 * MS)
    extra = [effect.is_over_rate for effect in effects if isinstance(effect, AddKeyframe)]
    assert len(extra) == 100
    assert (sum(extra) > 60) is some


def test_a_duplicate_of_a_buffered_keyframe_costs_nothing() -> None:
    edge = EdgeProtocol(Config(), 8)
    edge.handle(PeerMessageReceived(m.peer_id(1), encode(hello_of("eve", 1))), 0)
    for _ in range(1000):  # keyframe 0 has not come yet; each would cost 2,250
        edge.handle(PeerMessageReceived(m.peer_id(1), encode(keyframe(1, 2000))), 0)
    effects = edge.handle(PeerMessageReceived(m.peer_id(1), encode(keyframe(0, 2000))), 0)
    assert [effect.keyframe.id for effect in effects if isinstance(effect, AddKeyframe)] == [0, 1]


def test_a_keyframe_that_starts_a_segment_costs_much_more() -> None:
    allowance, first = KeyframeQuota(5.0), keyframe(0, 0)
    taken = sum(allowance.objection(HELLO, first, k * S // 50) is None for k in range(50 * 600))
    assert 60 < taken < 1100
    assert taken_in(KeyframeQuota(5.0), 0, 50, 600) > 10 * taken


def test_buffered_keyframes_are_dropped_when_a_run_leaves_and_requested_again() -> None:
    edge = EdgeProtocol(Config(), 8)

    def tell(message: m.UplinkMessage) -> list[Any]:
        effects = edge.handle(PeerMessageReceived(m.peer_id(1), encode(message)), S)
        return [decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, SendToPeer)]

    tell(hello_of("eve", 1))
    assert m.Ack(0, (1,)) in tell(keyframe(1, 2000))
    tell(m.Bye())
    assert m.Ack(0, (2,)) in [*tell(hello_of("eve", 1)), *tell(keyframe(2, 0))]
