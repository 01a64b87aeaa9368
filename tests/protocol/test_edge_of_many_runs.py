"""An edge that has known many runs: what its report lists, and that they cost nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from helpers.hellos import hello_of
from helpers.many_runs import hellos, plain_keyframe, stored_map, work_of

from share.config import Config, EdgeConfig
from share.protocol.common_events import Tick
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import ChangesSaved, EdgeEvent, PeerMessageReceived, SaveChanges
from share.protocol.peer import restored_runs
from share.wire import messages as m
from share.wire.codec import encode
from share.wire.messages import Hello, peer_id

NAMES, FEW, MANY = 30, 60, 240
LISTED = 4 + 16


class Edge:
    """An edge for four agents, whose map file has `count` runs of `names` names."""

    def __init__(self, count: int, names: int = NAMES) -> None:
        config = Config(edge=EdgeConfig(max_agents=4))
        self.protocol = EdgeProtocol(config, 7, True, restored_runs(stored_map(count, names), 1.0))
        self.now_ns = 0
        self.handle(Tick())

    def handle(self, event: EdgeEvent) -> list[Any]:
        self.now_ns += 10**7
        effects = self.protocol.handle(event, self.now_ns)
        for effect in effects:
            if isinstance(effect, SaveChanges):
                effects = [*effects, *self.handle(ChangesSaved(effect.ticket))]
        return effects

    def send(self, hello: Hello, *messages: m.UplinkMessage) -> list[Any]:
        id_ = peer_id(hello.run_id)
        frames = [[bytes(frame) for frame in encode(one)] for one in messages]
        return [effect for one in frames for effect in self.handle(PeerMessageReceived(id_, one))]

    def report(self) -> dict[str, Any]:
        return self.protocol.report({})


ZOE = hello_of("zoe", 1)


@pytest.mark.parametrize("names", [1, NAMES, MANY])
def test_a_report_lists_the_recent_runs_and_counts_the_rest(names: int) -> None:
    edge = Edge(MANY, names)
    report = edge.report()
    assert len(report["agents"]) <= LISTED
    assert report["unlisted_runs"] == MANY - len(report["agents"])
    edge.send(ZOE, ZOE)
    report = edge.report()
    assert not report["agents"]["zoe"]["gone"]
    assert report["unlisted_runs"] == MANY + 1 - len(report["agents"])
    newest = list(hellos(MANY, names))[-1]
    assert newest in {agent["run"] for agent in report["agents"].values()}


def ping(edge: Edge) -> None:
    edge.send(ZOE, m.Ping(1, 1))


def add_keyframe(edge: Edge) -> None:
    edge.send(ZOE, plain_keyframe(edge.protocol.knows(peer_id(ZOE.run_id)) or 0))


def join_and_leave(edge: Edge) -> None:
    other = hello_of("max", 2)
    edge.send(other, other, m.Bye())


WORK: dict[str, Callable[[Edge], Any]] = {
    "report": Edge.report,
    "tick": lambda edge: edge.handle(Tick()),
    "ping": ping,
    "keyframe": add_keyframe,
    "join": join_and_leave,
    "poses": lambda edge: edge.protocol.latest_poses(),
}


@pytest.mark.parametrize("names", [1, MANY])
@pytest.mark.parametrize("what", WORK)
def test_runs_that_are_gone_cost_nothing(what: str, names: int) -> None:
    def work(count: int) -> int:
        edge = Edge(count, min(names, count))
        edge.send(ZOE, ZOE, plain_keyframe(0))
        return work_of(lambda: WORK[what](edge))

    assert work(MANY) <= 1.05 * work(FEW) + 50


def test_one_that_comes_back_is_listed_again_and_goes_on() -> None:
    edge = Edge(MANY)
    key, hello = next(iter(hellos(MANY, NAMES).items()))

    def listed() -> dict[str, Any]:
        return {agent["run"]: agent for agent in edge.report()["agents"].values()}

    assert key not in listed()
    edge.send(hello, hello, plain_keyframe(1))
    assert edge.report()["agents"][hello.name]["run"] == key  # it is the latest of its name
    assert (listed()[key]["keyframes"], listed()[key]["gone"]) == (1, False)
    assert edge.protocol.knows(peer_id(hello.run_id)) == 2
    edge.send(hello, m.Bye())
    assert listed()[key]["gone"] and edge.report()["unlisted_runs"] == MANY - len(listed())
    for k in range(20):
        other = hello_of(f"other{k}", 100 + k)
        edge.now_ns += 10**10
        edge.send(other, other, plain_keyframe(0), m.Bye())
    assert key not in listed()
    edge.send(hello, hello, plain_keyframe(2))
    assert listed()[key]["keyframes"] == 2  # its counts went on


def test_one_that_is_gone_and_sends_what_is_refused_is_shown() -> None:
    edge = Edge(MANY)
    key, hello = next(iter(hellos(MANY, NAMES).items()))
    for _ in range(12):
        edge.handle(PeerMessageReceived(peer_id(hello.run_id), [b"nonsense"]))
    report = edge.report()
    assert key in {agent["run"] for agent in report["agents"].values()}
    assert any(f"agent '{hello.name}': 12 messages refused" in line for line in report["refused"])


def test_the_oldest_of_too_many_without_a_keyframe_is_forgotten() -> None:
    edge = Edge(1)
    for k in range(300):
        other = hello_of(f"n{k}", 100 + k)
        edge.now_ns += 10**10
        edge.send(other, other, m.Bye())
    report = edge.report()
    assert len(report["agents"]) + report["unlisted_runs"] == 256 + 1
    assert edge.protocol.knows(peer_id(100)) is None and edge.protocol.knows(peer_id(100 + 299)) == 0


def test_an_agent_that_vanished_stays_in_the_report_however_many_come_and_go() -> None:
    edge = Edge(0)
    edge.send(ZOE, ZOE)
    edge.now_ns += 14 * 10**9
    edge.handle(Tick())
    assert edge.report()["agents"]["zoe"]["trouble"]
    for hello in [hello_of(f"x{k}", k) for k in range(2, 120)]:
        edge.send(hello, hello, m.Bye())
    report = edge.report()
    assert report["agents"]["zoe"]["trouble"]
    assert report["unlisted_runs"] == 119 - len(report["agents"])
    edge.now_ns += 60 * 10**9
    edge.handle(Tick())
    assert "zoe" not in edge.report()["agents"]
