"""An edge that says whatever the wire lets it say: odometry is the same to the bit, and the agent is at an
honest edge's service afterwards."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.liar import Liar
from helpers.model_edge import COV, HELLO, MS, ModelEdge, S, handle, tracked

from share.checks import MAX_ID, MAX_STAMP_NS
from share.config import Config
from share.geometry import se3
from share.protocol import agent_events as ev
from share.protocol.agent import AgentProtocol
from share.protocol.common_events import EdgeMessageReceived, PrintLine, SendToEdge
from share.types import Correction, Keyframe
from share.wire import messages as m
from share.wire.codec import decode, encode

FRAME_MS = 50


def walk(count: int) -> list[ev.FrameTracked]:
    """Frames of a walk in circles; each fifth frame is a candidate, and odometry breaks once."""
    out = []
    for k in range(count):
        T = se3.from_rt(se3.so3_exp(np.array([0, 0, k / 50])), np.array([np.sin(k / 50), k / 200, 0.0]))
        out.append(tracked(k, T, candidate=k % 5 == 0, new_stretch=k == count // 2))
    return out


def odometry(effects: list[ev.AgentEffect]) -> list[tuple[int, int, bytes]]:
    return [
        (e.stamp_ns, e.segment, e.T_odom_body.tobytes()) for e in effects if isinstance(e, ev.LocalisedPose)
    ]


def messages(effects: list[ev.AgentEffect]) -> list[m.Message]:
    return [decode(effect.frames) for effect in effects if isinstance(effect, SendToEdge)]


def alone(frames: list[ev.FrameTracked]) -> list[tuple[int, int, bytes]]:
    agent = AgentProtocol(HELLO, Config())
    return odometry([e for frame in frames for e in handle(agent, frame, frame.done_ns)])


def lied_to(
    agent: AgentProtocol, frames: list[ev.FrameTracked], liar: Liar, each: int
) -> list[ev.AgentEffect]:
    """Effects of frames, with so many false messages between each two of them."""
    effects: list[ev.AgentEffect] = []
    for frame in frames:
        news = [frame, *(EdgeMessageReceived(liar.say()) for _ in range(each)), ev.AgentTick()]
        for event in news:
            more = handle(agent, event, frame.done_ns)
            for message in messages(more):
                liar.hear(message)
            effects += more
    return effects


@pytest.mark.parametrize("seed", range(3))
def test_odometry_does_not_depend_on_a_hostile_edge(seed: int) -> None:
    frames, agent, liar = walk(400), AgentProtocol(HELLO, Config()), Liar(np.random.default_rng(seed))
    effects = [e for frame in frames[:100] for e in handle(agent, frame, frame.done_ns)]
    effects += lied_to(agent, frames[100:300], liar, each=8)
    lies = len(effects)
    edge, down = ModelEdge(2**62 + 5), list[m.Message]()
    # an honest edge, after the silence by which its agent notices that the liar is gone
    honest = [
        *frames[300:],
        *(ev.AgentTick() for _ in range(400)),
        ev.InputFinished(),
        *(ev.AgentTick() for _ in range(200)),
    ]
    for k, event in enumerate(honest):
        now = frames[299].done_ns + (k + 1) * FRAME_MS * MS
        more = handle(agent, event, now)
        for answer in down if k > 80 else ():
            more += handle(agent, EdgeMessageReceived(encode(answer)), now)
        down = [answer for message in messages(more) for answer in edge.receive(message, now)]
        effects += more
    assert odometry(effects) == alone(frames)
    report = agent.report()
    assert report["pending"] == 0 and isinstance(effects[-1], ev.CloseLink)
    assert edge.applied[-1].id == report["keyframes"] - 1
    assert report["map_id"] == f"map-{edge.session}"
    assert report["bad_messages"] > 100
    said = [e.text for e in effects[:lies] if isinstance(e, PrintLine)]
    assert all(line.isprintable() and len(line) < 400 for line in said)
    assert 3 < len(said) < 30


@pytest.mark.long
def test_traffic_to_a_hostile_edge_is_bounded() -> None:
    frames, liar = walk(400), Liar(np.random.default_rng(9))
    agent = AgentProtocol(HELLO, Config())
    for frame in frames[:100]:
        handle(agent, frame, frame.done_ns)
    effects = lied_to(agent, frames[100:], liar, each=20)
    by_kind = {
        kind: sum(isinstance(x, kind) for x in messages(effects)) for kind in (m.Hello, m.Ping, Keyframe)
    }
    assert by_kind[m.Hello] <= 2 * 15 + 2  # two a second
    assert by_kind[m.Ping] <= 2 * 15 + 2
    assert by_kind[Keyframe] <= 60 + 16 * (2 * 15 + 2)  # each life of the edge is sent a window again
    places = [e.T_map_odom for e in effects if isinstance(e, ev.LocalisedPose) and e.T_map_odom is not None]
    assert places and all(np.isfinite(T).all() for T in places)


# ---------------------------------------------------------------- one lie at a time


def welcomed(frames: int = 0) -> tuple[AgentProtocol, int]:
    agent, now = AgentProtocol(HELLO, Config()), 0
    handle(agent, ev.AgentTick(), 0)
    tell(agent, m.Welcome(7, 0), 0)
    for frame in walk(frames):
        now = frame.done_ns
        handle(agent, frame, now)
    return agent, now


def tell(agent: AgentProtocol, message: m.Message, now_ns: int) -> list[ev.AgentEffect]:
    return handle(agent, EdgeMessageReceived(encode(message)), now_ns)


def said(effects: list[ev.AgentEffect]) -> list[str]:
    return [effect.text for effect in effects if isinstance(effect, PrintLine)]


def test_a_welcome_beyond_what_was_sent_is_ignored() -> None:
    agent = AgentProtocol(HELLO, Config())
    handle(agent, ev.AgentTick(), 0)
    [line] = said(tell(agent, m.Welcome(7, MAX_ID), 0))
    assert line == "the edge sent a welcome of keyframes that were never sent; ignored"
    assert not agent.is_connected
    tell(agent, m.Ack(MAX_ID), 0)
    tell(agent, m.Welcome(7, 0), 0)
    effects = [e for frame in walk(20) for e in handle(agent, frame, frame.done_ns)]
    assert [x.id for x in messages(effects) if isinstance(x, Keyframe)] == [0, 1, 2, 3]


def test_an_acknowledgement_beyond_what_was_sent_is_counted_and_printed_once() -> None:
    agent, now = welcomed(20)
    lines = said([e for _ in range(9) for e in tell(agent, m.Ack(MAX_ID), now)])
    assert lines == ["the edge sent an acknowledgement of keyframes that were never sent; ignored"]
    report = agent.report()
    assert (report["acknowledged"], report["pending"], report["invalid_acks"], report["bad_messages"]) == (
        0,
        4,
        9,
        9,
    )
    tell(agent, m.Ack(0, (MAX_ID,)), now)
    tell(agent, m.Ack(4), now)
    assert agent.report()["pending"] == 0


def test_an_absurd_revision_does_not_make_later_corrections_stale() -> None:
    agent, now = welcomed(6)
    for revision in (1, MAX_ID, 2, 3, 2):
        tell(agent, Correction(np.eye(4), COV, "a", revision, 1), now)
    report = agent.report()
    assert (report["corrections"], report["corrections_stale"], report["revision"]) == (4, 1, 3)


def test_a_correction_of_keyframes_that_do_not_exist_is_ignored() -> None:
    agent, now = welcomed(6)
    for about, answers in ((MAX_ID, 0), (0, MAX_ID)):
        tell(agent, Correction(np.eye(4), COV, "a", 1, about, answers), now)
    assert (agent.report()["corrections"], agent.report()["bad_messages"]) == (0, 2)


def test_a_rate_of_zero_still_lets_a_keyframe_pass_each_ten_seconds() -> None:
    agent, now = welcomed(1)
    tell(agent, m.Rate(0.0), now)
    sent = 0
    for frame in walk(1200)[1:]:  # a minute
        if frame.is_keyframe:
            tell(agent, m.Rate(0.0), frame.done_ns)
        effects = handle(agent, frame, frame.done_ns)
        tell(agent, m.Ack(agent.report()["sent"]), frame.done_ns)
        sent += sum(isinstance(x, Keyframe) for x in messages(effects))
    assert 5 <= sent <= 9


def test_an_unsolicited_session_is_ignored() -> None:
    agent, now = welcomed(20)
    effects = [e for k in range(100, 300) for e in tell(agent, m.Welcome(k, 0), now)]
    assert agent.report()["edge_sessions"] == 1
    assert said(effects) == ["the edge sent a welcome without a hello; ignored"]


def test_a_late_refusal_does_not_end_the_run() -> None:
    frames, agent = walk(100), AgentProtocol(HELLO, Config())
    for frame in frames:
        handle(agent, frame, frame.done_ns)
    now = frames[-1].done_ns
    lines = said([e for k in range(100) for e in tell(agent, m.Refused(f"no {k}\x1b[2J"), now + k * MS)])
    assert lines[0] == "the edge refuses 'ann': no 0?[2J; tracking continues without the edge"
    assert len(lines) <= 20
    assert odometry(handle(agent, tracked(101), now + S))


@pytest.mark.parametrize("edge_ns", [-MAX_STAMP_NS, MAX_STAMP_NS, 3 * 10**18])
def test_an_impossible_clock_is_ignored(edge_ns: int) -> None:
    agent, _ = welcomed(1)
    for t in range(1, 60):
        for ping in [x for x in messages(handle(agent, ev.AgentTick(), t * S // 2)) if isinstance(x, m.Ping)]:
            tell(agent, m.Pong(ping.sequence, ping.sent_ns, edge_ns, edge_ns, 7), t * S // 2 + MS)
    assert agent.clock_estimate(30 * S).offset_ms is None
    assert agent.report()["clock_offset_ns"] is None


def test_a_clock_with_another_speed_is_not_reported() -> None:
    agent, _ = welcomed(1)
    claims = []
    for t in range(1, 200):
        now = t * S // 2
        for ping in [x for x in messages(handle(agent, ev.AgentTick(), now)) if isinstance(x, m.Ping)]:
            edge = 10**15 * (t % 7) + now
            tell(agent, m.Pong(ping.sequence, ping.sent_ns, edge, edge, 7), now + MS // 10)
        claims.append(agent.clock_estimate(now + MS).is_reliable)
    assert not any(claims)
