"""The edge with real agents, real place recognition and a real solver, in virtual time."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from helpers.edge_sim import MS, ModelRun, Person, Town, walls
from helpers.hellos import hello_of
from helpers.reports import recorded_reports

from share.config import AgentQoe, Config, ControlConfig, EdgeConfig
from share.geometry import se3
from share.mapping import query_queue
from share.mapping.candidates import MAX_BACKLOG_CANDIDATES, MAX_VERIFIED
from share.mapping.corrections import MapEvent, map_assignment
from share.mapping.graph.solver import PoseGraphSolver
from share.mapping.mapper import Mapper
from share.mapping.recognition.verification import Refusal, Verification
from share.mapping.steps import QueryStep, SolveStep, VerifyStep
from share.protocol import admission
from share.protocol import agent_events as ev
from share.protocol import edge_events as ed
from share.protocol.common_events import PrintLine, Tick
from share.protocol.edge import EdgeProtocol
from share.types import AgentKind
from share.wire import messages as m
from share.wire.codec import decode, encode

ROOM = walls(1)


def town(**changes) -> Town:
    return Town([Person("ann", ROOM, 0.0, 11), Person("bob", ROOM, 0.5, 22)], **changes)


def sent(effects: list[ed.EdgeEffect], kind: type) -> list:
    messages = [decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, ed.SendToPeer)]
    return [message for message in messages if isinstance(message, kind)]


@pytest.fixture(scope="module")
def joined() -> Town:
    """Ann and Bob after 6 s in the same room, Bob half a wall ahead."""
    both = town()
    both.walk(24)
    both.run(500)
    return both


@pytest.mark.long
def test_two_agents_share_a_map(joined):
    maps = {name: joined.event(ev.LocalisedPose, name)[-1].map_id for name in ("ann", "bob")}
    assert len(set(maps.values())) == 1
    ann, bob = joined.people[joined.peer("ann")], joined.people[joined.peer("bob")]
    T_world_map = ann.T_world_body[0] @ se3.inverse(ann.T_odom_body[0])
    if not next(iter(maps.values())).startswith("ann"):
        T_world_map = bob.T_world_body[0] @ se3.inverse(bob.T_odom_body[0])
    assert joined.map_error_m("ann", T_world_map) < 0.06
    assert joined.map_error_m("bob", T_world_map) < 0.06


@pytest.mark.long
def test_corrections_answer_keyframes_and_have_reasons(joined):
    corrections = [r for r in joined.records if r["event"] == "correction"]
    assert len(corrections) > 4
    assert all(r["reason"] and r["map_id"] and r["agent"] for r in corrections)
    answered = [c for c in joined.event(ev.CorrectionApplied, "bob") if c.corrected_ms is not None]
    assert answered
    # 2 ms up, place and verification and solution of 5 ms each, 2 ms down; others may be before us
    assert all(19 <= c.corrected_ms < 200 for c in answered)
    revisions = [c.revision for c in joined.event(ev.CorrectionApplied, "bob")]
    assert revisions == sorted(set(revisions))


@pytest.mark.long
def test_every_refusal_has_a_reason(joined):
    for record in joined.records:
        assert record["reason"], record
    kinds = Counter(r["event"] for r in joined.records)
    assert kinds["maps merged"] == 1
    assert kinds["loop not accepted"] >= 1  # the first witness waits


@pytest.mark.long
def test_the_report_counts_keyframes_loops_and_merges(joined):
    report = joined.edge.report()
    ann = report["agents"]["ann"]
    assert ann["keyframes"] == 24
    assert ann["poses"] > 0
    assert report["loops"]["accepted"] == sum(a["loops"]["accepted"] for a in report["agents"].values()) > 0
    assert 48 < report["place_ms"]["n"] < 60  # some of bob's again, while it waits to enter ann's map
    assert report["failed_steps"] == 0
    assert sum(report["maps"].values()) == 48


def test_maps_of_different_rooms_are_never_merged():
    apart = Town([Person("ann", ROOM, 0.0, 11), Person("bob", walls(2), 0.0, 22)])
    apart.walk(20)
    assert len(apart.edge.report()["maps"]) == 2
    assert not [r for r in apart.records if r["event"] == "maps merged"]


@pytest.mark.long
def test_same_events_same_effects():
    a, b = town(), town()
    a.walk(8)
    b.walk(8)
    assert a.records == b.records
    assert a.edge.report() == b.edge.report()


@pytest.mark.long
def test_an_edge_without_map_gets_the_keyframes_again_and_merges_again(joined):
    again = town()
    again.walk(16)
    again.edge = None
    odometry = len(again.event(ev.LocalisedPose, "ann"))
    again.walk(4)
    assert len(again.event(ev.LocalisedPose, "ann")) == odometry + 4
    again.edge = ModelRun(again.config, session=2)
    again.walk(24)
    again.run(2000)
    report = again.edge.report()
    assert [a["keyframes"] for a in report["agents"].values()] == [44, 44]
    assert len(report["maps"]) == 1
    assert {again.event(ev.LocalisedPose, n)[-1].map_id for n in ("ann", "bob")} == set(report["maps"])
    said = [e.text for e in again.event(PrintLine, "ann")]
    assert sum("restarted" in text for text in said) == 1


@pytest.mark.long
def test_a_restarted_agent_is_a_new_run_in_its_old_map():
    first = town()
    first.walk(16)
    first.vanish("bob")
    first.run(4000)  # silence: the name is free again
    first.arrive(Person("bob", ROOM, 0.6, 33))
    first.walk(16)
    first.run(500)
    report = first.edge.report()
    assert len(report["maps"]) == 1
    assert any(r["event"] == "silent" and r["agent"] == "bob" for r in first.records)
    assert {name: a["keyframes"] for name, a in report["agents"].items()} == {
        "ann": 32,
        f"bob/{m.public_tag(22)[:4]}": 16,
        "bob": 16,
    }


@pytest.mark.parametrize("silent_ms", [500, 3500])  # not noticed by the edge; noticed, before they meet
@pytest.mark.long
def test_a_reconnected_agent_gets_the_newest_correction(silent_ms):
    both = town()
    both.walk(12)
    peer, before = both.peer("bob"), len(both.event(ev.CorrectionApplied, "bob"))
    agent = both.agents.pop(peer)  # its network is down
    both.run(silent_ms)
    both.walk(12, ["ann"])  # who follows bob and sees what bob saw
    both.agents[peer] = agent
    both.run(4000)
    assert len(both.event(ev.CorrectionApplied, "bob")) == before + 1
    assert both.event(ev.LocalisedPose, "bob")[-1].map_id is not None
    newest = {n: both.event(ev.CorrectionApplied, n)[-1].map_id for n in ("ann", "bob")}
    assert newest["ann"] == newest["bob"]


# ---------------------------------------------------------------- the protocol, message by message


def hello(name: str = "ann", run_id: int = 1) -> m.Hello:
    return hello_of(name, run_id)


def tell(edge: EdgeProtocol, run_id: int, message: m.Message, now_ms: float = 0) -> list[ed.EdgeEffect]:
    frames = [bytes(f) for f in encode(message)]
    return edge.handle(ed.PeerMessageReceived(m.peer_id(run_id), frames), round(now_ms * MS))


def test_a_name_in_use_is_refused_until_its_run_is_silent():
    edge = EdgeProtocol(Config(), 7)
    assert sent(tell(edge, 1, hello()), m.Welcome) == [m.Welcome(7, 0)]
    refused = tell(edge, 2, hello(run_id=2), 100)
    assert "in use" in sent(refused, m.Refused)[0].reason
    assert sent(tell(edge, 1, hello(), 200), m.Welcome)  # the holder itself is welcome again
    assert sent(tell(edge, 2, hello(run_id=2), 200 + 3100), m.Welcome)


def test_the_mapper_gets_the_presence_of_runs():
    edge = EdgeProtocol(Config(), 7)
    tell(edge, 1, hello())
    told = [
        [e.is_present for e in effects if isinstance(e, ed.SetPresence)]
        for effects in (
            tell(edge, 1, m.Ping(1, 1), 100),
            edge.handle(Tick(), 3500 * MS),
            edge.handle(Tick(), 3600 * MS),
            tell(edge, 1, m.Ping(2, 2), 4000),
            tell(edge, 1, m.Bye(), 4100),
        )
    ]
    assert told == [[], [False], [], [True], [False]]


def test_a_name_is_free_at_once_after_a_bye():
    edge = EdgeProtocol(Config(), 7)
    tell(edge, 1, hello())
    tell(edge, 1, m.Bye(), 10)
    assert sent(tell(edge, 2, hello(run_id=2), 20), m.Welcome)


def test_the_scheduler_knows_who_shares_a_map_with_somebody(monkeypatch):
    reports = recorded_reports(monkeypatch)
    edge = EdgeProtocol(Config(edge=EdgeConfig(policy="share")), 7)

    def evaluate() -> bool:
        tell(edge, 1, m.Evaluation(0, 50.0, 1.0))
        return reports[-1].is_placed

    def join(name: str, run_id: int) -> str:
        return next(e.key for e in tell(edge, run_id, hello(name, run_id)) if isinstance(e, ed.AddRun))

    def assign(run: str, map_id: str) -> None:
        edge.handle(ed.MapperResult((map_assignment(run, map_id, np.eye(4), 0),), (), ()), 0)

    ann = join("ann", 1)
    assert evaluate()  # nobody else is there
    bob = join("bob", 2)
    assert not evaluate()
    assign(ann, f"{ann}/0")
    assign(bob, f"{bob}/0")
    assert not evaluate()
    assign(bob, f"{ann}/0")
    assert evaluate()
    tell(edge, 2, m.Bye())
    assert evaluate()


def test_max_agents_is_kept():
    config = Config()
    edge = EdgeProtocol(replace(config, edge=replace(config.edge, max_agents=2)), 7)
    tell(edge, 1, hello("a", 1))
    tell(edge, 2, hello("b", 2))
    assert "2 agents" in sent(tell(edge, 3, hello("c", 3)), m.Refused)[0].reason
    tell(edge, 1, m.Bye())
    assert sent(tell(edge, 3, hello("c", 3)), m.Welcome)


def test_unjoined_peers_get_a_pong_and_nothing_else():
    edge = EdgeProtocol(Config(), 7)
    pong = sent(tell(edge, 5, m.Ping(3, 42), 9), m.Pong)
    assert pong == [m.Pong(3, 42, 9 * MS, 9 * MS, m.NO_SESSION)]  # of session 7 it knows nothing yet
    assert not sent(tell(edge, 5, m.Evaluation(0, 1.0, None)), m.Message)
    assert edge.report({})["unjoined"]["unexpected"] == 1


def test_a_run_that_was_forgotten_before_its_first_keyframe_says_hello_again(monkeypatch):
    """By a pong of the session that it knows it would send on, and be refused everything, for ever."""
    monkeypatch.setattr(admission, "_MAX_IDLE", 1)
    edge = EdgeProtocol(Config(), 7)
    tell(edge, 1, hello("ann", 1))
    edge.handle(Tick(), 5000 * MS)  # she is silent
    tell(edge, 2, hello("bob", 2), 5000)
    assert "ann" not in edge.report({})["agents"]
    (pong,) = sent(tell(edge, 1, m.Ping(1, 1), 5001), m.Pong)
    assert pong.session == m.NO_SESSION
    (welcome,) = sent(tell(edge, 1, hello("ann", 1), 5002), m.Welcome)
    (pong,) = sent(tell(edge, 1, m.Ping(2, 1), 5003), m.Pong)
    assert pong.session == welcome.session == 7


def test_malformed_messages_are_counted_and_recorded_once():
    edge = EdgeProtocol(Config(), 7)
    tell(edge, 1, hello())
    records = []
    for k in range(1000):
        effects = edge.handle(ed.PeerMessageReceived(m.peer_id(1), [b"\x00" * (k % 50)]), k)
        records += [e for e in effects if isinstance(e, ed.WriteEvent)]
    assert len(records) == 1
    assert edge.report({})["agents"]["ann"]["bad_messages"] == 1000
    assert sent(tell(edge, 1, m.Ping(1, 1), 1), m.Pong)


def test_a_keyframe_is_applied_once_and_in_order():
    both = town()
    both.walk(6)
    edge, entries = EdgeProtocol(Config(), 7), both.keyframes("ann")[:4]
    tell(edge, 11, hello(run_id=11))
    acks = [sent(tell(edge, 11, entries[k]), m.Ack)[0] for k in (1, 0, 1, 3, 2)]
    assert [ack.next_keyframe for ack in acks] == [0, 2, 2, 2, 4]
    assert acks[0].buffered == (1,)
    assert edge.report({})["agents"]["ann"]["keyframes"] == 4


def test_a_step_that_fails_costs_its_keyframe_only():
    both = town()
    both.walk(1)
    mapper = Mapper(Config())
    mapper.add_run("ann-000b", hello(run_id=11))
    mapper.add_keyframe("ann-000b", both.keyframes("ann")[0])
    look = mapper.next_lookup()
    (map_event,) = mapper.finish_step(look, MemoryError("no room"), 1.0)
    assert (map_event.event, map_event.agent) == ("step failed", "ann-000b")
    assert "no room" in map_event.reason
    assert mapper.report()["failed_steps"] == 1
    assert mapper.next_lookup() is None


def two_maps() -> Mapper:
    """Ann's map and Bob's, both due to be solved."""
    both, mapper = town(), Mapper(Config())
    both.walk(1)
    for name, run_id in (("ann", 11), ("bob", 22)):
        mapper.add_run(f"{name}-1", hello(name, run_id=run_id))
        mapper.add_keyframe(f"{name}-1", both.keyframes(name)[0])
    mapper.atlas.graph.unsolved_maps.update(dict.fromkeys(mapper.atlas.graph.odometry.live_segments))
    return mapper


def test_a_solution_that_fails_is_reported_under_its_map():
    """It is no agent's, also where all keyframes of the map are."""
    mapper, edge = two_maps(), EdgeProtocol(Config(), 7)
    tell(edge, 11, hello(run_id=11))
    map_events = []
    for text in ("no pivot", "no memory"):
        step = mapper.next_solve()
        map_events += mapper.finish_step(step, RuntimeError(text), 1.0)
    effects = edge.handle(ed.MapperResult(map_events), 2 * 10**9)
    lines = [effect.fields for effect in effects if isinstance(effect, ed.WriteEvent)]
    assert [(line["event"], line["agent"], line["map_id"]) for line in lines] == [
        ("step failed", None, "ann-1/0"),
        ("step failed", None, "bob-1/0"),
    ]
    assert lines[0]["reason"].startswith("map ann-1/0: solve: RuntimeError: no pivot")
    assert mapper.report()["failed_steps"] == 2


