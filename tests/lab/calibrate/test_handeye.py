import numpy as np
import pytest

from share.errors import DataError
from share.geometry import se3
from share.lab.calibrate.handeye import hand_eye

X = se3.exp(np.array([0.4, -1.1, 2.0, 0.08, -0.05, 0.12]))


def motions(
    rng: np.random.Generator, n: int = 200, axes: tuple[int, ...] = (0, 1, 2)
) -> tuple[np.ndarray, np.ndarray]:
    """Return motions A, and the same motions of the other body."""
    xi = rng.normal(size=(n, 6)) * np.repeat([0.5, 0.3], 3)
    xi[:, [k for k in range(3) if k not in axes]] = 0
    A = np.stack([se3.exp(one) for one in xi])
    return A, se3.inverse(X) @ A @ X


def noisy(T: np.ndarray, rng: np.random.Generator, turn: float, shift: float) -> np.ndarray:
    return T @ np.stack([se3.exp(xi) for xi in rng.normal(size=(len(T), 6)) * np.repeat([turn, shift], 3)])


def test_without_noise_the_estimate_is_exact(rng):
    found = hand_eye(*motions(rng))
    assert found.T_a_b == pytest.approx(X, abs=1e-9)


def test_nees_is_consistent(rng):
    """NEES over 30 draws: 6 for each if the covariance is right."""
    nees = []
    for _ in range(30):
        A, B = motions(rng, 100)
        found = hand_eye(noisy(A, rng, 0.003, 0.002), noisy(B, rng, 0.003, 0.002))
        error = se3.log(se3.inverse(found.T_a_b) @ X)
        nees.append(error @ np.linalg.solve(found.cov, error))
    assert 3.5 < np.mean(nees) < 9.5


def test_a_tenth_of_outlier_motions_hardly_matters(rng):
    A, B = motions(rng)
    B[::10] = np.stack([se3.exp(xi) for xi in rng.normal(size=(20, 6))])
    found = hand_eye(noisy(A, rng, 0.002, 0.001), B)
    error = se3.log(se3.inverse(found.T_a_b) @ X)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.2 and np.linalg.norm(error[3:]) < 0.003


@pytest.mark.parametrize("axes", [(2,), ()])
def test_rotation_about_one_axis_is_refused_with_a_hint(rng, axes):
    with pytest.raises(DataError, match="turn the device about two axes or more"):
        hand_eye(*motions(rng, axes=axes))


def test_rotation_about_two_axes_suffices(rng):
    assert hand_eye(*motions(rng, axes=(0, 1))).T_a_b == pytest.approx(X, abs=1e-9)


def test_too_few_motions_are_refused(rng):
    with pytest.raises(DataError, match="5 motions, at least 10"):
        hand_eye(*motions(rng, 5))
