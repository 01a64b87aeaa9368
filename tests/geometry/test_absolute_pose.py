"""Both solvers find a camera's pose among wrong matches."""

import numpy as np
import pytest

from share.geometry import absolute_pose as searches
from share.geometry import se3
from share.geometry.absolute_pose import RansacOptions, absolute_pose, by_opencv, by_poselib

FOCAL = 450.0
BOTH = pytest.mark.parametrize("search", [by_poselib, by_opencv])


def matches(rng, n, wrong, noise_px=1.0):
    """points (n, 3) m, uv (n, 2), T_cam_world, wrong (n,)."""
    T = se3.from_rt(se3.so3_exp(rng.normal(0, 0.3, 3)), rng.normal(0, 0.5, 3))
    seen = np.column_stack([rng.uniform(-2, 2, n), rng.uniform(-1.5, 1.5, n), rng.uniform(1.5, 6, n)])
    uv = seen[:, :2] / seen[:, 2:] + rng.normal(0, noise_px / FOCAL, (n, 2))
    bad = rng.random(n) < wrong
    uv[bad] = rng.uniform(-0.7, 0.7, (int(bad.sum()), 2))
    return (seen - T[:3, 3]) @ T[:3, :3], uv, T, bad


def apart(T, truth):
    """Return the position error, m."""
    return float(np.linalg.norm((se3.inverse(T) - se3.inverse(truth))[:3, 3]))


@BOTH
@pytest.mark.parametrize(("wrong", "most"), [(0.0, 0.01), (0.3, 0.01), (0.6, 0.015)])
def test_the_pose_is_found_among_wrong_matches(search, wrong, most, rng):
    off = []
    for seed in range(15):
        points, uv, truth, bad = matches(rng, 200, wrong)
        T, inlier = search(points, uv, FOCAL, RansacOptions(3.0, seed))
        off.append(apart(T, truth))
        assert inlier[~bad].mean() > 0.9
        assert inlier[bad].sum() <= 3  # by chance
    assert max(off) < most


@BOTH
def test_the_same_seed_gives_the_same_pose(search, rng):
    points, uv, *_ = matches(rng, 60, 0.5)
    first, second = (search(points, uv, FOCAL, RansacOptions(3.0, 7)) for _ in range(2))
    assert np.array_equal(first[0], second[0])
    assert np.array_equal(first[1], second[1])


@BOTH
def test_sorted_matches_need_few_iterations(search, rng):
    """80 % are wrong: random samples would need far more iterations."""
    points, uv, truth, bad = matches(rng, 200, 0.8)
    order = np.argsort(bad, kind="stable")
    few = RansacOptions(3.0, 0, min_iterations=10, max_iterations=50, best_first=True)
    T, _ = search(points[order], uv[order], FOCAL, few)
    assert apart(T, truth) < 0.03


@BOTH
@pytest.mark.parametrize("n", [0, 1, 2, 3, 30])
def test_without_a_solution_nothing_is_raised(search, n, rng):
    points, uv = rng.normal([0, 0, 4], 1.0, (n, 3)), rng.uniform(-0.5, 0.5, (n, 2))
    T, inlier = search(points, uv, FOCAL, RansacOptions(1.0, 0, max_iterations=100))
    assert inlier.shape == (n,)
    assert T.shape == (4, 4)
    assert inlier.sum() < 8


def test_opencv_replaces_a_missing_poselib(monkeypatch, rng):
    points, uv, *_ = matches(rng, 60, 0.3)
    monkeypatch.setattr(searches, "poselib", None)
    found, _ = absolute_pose(points, uv, FOCAL, RansacOptions(3.0, 5))
    assert np.array_equal(found, by_opencv(points, uv, FOCAL, RansacOptions(3.0, 5))[0])
