"""Loops show by how much an agent understates its covariances; others are not scaled."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from test_agent_consistency import FRAMES, LOOP_COV, STEP_COV, chain, ring, steps_of

from share.geometry import se3
from share.mapping.agents.agreement import AgentAgreement
from share.mapping.agents.covariance_scales import CovarianceScales, StatedCovariances
from share.mapping.agents.pairwise import (
    InterAgentLoop,
    comparison_equations,
    robust_depth_scale,
    solve_comparison,
)
from share.mapping.graph.edges import PoseEdge
from share.mapping.recognition.depth_scale import DepthScale

MOVED = se3.exp(np.array([0, 0, 0.05, 0.3, 0, 0]))
WALKERS = {"ann": 0.0, "bob": 0.7, "eve": 1.4}
DRIFT = 4.0  # by what all odometry is worse than STEP_COV, so that it shows beside the loops' noise


def walkers(seed: int, sure: float, rounds: int = 8) -> CovarianceScales:
    """Covariance scales of three agents around a room; eve's sigmas are too small by the factor `sure`."""
    rng, paths, walked = np.random.default_rng(seed), {}, {}
    for name, phase in WALKERS.items():
        paths[name] = ring(phase)
        scale = DRIFT**2 / (sure**2 if name == "eve" else 1.0)
        walked[name] = chain(steps_of(paths[name], rng, drift=DRIFT), scale)
    stated = stated_by({name: 1 / sure if name == "eve" else 1.0 for name in WALKERS})
    covariance_scales, evidence = CovarianceScales(stated), {}
    for n, (a, b) in enumerate((("ann", "bob"), ("ann", "eve"), ("bob", "eve"))):
        loops = []
        for j in range(4, FRAMES, 2):
            i = min(FRAMES - 1, j + 7)
            noise = se3.exp(np.sqrt(np.diag(LOOP_COV)) * rng.standard_normal(6))
            T = se3.orthonormal(se3.inverse(paths[a][i]) @ paths[b][j] @ noise)
            loops.append(InterAgentLoop(walked[a][i], walked[b][j], T, LOOP_COV))
        evidence[(n, n + 1)] = (a, b), comparison_equations(loops)
    for _ in range(rounds):
        for pair, (agents, equations) in evidence.items():
            weights = solve_comparison(equations).weights
            covariance_scales.set_evidence(pair, agents, equations, weights)
    return covariance_scales


def factors(seed: int, sure: float, rounds: int = 8) -> dict[str, float]:
    covariance_scales = walkers(seed, sure, rounds)
    return {name: covariance_scales.scales.get(name, 1.0) for name in WALKERS}


@pytest.mark.long
@pytest.mark.parametrize("sure", [3.0, 10.0])
def test_only_the_overconfident_agent_is_scaled(sure):
    found = np.array([list(factors(seed, sure).values()) for seed in range(2)])
    assert found[:, 2] == pytest.approx(sure**2, rel=0.6)
    assert found[:, :2].max() < 2.5


def test_correct_agents_are_not_scaled():
    found = [factors(seed, 1.0, rounds=3) for seed in range(3)]
    assert max(max(one.values()) for one in found) < 1.6


def test_few_loops_change_no_scale():
    covariance_scales = CovarianceScales()
    rng = np.random.default_rng(0)
    x, y = ring(0.0), ring(0.7)
    a, b = chain(steps_of(x, rng, drift=10.0)), chain(steps_of(y, rng, drift=10.0))
    loops = [InterAgentLoop(a[j + 7], b[j], se3.inverse(x[j + 7]) @ y[j], LOOP_COV) for j in range(7)]
    equations = comparison_equations(loops)
    weights = solve_comparison(equations).weights
    covariance_scales.set_evidence((0, 1), ("ann", "bob"), equations, weights)
    assert covariance_scales.scales == {}


def stated_by(sigmas: dict[str, float]) -> StatedCovariances:
    stated = StatedCovariances()
    for name, sigma in sigmas.items():
        for _ in range(10):
            stated.add_step(name, MOVED, sigma**2 * STEP_COV)
    for one, other in itertools.combinations(sigmas, 2):
        stated.link(one, other)
    return stated


def test_agents_without_a_common_loop_are_not_compared():
    """With any variances."""
    stated = stated_by({"ann": 1.0})
    for _ in range(10):
        stated.add_step("eve", MOVED, 1e6 * STEP_COV)
    assert stated.min_scale("ann") == 1.0
    stated.link("ann", "eve")
    assert stated.min_scale("ann") == 100.0


