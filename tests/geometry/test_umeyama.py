import numpy as np
import pytest

from share.geometry import se3
from share.geometry.se3 import umeyama


def test_recovers_a_rigid_motion(rng):
    T = se3.exp(rng.normal(size=6))
    points = rng.normal(size=(50, 3))
    assert np.allclose(umeyama(points, se3.transform(T, points)), T, atol=1e-12)


def test_is_the_least_squares_answer_and_never_a_reflection(rng):
    source, target = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    T = umeyama(source, target)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)

    def cost(T):
        return ((se3.transform(T, source) - target) ** 2).sum()

    for xi in rng.normal(size=(100, 6)) * 0.01:
        assert cost(T) <= cost(T @ se3.exp(xi))


def test_empty_and_mismatched_points_are_refused():
    with pytest.raises(ValueError, match="umeyama"):
        umeyama(np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(ValueError, match="umeyama"):
        umeyama(np.zeros((2, 3)), np.zeros((3, 3)))
