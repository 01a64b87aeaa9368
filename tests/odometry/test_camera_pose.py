import numpy as np
import pytest

from share.geometry import se3
from share.odometry.relocalisation import ransac_pose, refine_absolute_pose, reprojection_residuals

FOCAL = 400.0


def scene(rng, n=150, noise_px=0.0, outliers=0):
    T = se3.exp(np.concatenate([0.3 * rng.normal(size=3), rng.normal(size=3)]))
    in_camera = rng.uniform((-2, -1.5, 1.5), (2, 1.5, 6), (n, 3))
    points = se3.transform(se3.inverse(T), in_camera)
    uv = in_camera[:, :2] / in_camera[:, 2:] + noise_px / FOCAL * rng.normal(size=(n, 2))
    uv[:outliers] = rng.uniform(-0.6, 0.6, (outliers, 2))
    return T, points, uv


def test_jacobian_against_differences(rng):
    T, points, uv = scene(rng, 20, 1.0)
    _, J = reprojection_residuals(T, points, uv, FOCAL * np.ones(20))
    eps = 1e-6
    for k, d in enumerate(np.eye(6) * eps):
        ahead, _ = reprojection_residuals(T @ se3.exp(d), points, uv, FOCAL * np.ones(20))
        back, _ = reprojection_residuals(T @ se3.exp(-d), points, uv, FOCAL * np.ones(20))
        assert np.abs(J[:, :, k] - (ahead - back) / (2 * eps)).max() < 1e-4 * FOCAL * 1e-2


def test_finds_the_pose_among_sixty_percent_outliers(rng):
    T, points, uv = scene(rng, 200, 0.5, outliers=120)
    found = ransac_pose(points, uv, FOCAL, 3.0, seed=0)
    assert found is not None
    best = refine_absolute_pose(found.T, points, uv, FOCAL, np.ones(200), 3.0)
    assert np.linalg.norm(se3.log(se3.inverse(T) @ best.T)) < 0.01
    assert best.inliers[120:].mean() > 0.95
    assert best.inliers[:120].mean() < 0.1


def test_the_same_seed_gives_the_same_pose(rng):
    _, points, uv = scene(rng, 200, 0.5, outliers=80)
    a, b = (ransac_pose(points, uv, FOCAL, 3.0, seed=7) for _ in range(2))
    assert (a.T == b.T).all()
    assert (a.inliers == b.inliers).all()


def test_too_few_points_give_no_pose(rng):
    _, points, uv = scene(rng, 3)
    assert ransac_pose(points, uv, FOCAL, 3.0, seed=0) is None


def test_covariance_is_consistent(rng):
    """Mean NEES of 6 degrees of freedom over 100 runs: 95 % of means lie in 5.35 .. 6.70."""
    nees = []
    for _ in range(100):
        T, points, uv = scene(rng, 120, 1.0)
        best = refine_absolute_pose(
            T @ se3.exp(0.01 * rng.normal(size=6)), points, uv, FOCAL, np.ones(120), 3.0
        )
        error = se3.log(se3.inverse(T) @ best.T)
        nees.append(error @ np.linalg.solve(best.cov, error))
    assert 5.0 < np.mean(nees) < 7.2


@pytest.mark.parametrize("seed", range(3))
def test_refine_is_a_minimum(seed):
    rng = np.random.default_rng(seed)
    T, points, uv = scene(rng, 100, 1.0)
    best = refine_absolute_pose(T, points, uv, FOCAL, np.ones(100), 3.0)
    r, J = reprojection_residuals(best.T, points, uv, FOCAL * np.ones(100))
    w = 1 / (1 + (r * r).sum(axis=1) / 4)
    gradient = np.einsum("nij,n,ni->j", J, w, r)
    assert np.abs(gradient).max() < 1e-3 * np.abs(J).max()
