"""Consistency statistics on draws from a known covariance."""

import numpy as np
import pytest
from helpers.experiments import experiment

from share.geometry import se3

consistency = experiment("consistency")
COV = np.diag([0.02, 0.01, 0.03, 0.05, 0.1, 0.02]) ** 2
COV[0, 4] = COV[4, 0] = 0.8 * 0.02 * 0.1


def drawn(n: int, seed: int = 0):
    """Return estimated poses, their covariances, truth drawn from them; all in odom, the first pose exact."""
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(0, 1, (n, 6)))
    noise = rng.multivariate_normal(np.zeros(6), COV, n)
    noise[0] = 0
    cov = np.tile(COV, (n, 1, 1))
    cov[0] = 0
    return T, cov, T @ se3.exp(noise)


def level(yaw: float, shift):
    return se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, yaw])), np.array(shift))


def test_truth_drawn_from_the_covariance_is_consistent_in_any_world():
    T, cov, true = drawn(4000)
    found = consistency.deviations(T, cov, level(2.5, [3.0, -7.0, 1.0]) @ true, np.zeros(len(T), np.int64))
    assert found.is_aligned.tolist() == [True] + [False] * 3999
    for part in (slice(0, 3), slice(3, 6)):
        mean = consistency.nees(found.errors[1:, part], found.cov[1:, part, part]).mean()
        assert mean == pytest.approx(3, abs=0.15)  # four sigma of the mean of 4000
        assert consistency.share_within(found.errors[1:, part], found.sigmas[1:, part]) == pytest.approx(
            0.9973**3, abs=0.006
        )


def test_an_unsure_first_pose_makes_no_later_one_inconsistent():
    """Odometry may begin before its first pose, which is known worse than those that follow."""
    T, cov, true = drawn(4000)
    rng = np.random.default_rng(1)
    unsure = true[0] @ se3.exp(rng.multivariate_normal(np.zeros(6), 100 * COV))
    T, true = np.concatenate([T[:1], T]), np.concatenate([unsure[None], true])
    found = consistency.deviations(
        T, np.concatenate([100 * COV[None], cov]), true, np.zeros(len(T), np.int64)
    )
    assert found.is_aligned.nonzero()[0].tolist() == [1]
    assert consistency.nees(found.errors[2:], found.cov[2:]).mean() == pytest.approx(6, abs=0.25)


def test_too_small_a_covariance_raises_the_nees():
    T, cov, true = drawn(2000)
    found = consistency.deviations(T, cov / 4, true, np.zeros(len(T), np.int64))
    assert consistency.nees(found.errors[1:, 3:], found.cov[1:, 3:, 3:]).mean() == pytest.approx(12, rel=0.1)


def test_deviations_are_estimate_minus_truth_along_odom():
    true = np.tile(level(0.7, [1.0, 2.0, 3.0]), (2, 1, 1))
    estimate = true.copy()
    estimate[1] = level(0.01, [0, 0, 0]) @ estimate[1]
    estimate[1, :3, 3] = true[1, :3, 3] + [0.1, 0.2, -0.3]
    found = consistency.deviations(estimate, np.tile(np.eye(6), (2, 1, 1)), true, np.zeros(2, np.int64))
    np.testing.assert_allclose(found.errors[1], [0, 0, 0.01, 0.1, 0.2, -0.3], atol=1e-12)


def test_each_segment_is_aligned_on_its_own():
    T, cov, _ = drawn(20)
    broken = T.copy()
    broken[10:] = level(1.0, [4, 4, 0]) @ T[10:]
    segment = np.repeat([0, 1], 10)
    assert np.abs(consistency.deviations(broken, cov, T, segment).errors).max() < 1e-9
    assert np.abs(consistency.deviations(broken, cov, T, 0 * segment).errors).max() > 1


def test_nees_of_no_covariance_is_infinite():
    found = consistency.nees(np.ones((2, 3)), np.stack([np.zeros((3, 3)), np.eye(3)]))
    assert found[0] == np.inf and found[1] == pytest.approx(3)


def test_share_within_requires_every_axis():
    assert consistency.share_within(np.array([[1.0, 3.1], [2.9, -2.9]]), np.ones((2, 2))) == 0.5
