"""Totals over restarts of the mapper."""

from __future__ import annotations

from typing import Any

from helpers.hellos import hello_of

from share.cli.edge_output import run_summary
from share.config import Config
from share.mapping.mapper import Mapper
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import AddRun, PeerMessageReceived
from share.protocol.edge_records import SessionTotals
from share.runtime import edge_metrics
from share.wire import messages as m
from share.wire.codec import encode


def life(session: int, poses: int, solves: int) -> dict[str, Any]:
    """The report of an edge with so many messages of ann and of an unjoined peer, and so many solutions."""
    edge, mapper = EdgeProtocol(Config(), session), Mapper(Config())

    def tell(run_id: int, message: m.Message) -> None:
        for effect in edge.handle(
            PeerMessageReceived(m.peer_id(run_id), [bytes(f) for f in encode(message)]), 10**9
        ):
            if isinstance(effect, AddRun):
                mapper.add_run(effect.key, effect.hello)

    tell(1, hello_of("ann", 1))
    for _ in range(poses):
        tell(1, m.Bye())
        tell(1, hello_of("ann", 1))
    tell(9, m.Evaluation(0, 1.0, None))
    report = edge.report(mapper.report())
    report["solve_ms"] |= {"n": solves}
    report["loops"] |= {"tried": solves}
    return report


def numbers(report: dict[str, Any], path: str) -> float:
    for key in path.split("."):
        report = report[key]
    return report  # type: ignore[return-value]


def test_the_first_session_has_no_earlier_counts() -> None:
    report = life(1, 3, 5)
    assert SessionTotals().with_totals(report) == report


def test_counts_continue_after_a_restart_of_the_mapper() -> None:
    totals, before, now = SessionTotals(), life(1, 3, 5), life(2, 1, 2)
    totals.add_session(totals.with_totals(before))
    added = totals.with_totals(now)
    for path in ("agents.ann.bytes_up", "unjoined.unexpected", "solve_ms.n", "loops.tried"):
        assert numbers(added, path) == numbers(before, path) + numbers(now, path) > numbers(now, path), path
    assert added["session"] == 2
    assert added["agents"]["ann"]["state"] == now["agents"]["ann"]["state"]
    totals.add_session(added)
    assert numbers(totals.with_totals(now), "loops.tried") == 5 + 2 + 2


def test_earlier_counts_are_reported_before_the_next_mapper_reports() -> None:
    totals, before = SessionTotals(), life(1, 3, 5)
    totals.add_session(totals.with_totals(before))
    silent = EdgeProtocol(Config(), 2).report({})
    added = totals.with_totals(silent)
    assert (added["loops"], added["solve_ms"]) == ({"tried": 5, "accepted": 0}, {"n": 5})
    assert "loops: 5 tried, 0 accepted; 0 merges" in run_summary(added)  # it ended in a KeyError
    assert b"share_edge_loops_tried_total" not in edge_metrics.render_metrics(added)[0]  # of no agent
    assert added["agents"] == {}


def test_another_run_of_a_name_counts_separately() -> None:
    totals, before, now = SessionTotals(), life(1, 3, 5), life(2, 1, 2)
    before["agents"]["ann"]["run"] = "ann-ffff"
    totals.add_session(totals.with_totals(before))
    assert totals.with_totals(now)["agents"] == now["agents"]


def test_the_counts_of_an_agent_survive_a_session_without_it() -> None:
    totals, heard = SessionTotals(), life(1, 3, 5)
    totals.add_session(totals.with_totals(heard))
    totals.add_session(totals.with_totals(EdgeProtocol(Config(), 2).report({})))
    added = totals.with_totals(life(3, 3, 5))
    assert numbers(added, "agents.ann.bytes_up") == 2 * numbers(heard, "agents.ann.bytes_up")
