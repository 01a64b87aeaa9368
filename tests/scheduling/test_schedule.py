"""By policy: rates that an edge sends for evaluations, history of evaluations, gated merges."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from helpers.hellos import hello_of, rig_of

from share.config import Config, ControlConfig, EdgeConfig
from share.geometry import se3
from share.protocol import edge_events as ed
from share.protocol.edge import EdgeProtocol
from share.scheduling.merge_gate import MergeGate
from share.scheduling.policies import POLICIES, AgentReport
from share.scheduling.qoe import QoeParameters, qoe
from share.scheduling.rate_scheduler import RateScheduler
from share.timing import RingBuffer
from share.types import AgentKind
from share.wire import messages as m
from share.wire.codec import decode, encode
from share.wire.messages import Evaluation

MS = 1_000_000
CONTROL = ControlConfig(ar_target=0.8)


def welcomed(policy: str, kind: AgentKind = AgentKind.AR) -> EdgeProtocol:
    edge = EdgeProtocol(Config(edge=EdgeConfig(policy=policy), control=CONTROL), session=7)
    edge.handle(ed.PeerMessageReceived(m.peer_id(5), encode(hello_of("ann", 5, kind))), 0)
    return edge


def rates(edge: EdgeProtocol, delay_ms: float, error_cm: float | None, now_ms: int) -> list[float]:
    told = encode(m.Evaluation(0, delay_ms, error_cm, rtt_ms=delay_ms))
    effects = edge.handle(ed.PeerMessageReceived(m.peer_id(5), told), now_ms * MS)
    said = [decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, ed.SendToPeer)]
    return [message.hz for message in said if isinstance(message, m.Rate)]


def test_without_a_limit_no_rate_is_sent_but_qoe_is_reported() -> None:
    edge = welcomed("covins-g")
    assert rates(edge, 50.0, 0.5, 10) == []
    told = edge.report({})["agents"]["ann"]
    assert told["rate_hz"] is None
    assert told["qoe"] == pytest.approx(
        qoe(50.0, 0.5, QoeParameters.from_config(CONTROL, AgentKind.AR)), abs=1e-4
    )


def test_each_evaluation_is_answered_and_recorded() -> None:
    edge = welcomed("share-paper")
    told = [rates(edge, 15.0, error, 200 * i) for i, error in enumerate((0.3, 0.3, 0.3, 2.0, 2.0))]
    assert [len(each) for each in told] == [1] * 5
    content, wanting = [hz for (hz,) in told[:3]], [hz for (hz,) in told[3:]]
    assert content == sorted(content, reverse=True) and content[-1] < CONTROL.rate_max_hz
    assert wanting[0] > content[-1]
    series = edge.series()["ann"]
    assert series["t_s"] == [0.0, 0.2, 0.4, 0.6, 0.8]
    assert series["error_cm"] == [0.3, 0.3, 0.3, 2.0, 2.0]
    assert series["rate_hz"] == pytest.approx([hz for (hz,) in told], abs=1e-4)


def test_a_new_run_starts_without_history() -> None:
    edge = welcomed("share-paper")
    told = [hz for i in range(20) for hz in rates(edge, 15.0, 0.1, 200 * i)]
    assert told == sorted(told, reverse=True) and len(told) < 20  # an unchanged rate is not sent again
    last = told[-1]
    edge.handle(ed.PeerMessageReceived(m.peer_id(5), encode(m.Bye())), 4000 * MS)
    edge.handle(ed.PeerMessageReceived(m.peer_id(6), encode(hello_of("ann", 6))), 4001 * MS)
    reported = edge.report({})["agents"]
    assert [agent["qoe"] for agent in reported.values()] == [None, None]  # the new run's, and the old one's
    effects = edge.handle(ed.PeerMessageReceived(m.peer_id(6), encode(m.Evaluation(0, 15.0, 0.1))), 4100 * MS)
    (first,) = [decode([bytes(f) for f in e.frames]).hz for e in effects if isinstance(e, ed.SendToPeer)]
    assert first > last


def test_merges_with_little_overlap_are_skipped_after_completed_ones() -> None:
    gating, rig = MergeGate(CONTROL, "share"), rig_of()
    same = gating.overlap_volume(rig, rig, np.eye(4))
    away = gating.overlap_volume(rig, rig, se3.exp(np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])))
    assert 0 < away < same
    assert not any(gating.skip_reason(away, same_map=True) for _ in range(50))
    for _ in range(CONTROL.merges):
        gating.record_merge(same)
    skipped = sum(bool(gating.skip_reason(away, same_map=True)) for _ in range(1000))
    chance = 1 - CONTROL.eagerness * away / same
    assert skipped == pytest.approx(1000 * chance, abs=4 * np.sqrt(1000 * chance * (1 - chance)))
    assert not any(gating.skip_reason(away, same_map=False) for _ in range(50))


def test_the_overlap_uses_each_agents_own_camera() -> None:
    """Half the slope each way is a quarter of the volume, all of which the wider camera sees too."""
    gating, wide, narrow = MergeGate(CONTROL, "share"), rig_of(focal=400.0), rig_of(focal=800.0)
    whole, part = (
        gating.overlap_volume(wide, wide, np.eye(4)),
        gating.overlap_volume(narrow, narrow, np.eye(4)),
    )
    assert part == pytest.approx(whole / 4)
    assert gating.overlap_volume(wide, narrow, np.eye(4)) == pytest.approx(part, rel=0.1)
    back = se3.exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    assert gating.overlap_volume(wide, rig_of(T_body_cam0=back), np.eye(4)) == 0
    assert gating.overlap_volume(wide, rig_of(T_body_cam0=back), back) == pytest.approx(whole)


@pytest.mark.parametrize("focal", [1.0, 1e5])
def test_the_gate_accepts_absurd_calibrations(focal: float) -> None:
    gating, rig = MergeGate(CONTROL, "share"), rig_of(focal)
    assert 0 < gating.overlap_volume(rig, rig, np.eye(4)) < 1e5


@pytest.mark.parametrize("policy", [name for name, kind in POLICIES.items() if not kind.has_merge_gate])
def test_policies_without_a_gate_skip_nothing(policy: str) -> None:
    gating = MergeGate(CONTROL, policy)
    gating.record_merge(100.0)
    assert gating.overlap_volume(rig_of(), rig_of(), np.eye(4)) == 0
    assert not any(gating.skip_reason(0.0, same_map=True) for _ in range(50))


@pytest.mark.parametrize("n", [0, 1, 4, 5, 6, 11, 23])
def test_the_ring_buffer_returns_the_newest_rows_in_order(n: int) -> None:
    history = RingBuffer(3, 5)
    rows = [(float(k), None if k % 3 else k / 7, -k) for k in range(n)]
    for row in rows:
        history.add(row)
    assert len(history) == min(n, 5)
    for k in range(3):
        assert history.column(k) == [row[k] for row in rows[-5:]]


def test_a_row_of_another_width_is_refused() -> None:
    with pytest.raises(ValueError, match="2 numbers, expected 3"):
        RingBuffer(3, 5).add((1.0, 2.0))


def test_the_history_of_an_agent_takes_little_memory() -> None:
    """5000 evaluations were 1.1 MB of objects an agent: the edge grew for an hour."""
    schedule, draw = RateScheduler(ControlConfig(), "share"), np.random.default_rng(1)
    told = [Evaluation(k, float(d), float(e)) for k, (d, e) in enumerate(draw.random((6000, 2)))]
    schedule.evaluate("ann", AgentReport(AgentKind.AR, told[0], 0), 0.0, 0.0)
    tracemalloc.start()
    for k, one in enumerate(told):
        schedule.evaluate("ann", AgentReport(AgentKind.AR, one, k * 10**9), 0.0, k + 0.5)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 600_000  # 8 bytes a number; a free list of the interpreter among it
    series = schedule.series("ann")
    assert series["t_s"] == [k + 0.5 for k in range(1000, 6000)]
    assert series["delay_ms"] == [round(one.delay_ms, 4) for one in told[1000:]]