def test_a_map_that_cannot_be_prepared_for_the_solver_is_reported(monkeypatch):
    mapper = two_maps()
    make_job = mapper.atlas.solving.make_job

    def fails_for_ann(map_id):
        return make_job(map_id) if map_id == "bob-1/0" else [][0]

    monkeypatch.setattr(mapper.atlas.solving, "make_job", fails_for_ann)
    step = mapper.next_solve()
    assert step.job.map_id == "bob-1/0"
    (failure,) = mapper.take_events()
    assert (failure.event, failure.agent, failure.map_id) == ("step failed", None, "ann-1/0")
    assert not mapper.take_events()


def test_failures_of_one_map_do_not_hide_those_of_another():
    edge = EdgeProtocol(Config(), 7)
    failures = [MapEvent(None, "step failed", "map a/0: solve: x", map_id="a/0")] * 100
    edge.handle(ed.MapperResult(failures), 10**9)
    other = ed.MapperResult([MapEvent(None, "step failed", "map b/0: solve: x", map_id="b/0")])
    (line,) = edge.handle(other, 10**9)
    assert line.fields["map_id"] == "b/0"


def test_under_load_keyframes_are_stored_but_not_queried():
    slow = town(job_ms=4000)
    slow.walk(40)
    report = slow.edge.report()
    skipped = sum(a["queries_skipped"] for a in report["agents"].values())
    assert [a["keyframes"] for a in report["agents"].values()] == [40, 40]
    assert skipped > 0
    assert skipped + report["place_ms"]["n"] <= 80
    assert 80 - skipped - report["place_ms"]["n"] <= slow.config.edge.max_waiting + 2


