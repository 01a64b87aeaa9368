"""Agents and edges of earlier releases against this one: one line says which to upgrade, and nothing else
happens. What the earlier ones say was recorded of them."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from helpers.hellos import hello_of
from helpers.recorded_traffic import VERSIONS, Message, traffic

from share.config import Config, EdgeConfig
from share.errors import VersionError
from share.protocol import agent_events as ev
from share.protocol import edge_events as ed
from share.protocol.agent import AgentProtocol
from share.protocol.common_events import Connected, EdgeMessageReceived, FailRun, PrintLine, SendToEdge
from share.protocol.edge import EdgeProtocol
from share.protocol.remote_tracking import TrackingEdge
from share.protocol.streaming import StreamingAgent
from share.types import TrackState
from share.wire import messages as m
from share.wire.codec import WIRE_VERSION, decode, encode

S = 1_000_000_000
HELLO = hello_of("ann", 0xA000B)
PING, REFUSED = 5, 17
OLD = [version for version in VERSIONS if version < WIRE_VERSION]

pytestmark = pytest.mark.parametrize("old", OLD)


def edges() -> list[EdgeProtocol]:
    return [EdgeProtocol(Config(), 7), TrackingEdge(Config(edge=EdgeConfig(policy="streamed")), 7)]


def ups(old: int) -> list[Message]:
    return [message for message in traffic(old) if message.way == "up"]


def sends(effects: list[ed.EdgeEffect]) -> list[ed.SendToPeer]:
    return [effect for effect in effects if isinstance(effect, ed.SendToPeer)]


def test_every_kind_of_message_was_recorded(old: int) -> None:
    assert {message.code for message in traffic(old)} >= {*range(1, 8), *range(16, 23)}


def test_each_message_of_an_older_agent_is_refused_in_its_own_version(old: int) -> None:
    for edge in (edge for message in ups(old)[:1] for edge in edges()):
        for i, message in enumerate(ups(old)):
            effects = edge.handle(ed.PeerMessageReceived(i.to_bytes(8, "big"), message.frames), i * S)
            if message.code == PING:
                assert effects == []
                continue
            (answer,) = sends(effects)
            assert msgspec.msgpack.decode(answer.frames[0])[:2] == [old, REFUSED]
            refused = decode(answer.frames, (old,))
            assert isinstance(refused, m.Refused)
            assert refused.reason.endswith(
                f"(wire {WIRE_VERSION}), this agent speaks wire {old}: upgrade the agent"
            )
            assert "\n" not in refused.reason
        report = edge.report({})
        assert report["internal_errors"] == 0
        assert report["agents"] == {}
        assert report["unjoined"]["other_version"] == len(ups(old))


def test_an_older_agent_is_refused_at_a_low_rate(old: int) -> None:
    """The recorded messages, several in the time of a frame."""
    for edge in edges():
        said = [sends(edge.handle(ed.PeerMessageReceived(up.peer, up.frames), up.t_ns)) for up in ups(old)]
        agents, last_s = len({up.peer for up in ups(old)}), ups(old)[-1].t_ns / S
        assert agents <= sum(map(len, said)) <= agents * (1 + last_s / 2)


def test_the_refusal_is_recorded_and_reported(old: int) -> None:
    edge, frames = edges()[0], ups(old)[0].frames
    assert ups(old)[0].code != PING
    records = [
        effect.fields
        for i in range(30)
        for effect in edge.handle(ed.PeerMessageReceived(b"12345678", frames), 2 * i * S)
        if isinstance(effect, ed.WriteEvent)
    ]
    assert 1 <= len(records) <= 30
    assert {record["event"] for record in records} == {"refused"}
    (line,) = edge.report({})["refused"]
    assert f"this agent speaks wire {old}: upgrade the agent" in line


def frame(k: int) -> ev.FrameTracked:
    T = np.eye(4)
    T[0, 3] = 0.01 * k
    at = k * S // 10
    return ev.FrameTracked(k, at, at, at, TrackState.OK, T)


class OlderEdge:
    """Answers pings of its own version, as all edges do, and ignores every other."""

    def __init__(self, version: int) -> None:
        self.version = version

    def answer(self, frames: list[bytes], now_ns: int) -> list[bytes] | None:
        try:
            message = decode(frames, (self.version,))
        except VersionError:
            return None
        assert isinstance(message, m.Ping)
        pong = m.Pong(message.sequence, message.sent_ns, now_ns, now_ns, 99)
        return [bytes(frame) for frame in encode(pong, self.version)]


def run(agent: AgentProtocol, edge: OlderEdge | None, seconds: int) -> list[ev.AgentEffect]:
    """Run at ten frames a second; answers arrive at the next frame."""
    effects = agent.handle(Connected(), 0)
    inbox: list[list[bytes]] = []
    for k in range(10 * seconds):
        for event in (frame(k), ev.AgentTick(), *map(EdgeMessageReceived, inbox)):
            effects += agent.handle(event, k * S // 10)
        sent = [[bytes(f) for f in e.frames] for e in effects if isinstance(e, SendToEdge)]
        effects = [e for e in effects if not isinstance(e, SendToEdge)]
        inbox = [a for frames in sent if edge and (a := edge.answer(frames, k * S // 10)) is not None]
    return effects


def said(effects: list[ev.AgentEffect]) -> list[str]:
    return [effect.text for effect in effects if isinstance(effect, PrintLine)]


def poses(effects: list[ev.AgentEffect]) -> list[ev.LocalisedPose]:
    return [effect for effect in effects if isinstance(effect, ev.LocalisedPose)]


def test_an_agent_finds_that_the_edge_is_older_and_continues(old: int) -> None:
    agent = AgentProtocol(HELLO, Config())
    effects = run(agent, OlderEdge(old), 20)
    (line,) = said(effects)
    assert line.startswith(f"the edge speaks wire {old}, this SHARE ")
    assert line.endswith(f"wire {WIRE_VERSION}: upgrade the edge; tracking continues without the edge")
    assert len(poses(effects)) == 200
    assert not agent.report()["connected"]
    assert agent.report()["bad_messages"] == 0


def test_an_older_edge_is_found_within_two_seconds(old: int) -> None:
    assert len(said(run(AgentProtocol(HELLO, Config()), OlderEdge(old), 2))) == 1


def test_an_agent_joins_once_the_edge_is_upgraded(old: int) -> None:
    agent = AgentProtocol(HELLO, Config())
    run(agent, OlderEdge(old), 5)
    welcome = [bytes(f) for f in encode(m.Welcome(8, 0))]
    assert said(agent.handle(EdgeMessageReceived(welcome), 6 * S)) == ["connected to the edge"]
    assert agent.is_connected


def test_an_edge_of_this_version_is_not_taken_for_an_older_one(old: int) -> None:
    """An edge that starts trackers is slow to welcome: pings of older versions reach it before."""
    agent, edge, answers = StreamingAgent(replace(HELLO, streams_frames=True), Config()), edges()[1], []
    agent.handle(Connected(), 0)
    for k in range(100):
        now_ns = k * S // 10
        for effect in agent.handle(ev.AgentTick(), now_ns):
            if isinstance(effect, SendToEdge):
                received = ed.PeerMessageReceived(m.peer_id(HELLO.run_id), [bytes(f) for f in effect.frames])
                answers += sends(edge.handle(received, now_ns))
    assert edge.report({})["unjoined"]["other_version"] >= 30
    assert answers == []


def test_messages_of_an_older_edge_change_nothing(old: int) -> None:
    agent = AgentProtocol(HELLO, Config())
    effects = run(agent, None, 5)
    downs = [message for message in traffic(old) if message.way == "down"]
    for message in downs:
        effects += agent.handle(EdgeMessageReceived(message.frames), 5 * S)
    assert not [
        effect for effect in effects if isinstance(effect, (FailRun, ev.CloseLink, ev.CorrectionApplied))
    ]
    report = agent.report()
    assert (report["connected"], report["corrections"], report["map_id"]) == (False, 0, None)
    pongs = sum(message.code == 21 for message in downs)
    assert report["bad_messages"] == len(downs) - pongs
    assert len(said(effects)) == 2  # that no edge answers yet, and that it does not understand


def test_stable_messages_are_the_same_in_every_version(old: int) -> None:
    """Byte for byte after the version: their layout must not change."""
    by_code = {message.code: message for message in traffic(old)}
    for code, kind in ((PING, m.Ping), (21, m.Pong), (REFUSED, m.Refused)):
        frames = by_code[code].frames
        message = decode(frames, (old,))
        assert isinstance(message, kind)
        assert [bytes(f) for f in encode(message, old)] == frames
