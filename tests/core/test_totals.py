"""Counts go on where the life before ended."""

from __future__ import annotations

from typing import Any

from hellos import hello_of

from share.config import Config
from share.mapping.mapper import Mapper
from share.protocol.edge import Edge
from share.protocol.edge_events import Join, Received
from share.protocol.edge_records import Totals
from share.runtime import status_metrics
from share.wire import messages as m
from share.wire.codec import encode


def life(session: int, poses: int, solves: int) -> dict[str, Any]:
    """The report of an edge that has heard ann so often, a stranger too, and solved so often."""
    edge, mapper = Edge(Config(), session), Mapper(Config())

    def tell(run_id: int, message: m.Message) -> None:
        for effect in edge.handle(Received(m.peer_id(run_id), [bytes(f) for f in encode(message)]), 10**9):
            if isinstance(effect, Join):
                mapper.join(effect.key, effect.hello)

    tell(1, hello_of("ann", 1))
    for _ in range(poses):
        tell(1, m.Bye())
        tell(1, hello_of("ann", 1))
    tell(9, m.Evaluation(0, 1.0, None))
    mapper._counts["solve"] = solves
    mapper._closed.loops_tried = solves
    return edge.report(mapper.report())


def numbers(report: dict[str, Any], path: str) -> float:
    for key in path.split("."):
        report = report[key]
    return report  # type: ignore[return-value]


def test_the_first_life_counts_for_itself() -> None:
    report = life(1, 3, 5)
    assert Totals().added(report) == report


def test_a_life_goes_on_where_the_one_before_it_ended() -> None:
    totals, before, now = Totals(), life(1, 3, 5), life(2, 1, 2)
    totals.ended(totals.added(before))
    added = totals.added(now)
    for path in ("agents.ann.bytes_up", "strangers.unexpected", "solve_ms.n", "loops.tried"):
        assert numbers(added, path) == numbers(before, path) + numbers(now, path) > numbers(now, path), path
    assert added["session"] == 2
    assert added["agents"]["ann"]["state"] == now["agents"]["ann"]["state"]
    totals.ended(added)
    assert numbers(totals.added(now), "loops.tried") == 5 + 2 + 2


def test_before_the_next_mapper_has_said_anything_they_are_there_too() -> None:
    totals, before = Totals(), life(1, 3, 5)
    totals.ended(totals.added(before))
    silent = Edge(Config(), 2).report({})
    added = totals.added(silent)
    assert (added["loops"], added["solve_ms"]) == ({"tried": 5}, {"n": 5})
    assert b"share_edge_loops_tried_total" not in status_metrics.text(added)[0]  # of no agent
    assert added["agents"] == {}


def test_another_run_of_a_name_counts_for_itself() -> None:
    totals, before, now = Totals(), life(1, 3, 5), life(2, 1, 2)
    before["agents"]["ann"]["run"] = "ann-ffff"
    totals.ended(totals.added(before))
    assert totals.added(now)["agents"] == now["agents"]


def test_an_agent_that_one_life_did_not_hear_goes_on_in_the_next() -> None:
    totals, heard = Totals(), life(1, 3, 5)
    totals.ended(totals.added(heard))
    totals.ended(totals.added(Edge(Config(), 2).report({})))
    added = totals.added(life(3, 3, 5))
    assert numbers(added, "agents.ann.bytes_up") == 2 * numbers(heard, "agents.ann.bytes_up")