@pytest.mark.slow
def test_skipped_keyframes_are_queried_later_and_merge_maps():
    """As after an outage: most keyframes are skipped at first, and queried later."""
    both, mapper = town(), Mapper(Config())
    both.walk(16)
    for run_id, name in enumerate(("ann", "bob"), start=11):
        mapper.add_run(name, hello(name, run_id=run_id))
        for keyframe in both.keyframes(name):
            mapper.add_keyframe(name, keyframe)
    looked, solver = 0, PoseGraphSolver()
    assert len(mapper.report()["maps"]) == 2
    while (step := mapper.next_lookup() or mapper.next_solve()) is not None:
        mapper.finish_step(step, step.run(solver) if isinstance(step, SolveStep) else step.run(), 1.0)
        looked += isinstance(step, QueryStep)
    assert len(mapper.report()["maps"]) == 1
    assert looked < 32  # once they are joined, what was passed over is left alone


@pytest.mark.parametrize(
    ("policy", "needs", "turns"),
    [
        ("covins-g", {}, "ababab"),
        ("equal", {}, "ababab"),
        ("share", {}, "aaaaba"),
        ("share", {"bob": AgentQoe(form="ar")}, "ababab"),
    ],
)
def test_headsets_are_queried_first_unless_the_policy_treats_agents_alike(policy, needs, turns, monkeypatch):
    monkeypatch.setattr(query_queue, "MAX_WAITING_EACH", 10)
    both = town()
    both.walk(10)
    config = Config(edge=EdgeConfig(policy=policy), control=ControlConfig(agents=needs))
    mapper, kinds = Mapper(config), {"ann": AgentKind.AR, "bob": AgentKind.ROBOT}
    for run_id, (name, kind) in enumerate(kinds.items()):
        mapper.add_run(name, replace(hello(name, run_id), kind=kind))
    for keyframes in zip(*(both.keyframes(name) for name in kinds), strict=True):
        for name, keyframe in zip(kinds, keyframes, strict=True):
            mapper.add_keyframe(name, keyframe)
    looked = ""
    for _ in range(6):
        query = mapper.next_lookup()
        mapper.finish_step(query, [], 1.0)
        looked += mapper.atlas.key(query.node_id).agent[0]
    assert looked == turns


