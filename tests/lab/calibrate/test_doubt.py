"""Covariances of what views tell together."""

import numpy as np

from share.lab.calibrate.camera_bundle import enclosing_covariance, jackknife


def test_the_jackknife_of_a_mean_is_its_squared_standard_error(rng: np.random.Generator) -> None:
    x = rng.normal(3, 2, (40, 2))
    mean = x.mean(axis=0)
    H = np.tile(np.eye(2), (40, 1, 1))
    np.testing.assert_allclose(jackknife(H, x - mean), np.cov(x.T) / 40, rtol=1e-12)


def test_the_larger_of_two_is_in_no_direction_below_either(rng: np.random.Generator) -> None:
    A, B = rng.normal(size=(2, 5, 5))
    one, other = A @ A.T, B[:, :3] @ B[:, :3].T  # the second knows three directions only
    both = enclosing_covariance(one, other)
    for less in (one, other):
        assert np.linalg.eigvalsh(both - less).min() > -1e-9 * np.trace(both)
    assert np.trace(both) < np.trace(one + other)


def test_of_two_on_the_same_axes_it_is_the_larger_of_each() -> None:
    np.testing.assert_allclose(
        enclosing_covariance(np.diag([1.0, 4.0]), np.diag([9.0, 1.0])), np.diag([9.0, 4.0]), atol=1e-12
    )
