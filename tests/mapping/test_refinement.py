import numpy as np
import pytest
from helpers.place_sim import FOCAL, SIGMA_PX, SIGMA_RHO

from share.geometry import se3
from share.mapping.recognition.refinement import (
    KeypointNoise,
    keypoint_jacobian,
    pose_jacobian,
    refine_relative_pose,
    transfer_keypoints,
)
from share.types import F64

NOISE = KeypointNoise(SIGMA_PX / FOCAL, SIGMA_RHO)
NAN = np.nan


def numerical(f, at: F64, step: float = 1e-6) -> F64:
    columns = [(f(at + step * e) - f(at - step * e)) / (2 * step) for e in np.eye(len(at))]
    return np.stack(columns, axis=-1)


def matched(rng: np.random.Generator, T_c_q: F64, n: int, noise: float = 1.0) -> tuple[F64, F64]:
    y_q = np.column_stack([rng.uniform(-0.8, 0.8, n), rng.uniform(-0.5, 0.5, n), 1 / rng.uniform(1.5, 5, n)])
    y_c = transfer_keypoints(T_c_q, y_q.T).T
    sigma = noise * np.sqrt(NOISE.variances)
    y_q, y_c = (y + rng.normal(size=y.shape) * sigma for y in (y_q, y_c))
    y_q[: n // 4, 2] = NAN
    y_c[-n // 4 :, 2] = NAN
    return y_q, y_c


def test_jacobians_against_differences() -> None:
    rng = np.random.default_rng(0)
    T = se3.exp(rng.normal(0, 0.3, 6))
    y = np.vstack([rng.uniform(-0.5, 0.5, (2, 20)), rng.uniform(0.2, 0.6, 20)])
    moved = transfer_keypoints(T, y)
    assert np.isfinite(moved).all()
    by_xi = numerical(lambda xi: transfer_keypoints(se3.exp(xi) @ T, y), np.zeros(6))
    assert pose_jacobian(moved) == pytest.approx(np.moveaxis(by_xi, 2, 0), abs=1e-6)
    by_y = keypoint_jacobian(T, y, moved)
    for i in range(20):
        expected = numerical(lambda v: transfer_keypoints(T, v[:, None])[:, 0], y[:, i])
        assert by_y[:, :, i] == pytest.approx(expected, abs=1e-6)


def test_each_point_may_have_its_own_transform() -> None:
    rng = np.random.default_rng(3)
    T = se3.exp(rng.normal(0, 0.3, (2, 6)))
    y = np.vstack([rng.uniform(-0.5, 0.5, (2, 2)), rng.uniform(0.2, 0.6, 2)])
    own = np.moveaxis(T, 0, 2)
    moved = transfer_keypoints(own, y)
    for i in range(2):
        alone = y[:, i : i + 1]
        assert moved[:, i : i + 1] == pytest.approx(transfer_keypoints(T[i], alone))
        assert keypoint_jacobian(own, y, moved)[:, :, i : i + 1] == pytest.approx(
            keypoint_jacobian(T[i], alone, transfer_keypoints(T[i], alone))
        )


def test_exact_matches_give_the_exact_pose() -> None:
    rng = np.random.default_rng(1)
    T = se3.exp(np.array([0.2, -0.1, 0.15, 0.5, -0.2, 0.3]))
    y_q, y_c = matched(rng, T, 60, noise=0.0)
    start = T @ se3.exp(np.full(6, 0.03))
    fine = refine_relative_pose(start, y_q, y_c, NOISE, NOISE, 11.3)
    assert np.abs(se3.log(se3.inverse(T) @ fine.T)).max() < 1e-9


def test_a_third_of_wrong_matches_does_not_move_it() -> None:
    rng = np.random.default_rng(2)
    T = se3.exp(np.array([0.1, 0.2, -0.1, 0.4, 0.1, 0.2]))
    y_q, y_c = matched(rng, T, 150)
    y_c[50:100] = y_c[rng.permutation(np.arange(50, 100))]
    fine = refine_relative_pose(T @ se3.exp(np.full(6, 0.01)), y_q, y_c, NOISE, NOISE, 11.3)
    xi = se3.log(se3.inverse(T) @ fine.T)
    assert np.linalg.norm(xi[3:]) < 0.03
    assert xi @ np.linalg.solve(fine.cov, xi) < 22.5
    assert (fine.d2[50:100] > 11.3).mean() > 0.9


def test_covariance_is_consistent() -> None:
    """NEES over 200 runs: the mean of a 6-dof chi-square lies in 6 +- 0.9 (four sigma is 0.98).

    The gate cuts off one match in a hundred, so the scale is a few per cent low; hence the room above.
    """
    nees = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        T = se3.exp(rng.normal(0, [0.15] * 3 + [0.3] * 3))
        y_q, y_c = matched(rng, T, 80)
        fine = refine_relative_pose(T, y_q, y_c, NOISE, NOISE, 11.3)
        xi = se3.log(se3.inverse(T) @ fine.T)
        nees.append(xi @ np.linalg.solve(fine.cov, xi))
    assert 5.1 < np.mean(nees) < 7.2


def test_degenerate_matches_have_a_huge_covariance() -> None:
    y = np.tile([0.1, 0.1, 0.5], (10, 1))
    fine = refine_relative_pose(np.eye(4), y, y, NOISE, NOISE, 11.3)
    assert np.linalg.eigvalsh(fine.cov).max() > 1.0
