"""Invalid input is recorded once and does not change the map."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from helpers.edge_sim import Person, Town, walls
from helpers.hellos import hello_of

from share.config import Config, EdgeConfig
from share.errors import WireError
from share.geometry import se3
from share.mapping.mapper import Mapper
from share.mapping.steps import QueryStep
from share.protocol import agent_events as ev
from share.protocol import edge_events as ed
from share.protocol.agent import AgentProtocol
from share.protocol.common_events import Connected, EdgeMessageReceived, PrintLine, SendToEdge
from share.protocol.edge import EdgeProtocol
from share.protocol.keyframe_intake import OdometryBase
from share.protocol.peer import RestoredRun
from share.types import Keyframe, View
from share.wire import messages as m
from share.wire import room_messages as r
from share.wire.codec import decode, encode

EMPTY = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))
AHEAD = se3.from_rt(np.eye(3), np.array([0.1, 0.0, 0.0]))
HELLO = hello_of("ann", 0xA000B)


def keyframe(id: int, cov: np.ndarray | None = None, view: View = EMPTY) -> Keyframe:
    cov = 1e-6 * np.eye(6) if cov is None else cov
    return Keyframe(id, id - 1, 10**8 * id, np.eye(4), cov, np.eye(4), np.zeros(3), 0.0, view, id - 1)


def tell(edge: EdgeProtocol, message: m.Message, peer: int = HELLO.run_id) -> list[ed.EdgeEffect]:
    return edge.handle(ed.PeerMessageReceived(m.peer_id(peer), [bytes(f) for f in encode(message)]), 0)


def of(effects: list[ed.EdgeEffect], kind: type) -> list:
    return [effect for effect in effects if isinstance(effect, kind)]


def sent(effects: list, kind: type) -> list:
    messages = [
        decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, (ed.SendToPeer, SendToEdge))
    ]
    return [message for message in messages if isinstance(message, kind)]


@pytest.mark.parametrize(
    ("frame", "value"),
    [(1, np.nan), (2, -1.0), (2, np.inf), (3, np.nan), (4, np.nan), (5, np.inf)],
    ids=["pose", "covariance not positive", "covariance not finite", "place", "up", "uv"],
)
def test_non_finite_numbers_are_refused_when_decoded(frame, value):
    edge = EdgeProtocol(Config(), 7)
    tell(edge, HELLO)
    view = View(np.zeros((2, 2)), np.ones((2, 3)), np.zeros((2, 32), np.uint8))
    frames = [bytearray(f) for f in encode(keyframe(0, view=view))]
    dtype = np.float64 if frame <= 4 else np.float32
    frames[frame][:] = np.full(len(frames[frame]) // np.dtype(dtype).itemsize, value, dtype).tobytes()
    with pytest.raises(WireError):
        decode([bytes(f) for f in frames])
    for again in range(3):
        effects = edge.handle(ed.PeerMessageReceived(m.peer_id(HELLO.run_id), [bytes(f) for f in frames]), 0)
        assert not of(effects, ed.AddKeyframe)
        assert len(of(effects, ed.WriteEvent)) == (again == 0)  # said once
    assert edge.report({})["agents"]["ann"]["bad_messages"] == 3


def broken(message: m.Message) -> list[bytes]:
    """A message of this kind whose rest cannot be decoded."""
    version, code, *_ = msgspec.msgpack.decode(bytes(encode(message)[0]))
    return [msgspec.msgpack.encode((version, code, "no scalars", "no arrays"))]


@pytest.mark.parametrize(
    ("first", "message", "reason"),
    [
        (None, keyframe(0), "a message Keyframe before its hello"),
        (None, m.Bye(), "a message Bye before its hello"),
        (HELLO, m.Ack(1), "a message Ack, which agents must not send"),
        (HELLO, r.Cancel(1, "tb", "ann"), "a message Cancel, which agents must not send"),
        (r.ClientHello("ann", HELLO.run_id), keyframe(0), "a message Keyframe, which clients must not send"),
        (r.ClientHello("ann", HELLO.run_id), HELLO, "a message Hello, which clients must not send"),
    ],
    ids=lambda value: type(value).__name__ if not isinstance(value, str) else "",
)
def test_what_a_peer_may_not_send_is_refused_before_it_is_decoded(first, message, reason):
    edge = EdgeProtocol(Config(), 7)
    if first is not None:
        tell(edge, first)
    peer_id = m.peer_id(HELLO.run_id)
    for frames in (broken(message), [bytes(f) for f in encode(message)]):
        effects = edge.handle(ed.PeerMessageReceived(peer_id, frames), 0)
        assert not of(effects, ed.SendToPeer)
    sender = edge.room.clients.get(peer_id) or edge._registry.sender(peer_id)
    assert sender.counts["unexpected"] == 2
    assert sender.refusals.reason == reason
    assert sender.counts["bad_messages"] == 0


def test_a_reused_keyframe_id_changes_nothing():
    edge = EdgeProtocol(Config(), 7)
    tell(edge, HELLO)
    assert of(tell(edge, keyframe(0)), ed.AddKeyframe)
    effects = tell(edge, replace(keyframe(0), stamp_ns=5, up=np.array([0.0, 0.6, 0.8])))
    assert not of(effects, ed.AddKeyframe)
    assert sent(effects, m.Ack) == [m.Ack(1)]


def test_two_runs_whose_tags_start_alike_have_different_keys():
    tag = m.public_tag(0xB000B)
    edge = EdgeProtocol(
        Config(), 8, restored=[RestoredRun(f"ann-{tag[:4]}", HELLO, OdometryBase(0, 0, np.eye(4)))]
    )
    (join,) = of(tell(edge, replace(HELLO, run_id=0xB000B), 0xB000B), ed.AddRun)
    assert join.key == f"ann-{tag[:5]}"
    assert of(tell(edge, keyframe(0), 0xB000B), ed.AddKeyframe)[0].key == f"ann-{tag[:5]}"


def test_an_excessive_covariance_is_bounded_and_recorded():
    edge = EdgeProtocol(Config(), 7)
    tell(edge, HELLO)
    effects = tell(edge, keyframe(0, 1e11 * np.eye(6)))
    assert np.allclose(of(effects, ed.AddKeyframe)[0].keyframe.cov, 100 * np.eye(6))
    (record,) = of(effects, ed.WriteEvent)
    assert "1e+11" in record.fields["reason"]


@pytest.mark.long
def test_huge_covariances_do_not_end_the_mapper():
    place = walls(1)
    eve = Person("eve", place, 0.3, 133, cov=1e11 * np.eye(6))
    town = Town([Person("ann", place, 0.0, 111), eve])
    town.walk(24)
    town.run(500)
    report = town.edge.report()
    assert report["failed_steps"] == 0
    assert report["maps"] == {f"ann-{m.public_tag(111)[:4]}/0": 48}  # theirs, and she in it
    assert report["solve_ms"]["n"] > 0


def test_an_unusable_result_costs_its_step_only(monkeypatch):
    mapper = Mapper(Config())
    mapper.add_run("ann", HELLO)
    mapper.add_keyframe("ann", keyframe(0))
    step = mapper.next_lookup()
    assert isinstance(step, QueryStep)

    def bad(*_):
        raise ValueError("no such thing")

    monkeypatch.setattr(mapper.atlas.loop_acceptance, "review_joins", bad)
    (map_event,) = mapper.finish_step(step, step.run(), 1.0)
    assert map_event.event == "step failed"
    assert map_event.reason.startswith("place: ValueError: no such thing")
    monkeypatch.undo()
    mapper.add_keyframe("ann", keyframe(1))
    step = mapper.next_lookup()
    assert isinstance(step, QueryStep)
    assert not mapper.finish_step(step, step.run(), 1.0)
    assert mapper.report()["failed_steps"] == 1


@pytest.mark.slow
def test_ten_thousand_keyframes_at_once_are_bounded():
    rng = np.random.default_rng(1)
    config = Config(edge=EdgeConfig(max_keyframes=500, max_waiting=12))
    mapper = Mapper(config)
    mapper.add_run("ann", HELLO)
    mapper.add_run("eve", replace(HELLO, name="eve"))
    for k in range(20):
        mapper.add_keyframe("ann", keyframe(k))
    few = [
        View(rng.normal(size=(5, 2)), np.ones((5, 3)), rng.integers(0, 256, (5, 32), np.uint8)) for _ in "ab"
    ]
    for k in range(10_000):
        mapper.add_keyframe("eve", replace(keyframe(k, view=few[k % 2]), T_ref_body=AHEAD))
        if k % 100 == 0:
            mapper.take_changes()
    report = mapper.report()
    assert sum(report["maps"].values()) <= 525
    assert report["waiting"] <= 12
    assert report["agents"]["eve"]["queries_skipped"] > 9000
    assert report["maps"]["ann/0"] == 20  # it cost the others nothing


def test_a_hello_is_sent_at_once_when_the_link_is_back():
    """A new session of the edge is known by its welcome, not only by the answer to the next ping."""
    agent, edge = AgentProtocol(HELLO, Config()), EdgeProtocol(Config(), 7)
    hello = agent.handle(Connected(), 0)
    assert sent(hello, m.Hello)
    (welcome,) = sent(tell(edge, HELLO), m.Welcome)
    agent.handle(EdgeMessageReceived(encode(welcome)), 1)
    assert not sent(agent.handle(ev.AgentTick(), 2), m.Hello)
    assert sent(agent.handle(Connected(), 3), m.Hello)
    effects = agent.handle(EdgeMessageReceived(encode(m.Welcome(8, 0))), 4)
    assert any("restarted" in e.text for e in effects if isinstance(e, PrintLine))


def test_the_newest_correction_comes_with_the_welcome():
    """Until then it has revisions of the earlier session, and would reject it."""
    known = RestoredRun("ann-000b", HELLO, OdometryBase(0, 0, np.eye(4)))
    edge, mapper = EdgeProtocol(Config(), 8, restored=[known]), Mapper(Config())
    mapper.add_run("ann-000b", HELLO)
    tell(edge, m.Ping(1, 0))
    effects = edge.handle(ed.MapperResult(tuple(mapper.add_keyframe("ann-000b", keyframe(0)))), 0)
    assert not of(effects, ed.SendToPeer)
    (correction,) = sent(tell(edge, HELLO), m.Correction)
    assert (correction.map_id, correction.revision) == ("ann-000b/0", 1)
