"""ATE and RPE, compared with evo on the same data and with known values."""

import copy

import numpy as np
import pytest

from share.errors import DataError
from share.geometry.interpolation import associate
from share.geometry.se3 import exp, from_rt, inverse, quat_from_matrix, so3_exp
from share.metrics.ate import ate, ate_if_known, joint_ate
from share.metrics.rpe import rpe_frames, rpe_time

T0 = 1_700_000_000_000_000_000


def walk(n: int, seed: int, step_ns: int = 50_000_000):
    rng = np.random.default_rng(seed)
    phi = np.cumsum(rng.normal(0, 0.05, (n, 3)), axis=0)
    t = np.cumsum(rng.normal(0.02, 0.02, (n, 3)), axis=0)
    return T0 + step_ns * np.arange(n, dtype=np.int64), from_rt(so3_exp(phi), t)


def noisy(trajectory, seed: int, T_left=None):
    stamps, T = trajectory
    rng = np.random.default_rng(seed)
    xi = np.hstack([rng.normal(0, 0.01, (len(T), 3)), rng.normal(0, 0.02, (len(T), 3))])
    moved = exp(np.array([0.3, -0.2, 1.0, 4.0, -2.0, 0.5])) if T_left is None else T_left
    return stamps, moved @ T @ exp(xi)


def evo_trajectory(trajectory):
    from evo.core.trajectory import PoseTrajectory3D

    stamps, T = trajectory
    q = quat_from_matrix(T[:, :3, :3])[:, [3, 0, 1, 2]]
    return PoseTrajectory3D(T[:, :3, 3], q, (stamps - T0) / 1e9)


def test_ate_agrees_with_evo():
    from evo.core.metrics import APE, PoseRelation

    truth = walk(400, 1)
    estimate = noisy(truth, 2)
    evo_truth, evo_estimate = evo_trajectory(truth), copy.deepcopy(evo_trajectory(estimate))
    evo_estimate.align(evo_truth)
    metric = APE(PoseRelation.translation_part)
    metric.process_data((evo_truth, evo_estimate))
    want = metric.get_all_statistics()
    got = ate(estimate, truth)
    assert got.n == 400
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(got, name) == pytest.approx(want[name], abs=1e-9)


@pytest.mark.parametrize("frames", [1, 20])
def test_rpe_agrees_with_evo(frames):
    from evo.core.metrics import RPE, PoseRelation, Unit

    truth = walk(300, 3)
    estimate = noisy(truth, 4)
    got = rpe_frames(estimate, truth) if frames == 1 else rpe_time(estimate, truth)
    for relation, have in (
        (PoseRelation.translation_part, got.translation),
        (PoseRelation.rotation_angle_rad, got.rotation),
    ):
        metric = RPE(relation, delta=frames, delta_unit=Unit.frames, all_pairs=True)
        metric.process_data((evo_trajectory(truth), evo_trajectory(estimate)))
        want = metric.get_all_statistics()
        assert have.n == 300 - frames
        for name in ("rmse", "mean", "median", "max"):
            assert getattr(have, name) == pytest.approx(want[name], abs=1e-9)


def test_alignment_is_estimated_and_reported():
    truth = walk(100, 5)
    T_truth_est = exp(np.array([0.1, 0.2, -2.0, 1.0, 2.0, 3.0]))
    estimate = truth[0], inverse(T_truth_est) @ truth[1]
    found = ate(estimate, truth)
    assert found.rmse < 1e-9
    assert np.allclose(found.T_truth_est, T_truth_est, atol=1e-9)


def test_truth_is_interpolated_on_an_arc_across_short_gaps_only():
    stamps = T0 + np.array([0, 80, 160, 1000, 1080], np.int64) * 1_000_000
    angle = (stamps - T0) / 1e9  # 1 rad/s, 1 m/s: exactly what slerp and the straight line give back
    truth = stamps, from_rt(so3_exp(np.outer(angle, [0, 0, 1.0])), np.outer(angle, [1.0, 0, 0]))
    at = T0 + np.array([-1, 0, 37, 160, 500, 1000, 1043, 1081], np.int64) * 1_000_000
    a = (at - T0) / 1e9
    estimate = at, from_rt(so3_exp(np.outer(a, [0, 0, 1.0])), np.outer(a, [1.0, 0, 0]))
    _, T_est, T_truth = associate(estimate, truth)
    assert len(T_est) == 5  # 0, 37, 160, 1000, 1043: not before, not in the gap, not after
    assert np.allclose(T_est, T_truth, rtol=0, atol=1e-9)
    step = rpe_frames(estimate, truth)
    assert step.translation.n == 3  # the step across the gap is left out
    assert step.rotation.max < 1e-8


def test_joint_alignment_shows_an_agent_in_the_wrong_place():
    one, two = walk(200, 6), walk(200, 7)
    right = {"a": (noisy(one, 8), one), "b": (noisy(two, 9), two)}
    both = joint_ate(right)
    assert both.joint.n == 400
    squares = sum(a.rmse**2 * a.n for a in both.agents.values())
    assert both.joint.rmse == pytest.approx(np.sqrt(squares / 400), rel=1e-12)
    shifted = noisy(two, 9)
    shifted[1][:, 0, 3] += 1.0
    wrong = {"a": right["a"], "b": (shifted, two)}
    assert ate(shifted, two).rmse == pytest.approx(ate(*right["b"]).rmse, rel=1e-6)
    assert joint_ate(wrong).agents["b"].rmse > 5 * both.agents["b"].rmse


def test_too_few_poses_are_refused():
    truth = walk(10, 1)
    elsewhere = truth[0] + 10**12, truth[1]
    with pytest.raises(DataError, match="same clock"):
        ate(elsewhere, truth)
    with pytest.raises(DataError, match="same clock"):
        joint_ate({"a": (elsewhere, truth)})
    with pytest.raises(DataError, match="no pair"):
        rpe_time(truth, truth)
    with pytest.raises(ValueError, match="rise"):
        ate((truth[0][::-1], truth[1]), truth)


def test_the_ate_is_unknown_without_estimate_truth_or_enough_poses():
    truth = walk(10, 1)
    two = truth[0][:2], truth[1][:2]
    assert [ate_if_known(*pair) for pair in ((None, truth), (truth, None), (two, truth))] == [None] * 3
    found = ate_if_known(truth, truth)
    assert found is not None and found.n == 10
