"""Comparison of two odometries: errors of one are detected, and correct ones show none."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from share.geometry import se3
from share.mapping.agents.agreement import AgentAgreement
from share.mapping.agents.pairwise import (
    AccumulatedOdometry,
    InterAgentLoop,
    compare_odometry,
    robust_depth_scale,
)
from share.mapping.graph.edges import PoseEdge
from share.mapping.recognition.depth_scale import DepthScale

STEP_COV = np.diag([2e-4**2] * 3 + [2e-3**2] * 3)
LOOP_COV = np.diag([4e-3**2] * 3 + [0.02**2] * 3)
FRAMES = 60


def ring(phase: float) -> list:
    """Poses around a room, with pitch."""
    out = []
    for k in range(FRAMES):
        angle = phase + 0.1 * k
        R = se3.so3_exp(np.array([0, 0, angle])) @ se3.so3_exp(np.array([0.3 * np.sin(k / 5), 0, 0]))
        out.append(se3.from_rt(R, np.array([3 * np.cos(angle), 2 * np.sin(angle), 1.5])))
    return out


def steps_of(poses: list, rng, scale: float = 1.0, drift: float = 1.0) -> list:
    out = []
    for before, after in itertools.pairwise(poses):
        step = se3.inverse(before) @ after
        step[:3, 3] *= scale
        out.append(step @ se3.exp(drift * np.sqrt(np.diag(STEP_COV)) * rng.standard_normal(6)))
    return out


def chain(steps: list, sure: float = 1.0) -> list[AccumulatedOdometry]:
    out = [AccumulatedOdometry.origin()]
    for step in steps:
        out.append(out[-1].with_step(step, sure * STEP_COV))
    return out


def loops(rng, turn: float = 0.0, sure: float = 1.0, **bad) -> list[InterAgentLoop]:
    """24 loops, two of them false, between a correct odometry and one with the errors in `bad`."""
    x, y = ring(0.0), ring(0.7)
    a, b = chain(steps_of(x, rng)), chain(steps_of(y, rng, **bad), sure)
    X = se3.exp(np.array([turn, 0, 0, 0, 0, 0]))
    out = []
    for n, j in enumerate(range(4, FRAMES - 8, 2)):
        i = min(FRAMES - 1, j + 7)
        noise = se3.exp(np.sqrt(np.diag(LOOP_COV)) * rng.standard_normal(6))
        T = se3.inverse(x[i]) @ y[j] @ noise @ X
        if n in (5, 11):
            T = T @ se3.exp(np.array([0.3, 0, 0, 1.0, 2.0, 0]))
        out.append(InterAgentLoop(a[i], b[j], se3.orthonormal(T), LOOP_COV))
    return out


@pytest.mark.parametrize("seed", range(20))
def test_correct_agents_show_no_difference(seed):
    found = compare_odometry(loops(np.random.default_rng(seed)))
    assert found.path_scale.significance < 3.5
    assert found.camera_rotation.significance < 4
    assert found.nis < 2
    assert found.inlier_share > 0.8


@pytest.mark.parametrize("scale", [0.95, 0.97, 1.03, 1.05])
@pytest.mark.parametrize("sure", [1.0, 0.01])
def test_a_path_scale_is_estimated(scale, sure):
    found = compare_odometry(loops(np.random.default_rng(3), scale=scale, sure=sure))
    assert found.path_scale.value == pytest.approx(np.log(scale), abs=3.5 * found.path_scale.sigma)
    assert found.path_scale.significance > 4.5


def test_a_camera_rotation_is_estimated():
    found = compare_odometry(loops(np.random.default_rng(4), turn=np.radians(4.0)))
    assert np.degrees(found.camera_rotation.value) == pytest.approx(4.0, abs=1.0)
    assert found.camera_rotation.significance > 4.5


@pytest.mark.long
def test_noise_of_an_overconfident_agent_is_no_camera_rotation_once_its_covariance_is_scaled():
    """Ten loops; odometry is ten times as noisy as stated."""
    found, as_claimed = [], []
    for seed in range(20):
        few = loops(np.random.default_rng(seed), drift=10.0)[:10]
        as_claimed.append(compare_odometry(few).camera_rotation)
        found.append(compare_odometry(few, (1.0, 100.0)).camera_rotation)
    assert max(turn.significance for turn in as_claimed) > 4.5
    assert max(turn.significance for turn in found) < 3


def test_scaled_covariances_hide_neither_a_camera_rotation_nor_a_path_scale():
    wide = compare_odometry(loops(np.random.default_rng(4), turn=np.radians(4.0)), (1.0, 4.0))
    assert np.degrees(wide.camera_rotation.value) == pytest.approx(4.0, abs=1.0)
    assert wide.camera_rotation.significance > 4.5
    long = loops(np.random.default_rng(3), scale=1.03)
    assert compare_odometry(long, (1.0, 100.0)).path_scale == compare_odometry(long).path_scale


def test_drift_beyond_the_stated_covariances_raises_the_nis():
    """6 cm a step, above the noise of the loops; below it, loops cannot show drift."""
    assert compare_odometry(loops(np.random.default_rng(5), drift=30.0, sure=0.01)).nis > 3


def test_loops_of_a_place_and_its_copy_are_no_noise():
    """Every second loop is of a copy 5 m off and turned by half a turn."""
    copy = se3.exp(np.array([0, 0, np.pi, 5.0, 1.0, 0]))
    for seed in range(5):
        mixed = [
            dataclasses.replace(x, T_a_b=se3.orthonormal(se3.inverse(x.a.T) @ copy @ x.a.T @ x.T_a_b))
            if n % 2
            else x
            for n, x in enumerate(loops(np.random.default_rng(seed)))
        ]
        assert compare_odometry(mixed).nis < 3


def test_depth_scales_are_pooled_robustly():
    rng = np.random.default_rng(1)
    scales = [DepthScale(0.05 + 0.005 * rng.standard_normal(), 0.005) for _ in range(12)] + [
        DepthScale(-0.3, 0.005)
    ]
    found = robust_depth_scale(scales)
    assert found.value == pytest.approx(0.05, abs=3 * found.sigma)
    assert found.sigma < 0.005


def town(scales: dict[str, float], pairs: list[tuple[str, str]]) -> tuple[AgentAgreement, list[bool]]:
    """Agents with these scales of their depths, with loops between these pairs."""
    agreement, rng, said = AgentAgreement(), np.random.default_rng(2), []
    nodes = {name: range(10 * i, 10 * i + 10) for i, name in enumerate(scales)}
    for name, numbers in nodes.items():
        for number in numbers:
            before = number - 1 if number > numbers[0] else None
            step = se3.from_rt(np.eye(3), np.array([0.3, 0, 0]))
            agreement.add_step(name, number, before, step, STEP_COV)
    for k in range(6):
        for a, b in pairs:
            edge = PoseEdge(nodes[a][k], nodes[b][k], np.eye(4), LOOP_COV)
            log = np.log(scales[b] / scales[a]) + 0.004 * rng.standard_normal()
            said.append(
                agreement.add_loop((a, b), (nodes[a][0], nodes[b][0]), edge, DepthScale(log, 0.004), None)
            )
    return agreement, said


THREE = [("ann", "bob"), ("eve", "ann"), ("bob", "eve")]


@pytest.mark.parametrize("liar", ["ann", "bob", "eve"])
@pytest.mark.parametrize("scale", [0.9, 0.95, 0.97, 1.03, 1.05])
def test_of_three_agents_the_wrong_one_is_quarantined(liar, scale):
    agreement, said = town({n: scale if n == liar else 1.0 for n in ("ann", "bob", "eve")}, THREE)
    assert agreement.quarantined == {liar}
    assert any(said)
    standing = agreement.standing(liar)
    assert standing.state == "quarantined"
    assert ("larger" if scale > 1 else "smaller") in standing.reason
    assert standing.log_scale == pytest.approx(np.log(scale), abs=0.015)
    honest = {"ann", "bob", "eve"} - {liar}
    assert all(agreement.standing(name).state == "agrees" for name in honest)
    assert agreement.separation_reason([liar], honest)
    assert not agreement.separation_reason(honest, honest)


def test_correct_agents_are_not_quarantined():
    agreement, said = town({"ann": 1.003, "bob": 1.0, "eve": 0.997}, THREE)
    assert not agreement.quarantined
    assert not agreement.disputed
    assert not any(said)


def test_two_agents_that_disagree_are_disputed():
    agreement, _ = town({"ann": 1.0, "eve": 1.05}, [("ann", "eve")])
    assert not agreement.quarantined
    assert agreement.disputed == {frozenset(("ann", "eve"))}
    assert "undetermined which" in agreement.standing("ann").reason
    assert "smaller" in agreement.standing("ann").reason
    assert "larger" in agreement.standing("eve").reason


@pytest.mark.long
def test_quarantine_ends_when_later_loops_agree():
    agreement, _ = town({"ann": 1.0, "eve": 1.04}, [("ann", "eve")])
    assert agreement.disputed
    for k in range(200):
        i, j = k % 10, k // 3 % 10
        edge = PoseEdge(i, 10 + j, se3.from_rt(np.eye(3), np.array([0.3 * (j - i), 0, 0])), LOOP_COV)
        agreement.add_loop(("ann", "eve"), (0, 10), edge, DepthScale(0.0, 0.004), None)
    assert not agreement.disputed
    assert not agreement.separation_reason(["ann"], ["eve"])
