"""Evaluations in, rates out: what an edge tells its agents to send, by policy."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.hellos import hello_of, rig_of

from share.config import Config, ControlConfig, EdgeConfig
from share.geometry import se3
from share.protocol import edge_events as ed
from share.protocol.edge import Edge
from share.scheduling.merge_gate import MergeGate
from share.scheduling.policies import POLICIES
from share.scheduling.qoe import QoeParameters, qoe
from share.types import AgentKind
from share.wire import messages as m
from share.wire.codec import decode, encode

MS = 1_000_000
CONTROL = ControlConfig(ar_target=0.8)


def welcomed(policy: str, kind: AgentKind = AgentKind.AR) -> Edge:
    edge = Edge(Config(edge=EdgeConfig(policy=policy), control=CONTROL), session=7)
    edge.handle(ed.PeerMessageReceived(b"a", encode(hello_of("ann", 5, kind))), 0)
    return edge


def rates(edge: Edge, delay_ms: float, error_cm: float | None, now_ms: int) -> list[float]:
    told = encode(m.Evaluation(0, delay_ms, error_cm))
    effects = edge.handle(ed.PeerMessageReceived(b"a", told), now_ms * MS)
    said = [decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, ed.SendToPeer)]
    return [message.hz for message in said if isinstance(message, m.Rate)]


def test_without_a_limit_nothing_is_told_but_quality_is_written_down() -> None:
    edge = welcomed("covins-g")
    assert rates(edge, 50.0, 0.5, 10) == []
    told = edge.report({})["agents"]["ann"]
    assert told["rate_hz"] is None
    assert told["qoe"] == pytest.approx(
        qoe(50.0, 0.5, QoeParameters.from_config(CONTROL, AgentKind.AR)), abs=1e-4
    )


def test_each_evaluation_is_answered_and_none_is_forgotten() -> None:
    edge = welcomed("share")
    told = [rates(edge, 15.0, error, 200 * i) for i, error in enumerate((0.3, 0.3, 0.3, 2.0, 2.0))]
    assert [len(each) for each in told] == [1] * 5
    content, wanting = [hz for (hz,) in told[:3]], [hz for (hz,) in told[3:]]
    assert content == sorted(content, reverse=True) and content[-1] < CONTROL.rate_max_hz
    assert wanting[0] > content[-1]
    series = edge.series()["ann"]
    assert series["t_s"] == [0.0, 0.2, 0.4, 0.6, 0.8]
    assert series["error_cm"] == [0.3, 0.3, 0.3, 2.0, 2.0]
    assert series["rate_hz"] == pytest.approx([hz for (hz,) in told], abs=1e-4)


def test_a_new_run_begins_anew() -> None:
    edge = welcomed("share")
    for i in range(20):
        (last,) = rates(edge, 15.0, 0.1, 200 * i)
    edge.handle(ed.PeerMessageReceived(b"a", encode(m.Bye())), 4000 * MS)
    edge.handle(ed.PeerMessageReceived(b"b", encode(hello_of("ann", 6))), 4001 * MS)
    reported = edge.report({})["agents"]
    assert [agent["qoe"] for agent in reported.values()] == [None, None]  # the new run's, and the old one's
    effects = edge.handle(ed.PeerMessageReceived(b"b", encode(m.Evaluation(0, 15.0, 0.1))), 4100 * MS)
    (first,) = [decode([bytes(f) for f in e.frames]).hz for e in effects if isinstance(e, ed.SendToPeer)]
    assert first > last


def test_what_adds_little_is_skipped_once_there_is_something_to_compare_with() -> None:
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


def test_each_is_judged_by_its_own_field_of_view_from_where_its_camera_is() -> None:
    """One who sees half as far to the side sees a quarter, all of which the other sees too."""
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
def test_a_calibration_that_cannot_be_does_not_stop_the_edge(focal: float) -> None:
    gating, rig = MergeGate(CONTROL, "share"), rig_of(focal)
    assert 0 < gating.overlap_volume(rig, rig, np.eye(4)) < 1e5


@pytest.mark.parametrize("policy", [name for name, kind in POLICIES.items() if not kind.has_merge_gate])
def test_who_gates_nothing_skips_nothing(policy: str) -> None:
    gating = MergeGate(CONTROL, policy)
    gating.record_merge(100.0)
    assert gating.overlap_volume(rig_of(), rig_of(), np.eye(4)) == 0
    assert not any(gating.skip_reason(0.0, same_map=True) for _ in range(50))
