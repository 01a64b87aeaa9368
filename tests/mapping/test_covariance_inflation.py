"""Small scale errors are corrected, understated covariances enlarged, and separated agents stay so after a
restart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.atlas_sim import STEP, UP, UP_SIGMA, Walker, near_loops

from share.config import MergeConfig
from share.geometry import se3
from share.mapping.agents.agreement import AgentAgreement
from share.mapping.atlas import Atlas
from share.mapping.graph.edges import PoseEdge, inflate_covariance
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import StoredKeyframe, StoredMap
from share.mapping.recognition.depth_scale import DepthScale, relative_depth_scale
from share.mapping.recognition.refinement import KeypointNoise, refine_relative_pose
from share.types import Keyframe, View

NOISE = KeypointNoise(1.5 / 400, 0.01)
T_C_Q = se3.exp(np.array([0.02, -0.1, 0.05, 0.3, 0.1, -0.2]))
NO_VIEW = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))
OWN = 1e-9 * np.eye(6)


def views(log: float, rng) -> tuple:
    """150 keypoints of a query whose points are too far by e^log, and of the candidate; 2 to 7 m away."""
    y_q = np.column_stack([rng.uniform(-0.6, 0.6, (150, 2)), 1 / rng.uniform(2, 7, 150)])
    points = np.column_stack([y_q[:, :2], np.ones(150)]) / y_q[:, 2:]
    seen = se3.transform(T_C_Q, points)
    y_c = np.column_stack([seen[:, :2], np.ones(150)]) / seen[:, 2:]
    y_q[:, 2] *= np.exp(-log)
    small = 0.1 * np.sqrt(NOISE.variances)
    return y_q + small * rng.standard_normal((150, 3)), y_c + small * rng.standard_normal((150, 3))


@pytest.mark.parametrize("log", [-0.03, -0.01, 0.01, 0.03])
def test_the_pose_sensitivity_is_that_of_a_depth_scale(log):
    y_q, y_c = views(log, np.random.default_rng(1))
    fine = refine_relative_pose(T_C_Q, y_q, y_c, NOISE, NOISE, 11.3)
    found = relative_depth_scale(fine.T, y_q, y_c, NOISE, NOISE, 11.3)
    assert found is not None and found.pose_sensitivity is not None
    right = se3.exp(found.pose_sensitivity * log) @ fine.T

    def off(T):
        return float(np.linalg.norm(se3.log(T @ se3.inverse(T_C_Q))[3:]))

    assert off(fine.T) > 0.2 * abs(log)  # m
    assert off(right) < 0.4 * off(fine.T)


def compared_agents(scales: dict[str, float], rounds: int = 40) -> AgentAgreement:
    """Agreement of agents with these scales, after loops between all of them."""
    agreement, rng, names = AgentAgreement(), np.random.default_rng(2), list(scales)
    nodes = {name: range(10 * i, 10 * i + 10) for i, name in enumerate(names)}
    for name, numbers in nodes.items():
        for n in numbers:
            agreement.add_step(
                name, n, n - 1 if n % 10 else None, se3.exp(np.array([0, 0, 0, 0.3, 0, 0])), STEP
            )
    for k in range(rounds):
        for a, b in (("ann", "bob"), ("eve", "ann"), ("bob", "eve")):
            edge = PoseEdge(nodes[a][k % 10], nodes[b][k % 10], np.eye(4), STEP)
            log = np.log(scales[b] / scales[a]) + 0.005 * rng.standard_normal()
            agreement.add_loop((a, b), (nodes[a][0], nodes[b][0]), edge, DepthScale(log, 0.005), None)
    return agreement


@pytest.mark.parametrize("scale", [0.99, 0.994, 1.007, 1.012])
def test_harmless_scales_are_estimated_relative_to_the_others(scale):
    agreement = compared_agents({"ann": 1.0, "bob": 1.0, "eve": scale})
    assert not agreement.quarantined
    assert agreement.log_scales["eve"] == pytest.approx(np.log(scale), abs=0.0025)
    assert agreement.standing("eve").corrected_log_scale == agreement.log_scales["eve"]
    assert abs(agreement.log_scales.get("ann", 0.0)) < 0.0025 > abs(agreement.log_scales.get("bob", 0.0))


@pytest.mark.long
def test_scales_of_quarantined_agents_are_not_corrected_and_those_of_correct_ones_hardly():
    agreement = compared_agents({"ann": 1.0, "bob": 1.0, "eve": 1.04})
    assert agreement.quarantined == {"eve"}
    assert agreement.log_scales.get("eve", 0.0) == 0.0
    honest = compared_agents({"ann": 1.0, "bob": 1.0, "eve": 1.0})
    assert all(abs(log) < 0.002 for log in honest.log_scales.values())


def test_the_graph_is_rescaled_and_stored_links_are_not():
    ann, eve = Walker("ann", 1), Walker("eve", 2, phase=0.7)
    atlas = Atlas(MergeConfig())
    for a, e in zip(ann.keyframes[:30], eve.keyframes[:30], strict=True):
        atlas.add_keyframe("ann", a)
        atlas.add_keyframe("eve", e)
    graph, agreement = atlas.graph, atlas.quarantine.agreement
    agreement.log_scales["eve"], agreement.covariance_scale = 0.01, lambda run: 4.0 if run == "eve" else 1.0
    atlas.quarantine.apply_scales()
    assert atlas.solving.due_maps() == ["eve/0"]
    atlas.add_keyframe("eve", eve.keyframes[30])
    for walker, by in ((ann, 1.0), (eve, np.exp(-0.01))):
        for k in range(1, 30):
            before, number = (graph.odometry.node_id(KeyframeKey(walker.name, i)) for i in (k - 1, k))
            T, stated = graph.odometry_edge(before, number).T_a_b, walker.keyframes[k].T_ref_body
            assert T[:3, 3] == pytest.approx(by * stated[:3, 3])
            assert T[:3, :3] == pytest.approx(stated[:3, :3])
            width = 1.0 if walker is ann else 4.0
            cov = width * inflate_covariance(stated, walker.keyframes[k].cov)
            assert graph.odometry_edge(before, number).cov == pytest.approx(cov)
    taken = atlas.remove_keyframes([graph.odometry.node_id(KeyframeKey("eve", 5))])[0]
    stated = eve.keyframes[5].T_ref_body @ eve.keyframes[6].T_ref_body
    assert taken.link is not None
    assert taken.link.T_ref_body[:3, 3] == pytest.approx(stated[:3, 3], abs=1e-4)
    plain = inflate_covariance(stated, eve.keyframes[6].cov)
    assert np.trace(taken.link.cov) < 3 * np.trace(plain)  # of two steps
    agreement.log_scales["eve"] = 0.0
    atlas.quarantine.apply_scales()
    last = [graph.odometry.node_id(KeyframeKey("eve", k)) for k in (29, 30)]
    assert graph.odometry_edge(*last).T_a_b[:3, 3] == pytest.approx(eve.keyframes[30].T_ref_body[:3, 3])


def test_loops_are_rescaled_too():
    ann, eve = Walker("ann", 1), Walker("eve", 2, phase=0.7)
    atlas = Atlas(MergeConfig())
    for walker in (ann, eve):
        atlas.add_keyframe(walker.name, walker.keyframes[0])
    (loop,) = near_loops(ann, eve, np.random.default_rng(0))[:1]
    lean = np.array([0.0, 0.0, 0.0, 2.0, 0.0, 0.0])
    assert atlas.quarantine.rescale_loop(loop, DepthScale(0.01, 0.004, lean)) is loop  # no scale is known
    atlas.graph.log_scales["eve"] = 0.01
    right = atlas.quarantine.rescale_loop(loop, DepthScale(0.01, 0.004, lean))
    gap = se3.log(right.T_a_b @ se3.inverse(loop.T_a_b))
    assert gap == pytest.approx(0.01 * lean, abs=1e-6)
    back = atlas.quarantine.rescale_loop(loop.reverse(), DepthScale(-0.01, 0.004, lean))
    leant = (se3.exp(-0.01 * lean) @ loop.reverse().T_a_b)[:3, 3]
    assert back.T_a_b[:3, 3] == pytest.approx(
        np.exp(-0.01) * leant
    )  # in the metres of eve, which are too long
    assert atlas.quarantine.rescale_loop(loop, None) is loop


@pytest.mark.parametrize(("metres", "radians"), [(0.1, 0.0), (1.0, 0.0), (0.3, 0.5)])
def test_sigmas_are_at_least_a_share_of_the_step(metres, radians):
    atlas, step = Atlas(MergeConfig()), se3.exp(np.array([0, 0, radians, metres, 0, 0]))
    atlas.add_keyframe("eve", Keyframe(0, -1, 0, np.eye(4), OWN, np.eye(4), UP, UP_SIGMA, NO_VIEW))
    atlas.add_keyframe("eve", Keyframe(1, 0, 10**8, step, OWN, step, UP, UP_SIGMA, NO_VIEW))
    sigma = np.sqrt(np.diag(atlas.graph.odometry_edge(0, 1).cov))
    assert sigma[3:].min() >= 0.003 * np.linalg.norm(step[:3, 3])
    assert sigma[3:].max() < 0.004 * metres + 0.0003
    assert sigma[:3].min() >= 0.0005 * radians


# ---------------------------------------------------------------- after a restart


def restored_atlas(tied: bool) -> tuple[Atlas, list]:
    """A restored atlas of ann, bob and eve; tied: ann and bob share a map. Also loops of ann and eve."""
    walkers = Walker("ann", 1), Walker("bob", 2, phase=0.3), Walker("eve", 3, phase=0.7)
    placed = [StoredKeyframe(w.name, k, f"{w.name}/0", k.id) for w in walkers for k in w.keyframes]
    rng, atlas = np.random.default_rng(0), Atlas(MergeConfig())
    kept = near_loops(*walkers[:2], rng)[:6] if tied else []
    segments = tuple(f"{w.name}/0" for w in walkers)
    atlas.restore(StoredMap((), segments, tuple(placed), loops=tuple(kept)), [0, 0, 0])
    return atlas, near_loops(walkers[0], walkers[2], rng)


@pytest.mark.parametrize("tied", [True, False])
@pytest.mark.parametrize("log", [0.0, 0.05])
def test_after_a_restart_agents_outside_the_common_map_are_compared_before_they_join(tied, log):
    atlas, loops = restored_atlas(tied)
    assert "the edge has restarted" in atlas.quarantine.agreement.standing("eve").reason
    said = [atlas.propose(loop) for loop in loops[:4]]
    assert not any(decision.accepted for decision in said)
    assert all("compared first" in decision.reason for decision in said)
    met_again = []
    for loop in loops:
        atlas.quarantine.add_loop(loop, DepthScale(log, 0.005))
        decision = atlas.propose(replace(loop, found_share=1.0))
        met_again.append(atlas.map_id(KeyframeKey("ann", 0)) == atlas.map_id(KeyframeKey("eve", 0)))
        if log:
            assert not decision.accepted
    assert met_again[-1] == (log == 0.0)
    assert atlas.quarantine.agreement.standing("eve").state == ("agrees" if log == 0.0 else "disputed")
    assert atlas.quarantine.agreement.standing("bob").state == "unknown"
    assert ("edge has restarted" in atlas.quarantine.agreement.standing("bob").reason) != tied
