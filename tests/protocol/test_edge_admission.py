"""Admission: limits on new runs, and runs that return."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from helpers.hellos import hello_of
from helpers.reports import recorded_reports

from share.config import Config, EdgeConfig
from share.mapping.map_changes import SaveKeyframe, SaveRun
from share.protocol import edge_events as ed
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import SaveChanges
from share.protocol.keyframe_intake import OdometryBase
from share.protocol.peer import RestoredRun
from share.protocol.remote_tracking import TrackingCapacity, TrackingEdge
from share.scheduling.policies import POLICIES
from share.timing import TokenBuckets
from share.types import AgentKind, Keyframe, View
from share.wire import messages as m
from share.wire.codec import decode, encode

S = 1_000_000_000
EMPTY = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))


def keyframe(id: int) -> Keyframe:
    cov = 1e-6 * np.eye(6)
    return Keyframe(id, id - 1, 200 * id, np.eye(4), cov, np.eye(4), np.zeros(3), 0.0, EMPTY)


def tell(
    edge: EdgeProtocol, run_id: int, message: m.Message, now_s: float = 0, names: Iterable[str] | None = None
) -> list[ed.EdgeEffect]:
    """names: that its key is authorised for; None: no keys are used."""
    frames, owned = [bytes(frame) for frame in encode(message)], None if names is None else frozenset(names)
    key = "" if names is None else "its key"
    return edge.handle(ed.PeerMessageReceived(m.peer_id(run_id), frames, owned, key), round(now_s * S))


def come(edge: EdgeProtocol, name: str, run_id: int, now_s: float = 0) -> list[ed.EdgeEffect]:
    return tell(edge, run_id, hello_of(name, run_id), now_s)


def refusal(effects: list[ed.EdgeEffect]) -> str | None:
    messages = [decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, ed.SendToPeer)]
    return next((message.reason for message in messages if isinstance(message, m.Refused)), None)


def of(effects: list[ed.EdgeEffect], kind: type) -> list:
    return [effect for effect in effects if isinstance(effect, kind)]


def present(edge: EdgeProtocol) -> int:
    return sum(not agent["gone"] for agent in edge.report({})["agents"].values())


# ---------------------------------------------------------------- how often


@pytest.mark.long
def test_new_runs_of_one_name_are_limited() -> None:
    """130 runs a second of one name for 20 s, each with a bye: 8 and one each 10 s are admitted."""
    edge = EdgeProtocol(Config(), 7)
    for k in range(2600):
        come(edge, "eve", k, k / 130)
        tell(edge, k, keyframe(0), k / 130)
        tell(edge, k, m.Bye(), k / 130)
    assert len(edge.report({})["agents"]) == 9
    assert refusal(come(edge, "ann", -1, 20)) is None  # others come as before


def test_too_many_new_runs_are_refused_with_the_time_to_wait() -> None:
    edge = EdgeProtocol(Config(), 7)
    for k in range(8):
        assert refusal(come(edge, "eve", k, 1)) is None
        tell(edge, k, m.Bye(), 1)
    assert refusal(come(edge, "eve", 8, 2.5)) == "too many new runs of 'eve': try again in 9 s"
    assert refusal(come(edge, "eve", 8, 10.9)) is not None  # nor has it lost anything by asking too early
    assert refusal(come(edge, "eve", 8, 11.1)) is None


def test_new_runs_of_all_names_are_limited() -> None:
    edge = EdgeProtocol(Config(), 7)
    for k in range(128):
        assert refusal(come(edge, f"eve{k}", k)) is None
        tell(edge, k, m.Bye())
    assert refusal(come(edge, "ann", -1)) == "too many new runs of all agents: try again in 1 s"
    assert refusal(come(edge, "ann", -1, 0.6)) is None


@pytest.mark.long
def test_new_runs_of_one_key_do_not_keep_others_out() -> None:
    """100 names join and leave 50 times a second, for a minute."""
    edge, names, taken = EdgeProtocol(Config(), 7), [f"eve{k}" for k in range(100)], 0
    for k in range(3000):
        came = tell(edge, k, hello_of(names[k % 100], k), k / 50, names)
        reason = refusal(came)
        taken += reason is None
        tell(edge, k, m.Bye(), k / 50, names)
    assert 46 <= taken <= 32 + 60 // 4
    assert str(reason).startswith("too many new runs of the key of 'eve99': try again in ")
    assert refusal(tell(edge, -1, hello_of("ann", -1), 60, ["ann"])) is None


def test_a_run_whose_name_was_taken_from_its_key_is_refused() -> None:
    edge = EdgeProtocol(Config(), 7)
    assert refusal(tell(edge, 1, hello_of("zoe", 1), 0, ["zoe"])) is None
    assert not of(tell(edge, 1, keyframe(0), 1, ["yan"]), ed.SendToPeer)  # so it is silent, and says hello
    why = (
        "its key is authorized for 'yan', not for 'zoe'; on the edge run: share keys authorize … --agent zoe"
    )
    assert refusal(tell(edge, 1, hello_of("zoe", 1), 2, ["yan"])) == why
    zoe = edge.report({})["agents"]["zoe"]
    assert (zoe["keyframes"], zoe["refused_messages"]) == (0, 0)  # whoever it was, it was not zoe
    assert refusal(tell(edge, 1, hello_of("zoe", 1), 3, ["yan", "zoe"])) is None


def test_limits_of_old_names_take_no_memory() -> None:
    limits = TokenBuckets(8.0, 0.1)
    for k in range(2000):
        limits.bucket(f"eve{k}", k * S // 2).take(k * S // 2)
    assert len(limits) <= 2 * 10 + 1


def test_a_known_run_may_return_at_any_rate() -> None:
    known = [
        RestoredRun(f"bob-{k:04x}", hello_of("bob", 100 + k), OdometryBase(4, 0, np.eye(4)))
        for k in range(12)
    ]
    edge = EdgeProtocol(Config(), 7, has_store=True, restored=known)
    for _ in range(200):  # a hello that is repeated, and a reconnect
        assert refusal(come(edge, "ann", 1)) is None
    for k in range(12):  # of the map's file
        assert refusal(come(edge, "bob", 100 + k)) is None
        tell(edge, 100 + k, m.Bye())
    for k in range(8):
        assert refusal(come(edge, "bob", 200 + k)) is None
        tell(edge, 200 + k, m.Bye())
    tell(edge, 1, m.Bye())
    assert refusal(come(edge, "ann", 1)) is None


def test_a_refused_hello_does_not_count_as_a_new_run() -> None:
    edge = EdgeProtocol(Config(), 7)
    come(edge, "ann", 1)
    for _ in range(20):
        assert "in use" in str(refusal(come(edge, "ann", 2)))
    tell(edge, 1, m.Bye())
    assert refusal(come(edge, "ann", 2)) is None


def test_runs_without_a_keyframe_are_forgotten() -> None:
    edge = EdgeProtocol(Config(), 7, has_store=True)
    assert not of(come(edge, "ann", 1), SaveChanges)
    (keep,) = of(tell(edge, 1, keyframe(0)), SaveChanges)
    assert [type(change) for change in keep.changes] == [SaveRun, SaveKeyframe]
    (keep,) = of(tell(edge, 1, keyframe(1)), SaveChanges)
    assert [type(change) for change in keep.changes] == [SaveKeyframe]


# ---------------------------------------------------------------- who comes back


@pytest.mark.parametrize(
    "message",
    [m.Evaluation(0, 1000.0, 0.0), keyframe(0), m.Ping(1, 1), hello_of("hope", 1)],
    ids=lambda message: type(message).__name__,
)
def test_an_earlier_run_does_not_return_beside_the_present_one(message: m.Message) -> None:
    edge = EdgeProtocol(Config(), 7)
    come(edge, "hope", 1)
    tell(edge, 1, m.Bye())
    come(edge, "hope", 2)
    effects = tell(edge, 1, message, 1)
    asks = isinstance(message, m.Ping | m.Hello)  # what it may send many of is not answered
    assert ("in use" in str(refusal(effects))) == asks
    assert not of(effects, ed.SetPresence) + of(effects, ed.AddKeyframe)
    assert len(of(effects, ed.SendToPeer)) == asks
    assert present(edge) == 1
    assert sum(agent["refused_messages"] for agent in edge.report({})["agents"].values()) == 1
    assert sum(agent["evaluations"] for agent in edge.report({})["agents"].values()) == 0
    tell(edge, 2, m.Bye(), 2)
    assert refusal(tell(edge, 1, m.Ping(1, 1), 2)) is None
    assert present(edge) == 1


def test_a_run_that_left_returns_only_to_a_free_place() -> None:
    """The edge is full of runs of other names after a run has left."""
    config = Config()
    edge = EdgeProtocol(replace(config, edge=replace(config.edge, max_agents=4)), 7)
    for k in range(8):
        assert refusal(come(edge, f"eve{k}", k)) is None
        tell(edge, k, m.Bye())
    said = [refusal(tell(edge, k, m.Ping(1, 1))) for k in range(8)]
    assert said[:4] == [None] * 4
    assert all("already serves 4 agents" in str(reason) for reason in said[4:])
    assert present(edge) == 4


def test_a_silent_run_loses_its_name() -> None:
    """Also before the next tick of the edge."""
    edge = EdgeProtocol(Config(), 7)
    come(edge, "ann", 1)
    effects = come(edge, "ann", 2, 3.5)
    assert [(e.key, e.is_present) for e in of(effects, ed.SetPresence)] == [
        (f"ann-{m.public_tag(1)[:4]}", False)
    ]
    assert "in use" in str(refusal(tell(edge, 1, m.Ping(1, 1), 3.6)))
    assert present(edge) == 1


def test_a_killed_and_restarted_agent_joins_once_its_name_is_free() -> None:
    edge = EdgeProtocol(Config(), 7)
    come(edge, "ann", 1)
    tell(edge, 1, m.Ping(1, 1), 1)
    assert "in use" in str(refusal(come(edge, "ann", 2, 1.5)))  # it has a ping's time to answer for itself
    for now_s in (1.7, 2.2, 3.9):
        assert not of(come(edge, "ann", 2, now_s), ed.SendToPeer)
    welcome = come(edge, "ann", 2, 4.1)
    assert refusal(welcome) is None
    assert of(welcome, ed.AddRun)
    tell(edge, 2, m.Ping(1, 1), 5)
    assert not of(come(edge, "ann", 3, 5.8), ed.SendToPeer)
    tell(edge, 2, m.Ping(2, 2), 5.9)  # it was there all the time
    assert "in use" in str(refusal(come(edge, "ann", 3, 6.3)))


def test_a_repeated_bye_has_no_effect() -> None:
    edge = EdgeProtocol(Config(), 7)
    come(edge, "ann", 1)
    tell(edge, 1, m.Bye())
    assert tell(edge, 1, m.Bye()) == []


def test_no_tracker_starts_for_a_run_that_may_not_return() -> None:
    edge = TrackingEdge(Config(), 7, capacity=TrackingCapacity(1, "it is small"))
    for k, name in enumerate(("ann", "bob")):
        hello = replace(hello_of(name, k, AgentKind.AR), streams_frames=True)
        assert of(tell(edge, k, hello), ed.StartTracker)
        tell(edge, k, m.Bye())
    assert of(tell(edge, 0, m.Ping(1, 1)), ed.StartTracker)
    effects = tell(edge, 1, m.Ping(1, 1))
    assert "can track 1 streamed agent" in str(refusal(effects))
    assert not of(effects, ed.StartTracker)
    assert present(edge) == 1


# ---------------------------------------------------------------- a room that is full


class FullRoom(POLICIES["share"]):
    """Headsets have room in place of robots; after the first moment robots have none."""

    def objection(self, agent, kind, now_ns):
        return "no air for one more robot" if kind is AgentKind.ROBOT and now_ns > 0 else None

    def displaced(self, agent, kind, now_ns):
        return ("bob",) if agent == "carl" else ()


def robot(name, run_id):
    return hello_of(name, run_id, kind=AgentKind.ROBOT)


@pytest.fixture
def full_edge(monkeypatch):
    monkeypatch.setitem(POLICIES, "share", FullRoom)
    edge = EdgeProtocol(Config(edge=EdgeConfig(policy="share")), 7)
    come(edge, "ann", 1)
    tell(edge, 2, robot("bob", 2))
    return edge


def test_a_robot_that_finds_no_room_is_told_at_its_hello(full_edge):
    assert refusal(tell(full_edge, 3, robot("dora", 3), 0.1)) == "no air for one more robot"
    assert refusal(come(full_edge, "eve", 4, 0.2)) is None
    assert full_edge.report({})["refused"] == ["no air for one more robot"]
    assert refusal(tell(full_edge, 2, robot("bob", 2), 0.3)) is None  # it is there already


def test_a_headset_takes_the_place_of_a_robot(full_edge):
    assert refusal(come(full_edge, "carl", 3, 0.1)) == "no air left beside headsets: 'carl' has joined"
    agents = full_edge.report({})["agents"]
    assert agents["bob"]["gone"] and not agents["carl"]["gone"] and not agents["ann"]["gone"]
    assert refusal(tell(full_edge, 2, robot("bob", 2), 5.2)) == "no air for one more robot"


def test_a_full_room_is_recorded_once(full_edge):
    records = [
        effect.fields
        for k in range(5)
        for effect in tell(full_edge, 1, m.Evaluation(-1, 300.0, 1.0), k)
        if isinstance(effect, ed.WriteEvent)
    ]
    assert [(r["event"], r["reason"]) for r in records] == [("room full", "no air for one more robot")]


def evaluated(edge, kinds, seconds=12):
    """Agents of these kinds that a keyframe takes 60 ms of air, of 120 ms in all; evaluated every second."""
    for k, kind in enumerate(kinds):
        tell(edge, k + 1, hello_of(f"a{k}", k + 1, kind=kind))
        for number in range(2):
            tell(edge, k + 1, keyframe(number))
    for second in range(1, seconds + 1):
        for k in range(len(kinds)):
            told = m.Evaluation(-1, 120.0, 1.0, track_ms=10.0, rtt_ms=5.0, ack_ms=65.0)
            tell(edge, k + 1, told, second + 0.01 * k)
    return seconds + 0.5


def test_by_what_agents_report_a_headset_finds_room_in_place_of_robots_or_none():
    headset, bot = [AgentKind.AR], [AgentKind.ROBOT]
    few = EdgeProtocol(Config(), 7)
    now_s = evaluated(few, 8 * headset + 4 * bot)
    assert refusal(tell(few, 100, robot("late", 100), now_s)) is None

    crowded = EdgeProtocol(Config(), 7)
    now_s = evaluated(crowded, 15 * headset + 5 * bot)
    assert "no air for one more agent" in refusal(tell(crowded, 100, robot("late", 100), now_s))
    assert "no air left beside headsets" in refusal(come(crowded, "eve", 101, now_s))
    agents = crowded.report({})["agents"]
    assert not agents["eve"]["gone"]
    gone = [name for name, agent in agents.items() if agent["gone"]]
    assert gone == ["a16", "a17", "a18", "a19"]  # as few as make room, the newest

    full = EdgeProtocol(Config(), 7)
    now_s = evaluated(full, 20 * headset)
    assert "no air for one more agent" in refusal(come(full, "eve", 101, now_s))
    assert refusal(come(full, "eve", 101, now_s + 60)) is None  # all others have fallen silent


def test_policies_without_a_budget_turn_nobody_away():
    config = Config(edge=EdgeConfig(policy="covins-g"))
    edge = EdgeProtocol(config, 7)
    now_s = evaluated(edge, [AgentKind.AR] * 20)
    assert refusal(come(edge, "eve", 101, now_s)) is None


def test_the_edge_sees_how_long_a_keyframe_takes_to_arrive(monkeypatch):
    """From the message before it; of a copy, and of what arrives without one before, it learns nothing."""
    reports = recorded_reports(monkeypatch)
    edge = EdgeProtocol(Config(edge=EdgeConfig(policy="share")), 7)
    said = m.Evaluation(0, 50.0, 1.0)
    come(edge, "ann", 1, 0.0)
    tell(edge, 1, said, 1.0)
    tell(edge, 1, keyframe(0), 1.05)
    tell(edge, 1, keyframe(0), 1.3)  # again
    tell(edge, 1, said, 2.0)
    tell(edge, 1, m.Ping(1, 1), 2.03)
    tell(edge, 1, keyframe(1), 2.05)
    tell(edge, 1, said, 3.0)
    assert [report.arrival_ms for report in reports] == pytest.approx([0.0, 50.0, 20.0])
