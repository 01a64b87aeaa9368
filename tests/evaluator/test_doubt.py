"""What a tracker's own covariances say of its error over a window."""

from __future__ import annotations

import numpy as np
import pytest

from share.evaluator.doubt import Doubt
from share.geometry import se3
from share.types import Candidate, View

S = 1_000_000_000
NOTHING = View(np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 32), np.uint8))


def candidate(T: np.ndarray, sigma_rad: float, sigma_m: float, new: bool = False) -> Candidate:
    cov = np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)
    return Candidate(np.eye(4), T, cov, np.zeros(3), 0.0, NOTHING, new)


def test_independent_motions_add_up_as_their_variances_do():
    doubt = Doubt(5.0)
    for k in range(4):
        sigma_cm = doubt.after(k * S, candidate(np.eye(4), 0.0, 0.001))
        assert sigma_cm == pytest.approx(0.1 * np.sqrt(3 * (k + 1)))


def test_what_is_older_than_the_window_is_forgotten():
    doubt = Doubt(5.0)
    doubt.after(0, candidate(np.eye(4), 0.0, 1.0))
    doubt.after(3 * S, candidate(np.eye(4), 0.0, 0.002))
    assert doubt.after(5 * S, candidate(np.eye(4), 0.0, 0.001)) == pytest.approx(0.1 * np.sqrt(3 * 5))


def test_a_turn_that_is_doubted_moves_what_comes_after():
    """By its lever: 0.01 rad about either axis across 2 m ahead is 2 cm."""
    ahead = se3.from_quat(np.array([[2.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]]))[0]
    doubt = Doubt(5.0)
    doubt.after(0, candidate(np.eye(4), 0.01, 0.0))
    assert doubt.after(S, candidate(ahead, 0.0, 0.0)) == pytest.approx(2 * np.sqrt(2))


def test_a_stretch_that_begins_is_sure_of_itself():
    doubt = Doubt(5.0)
    doubt.after(0, candidate(np.eye(4), 0.0, 1.0))
    assert doubt.after(S, candidate(np.eye(4), 0.0, 1.0, new=True)) == 0
