"""The relative scale of two views' depths, from matched points."""

from __future__ import annotations

import numpy as np
import pytest

from share.geometry import se3
from share.mapping.recognition.depth_scale import DepthScale, relative_depth_scale
from share.mapping.recognition.refinement import KeypointNoise

NOISE = KeypointNoise(1.5 / 400, 0.01)
T_C_Q = se3.exp(np.array([0.02, -0.1, 0.05, 0.3, 0.1, -0.2]))


def views(log: float, rng, n: int = 80):
    """Keypoints (n, 3) of the query, all too far by e^log, and of the candidate."""
    y_q = np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)), rng.uniform(0.2, 0.7, n)])
    points = np.column_stack([y_q[:, :2], np.ones(n)]) / y_q[:, 2:]
    seen = se3.transform(T_C_Q, points)
    y_c = np.column_stack([seen[:, :2], np.ones(n)]) / seen[:, 2:]
    sigma = np.sqrt(NOISE.variances)
    y_q[:, 2] *= np.exp(-log)
    return y_q + sigma * rng.standard_normal((n, 3)), y_c + sigma * rng.standard_normal((n, 3))


@pytest.mark.parametrize("log", [-0.1, -0.05, 0.0, 0.03, 0.1])
def test_the_depth_scale_is_estimated_with_its_sigma(log):
    found = []
    for seed in range(30):
        got = relative_depth_scale(T_C_Q, *views(log, np.random.default_rng(seed)), NOISE, NOISE, 11.3)
        assert got is not None
        found.append((got.log - log) / got.sigma)
    assert abs(np.mean(found)) < 1.0
    assert 0.6 < np.std(found) < 1.5


def test_wrong_matches_do_not_change_the_depth_scale():
    y_q, y_c = views(0.05, np.random.default_rng(3))
    y_c[:16, :2] = np.random.default_rng(4).uniform(-0.5, 0.5, (16, 2))
    found = relative_depth_scale(T_C_Q, y_q, y_c, NOISE, NOISE, 11.3)
    assert found is not None
    assert found.log == pytest.approx(0.05, abs=4 * found.sigma)


def test_too_few_depths_give_no_depth_scale():
    y_q, y_c = views(0.05, np.random.default_rng(3))
    y_q[5:, 2] = np.nan
    assert relative_depth_scale(T_C_Q, y_q, y_c, NOISE, NOISE, 11.3) is None


def test_the_reverse_has_the_opposite_depth_scale():
    assert DepthScale(0.1, 0.02).reverse() == DepthScale(-0.1, 0.02)