def test_without_evidence_no_agent_counts_as_much_more_certain_than_the_others():
    stated = stated_by({"ann": 1.0, "bob": 3.0, "eve": 0.1})
    assert stated.min_scale("ann") == stated.min_scale("bob") == 1.0
    assert stated.min_scale("eve") == pytest.approx(100 / 2.25)
    stated.exclude(["ann"])
    assert stated.min_scale("eve") == 100.0  # of 400
    stated.exclude(["eve"])
    assert stated.min_scale("ann") == pytest.approx(9 / 2.25)
    assert stated.min_scale("eve") == pytest.approx(100 / 2.25)
    stated.remove_agent("ann")
    assert stated.min_scale("eve") == 100.0  # of 400
    assert stated.known_agents == {"bob", "eve"}


def test_small_differences_of_stated_covariances_change_no_scale():
    stated = stated_by({"ann": 1.0, "bob": 1.4, "eve": 0.7})
    assert all(stated.min_scale(name) == 1.0 for name in ("ann", "bob", "eve"))


def test_an_agent_alone_is_not_scaled():
    assert stated_by({"eve": 0.01}).min_scale("eve") == 1.0


def test_scattered_depth_scales_have_a_larger_sigma():
    """Each loop states 0.5 %, and they differ by 10 %: the mean is less certain than 0.5 %."""
    rng = np.random.default_rng(4)
    logs = 0.4 + 0.1 * rng.standard_normal((200, 12))
    found = [robust_depth_scale([DepthScale(log, 0.005) for log in one]) for one in logs]
    off = np.array([(one.value - 0.4) / one.sigma for one in found])
    assert 0.6 < np.sqrt((off**2).mean()) < 1.7


def test_an_error_that_all_depths_share_does_not_average_out():
    """Of a camera without a baseline, whose scale becomes surer: the surest view bounds what lasts."""
    shared = np.linspace(0.03, 0.01, 40)
    mean = robust_depth_scale([DepthScale(-0.012, 0.005, None, sigma) for sigma in shared])
    assert mean.sigma >= 0.01
    assert mean.sigma < 0.012
    assert robust_depth_scale([DepthScale(-0.012, 0.005)] * 40).sigma < 0.004


def test_dropped_evidence_no_longer_scales():
    """At once, not with the next step; the stated covariances of eve still count."""
    claimed_only = 100 / 2.25
    for let_go in (lambda s: s.drop_evidence([(0, 1), (1, 2), (2, 3)]), lambda s: s.exclude(["eve"])):
        covariance_scales = walkers(0, 10.0, rounds=2)
        assert covariance_scales.scales["eve"] != pytest.approx(claimed_only, rel=0.01)
        let_go(covariance_scales)
        assert covariance_scales.scales["eve"] == pytest.approx(claimed_only, rel=0.01)


def test_loops_between_agents_that_disagree_scale_no_covariance():
    """The path of bob is 10 % too long, which does not scale the covariance of either."""
    rng, agreement, widths = np.random.default_rng(1), AgentAgreement(), []
    x, y = ring(0.0), ring(0.7)
    for name, first, steps in (("ann", 0, steps_of(x, rng)), ("bob", 1000, steps_of(y, rng, scale=1.1))):
        for i, step in enumerate([np.eye(4), *steps]):
            agreement.add_step(name, first + i, first + i - 1 if i else None, step, STEP_COV)
    for j in range(4, FRAMES - 7, 2):
        noise = se3.exp(np.sqrt(np.diag(LOOP_COV)) * rng.standard_normal(6))
        T = se3.orthonormal(se3.inverse(x[j + 7]) @ y[j] @ noise)
        agreement.add_loop(("ann", "bob"), (0, 1), PoseEdge(j + 7, 1000 + j, T, LOOP_COV), None, None)
        widths.append((agreement.covariance_scale("ann"), agreement.covariance_scale("bob")))
    assert agreement.disputed
    assert set(widths) == {(1.0, 1.0)}


def test_a_scale_near_its_threshold_does_not_toggle():
    """Its variances are 4.5 times below another's, twice the tolerance; steps differ in size."""
    rng, applied = np.random.default_rng(0), list[float]()
    covariance_scales = CovarianceScales()
    covariance_scales.stated.link("ann", "bob")
    for _ in range(300):
        for name, part in (("ann", 1.0), ("bob", 1 / 4.5)):
            step = se3.exp(np.r_[rng.normal(0, 0.05, 3), rng.normal(0, 0.15, 3)])
            covariance_scales.add_step(name, step, part * STEP_COV)
            if (now := covariance_scales.scales.get("bob", 1.0)) != (applied or [1.0])[-1]:
                applied.append(now)
    assert 1 <= len(applied) <= 4