@pytest.mark.long
def test_while_queries_wait_fewer_candidates_are_tried(monkeypatch):
    monkeypatch.setattr(query_queue, "MAX_WAITING_EACH", 12)
    both = town()
    both.walk(40)
    config = Config()
    tried, same = {}, Verification(np.eye(4), 1e-4 * np.eye(6), 40, 30)
    for waiting, refuse in itertools.product((0, query_queue.MIN_BACKLOG), (True, False)):
        mapper = Mapper(config)
        mapper.add_run("ann-000b", hello(run_id=11))
        keyframes = both.keyframes("ann")
        for keyframe in keyframes[: 28 - waiting]:
            mapper.add_keyframe("ann-000b", keyframe)
        while mapper.queries.next_query() is not None:
            pass
        for keyframe in keyframes[28 - waiting : 29]:  # the last is compared by its looks
            mapper.add_keyframe("ann-000b", keyframe)
        query = mapper.next_lookup()
        mapper.finish_step(query, query.run(), 1.0)
        tried[waiting, refuse] = 0
        while isinstance(verify := mapper.next_lookup(), VerifyStep):
            tried[waiting, refuse] += 1
            mapper.finish_step(verify, Refusal("not it") if refuse else same, 1.0)
    assert [tried[0, True], tried[0, False]] == [config.place.candidates, MAX_VERIFIED]
    assert [tried[query_queue.MIN_BACKLOG, True], tried[query_queue.MIN_BACKLOG, False]] == [
        MAX_BACKLOG_CANDIDATES,
        1,
    ]


@pytest.mark.long
def test_policy_share_sends_rates_and_skips_merges():
    both = town(config=Config(edge=EdgeConfig(policy="share")))
    both.walk(40)
    both.run(500)
    report = both.edge.report()
    merges = report["merges"]
    assert 0 < merges["skipped"] < merges["requested"]
    assert merges["done"] <= merges["requested"] - merges["skipped"]
    assert report["agents"]["ann"]["map_id"] == report["agents"]["bob"]["map_id"]
    for name in ("ann", "bob"):
        heard = both.agents[both.peer(name)].report()["rate_hz"]
        assert heard == pytest.approx(report["agents"][name]["rate_hz"], abs=1e-3)
