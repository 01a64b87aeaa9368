"""What odometry may have lost since the map placed it."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.model_edge import EMPTY, MS, UP, S

from share.geometry import se3
from share.protocol.localisation import DriftEstimator
from share.types import Keyframe

COV = np.diag([1e-6, 1e-6, 1e-6, 4e-6, 4e-6, 4e-6])
AHEAD = se3.from_rt(se3.so3_exp(np.array([0, 0, 0.2])), np.array([0.3, 0, 0]))


def sent(drift: DriftEstimator, count: int, first: int = 0) -> None:
    """Ten a second, the first without a reference."""
    for k in range(first, first + count):
        keyframe = Keyframe(k, k - 1, k * 100 * MS, AHEAD, COV, np.eye(4), UP, 0.01, EMPTY)
        drift.add_keyframe(keyframe, k * 100 * MS)


def test_by_covariances_it_is_that_of_the_motion_since() -> None:
    drift = DriftEstimator()
    assert drift.expected_cm(None, 0) is None
    sent(drift, 20)
    drift.correct(7)
    cov = np.zeros((6, 6))
    for _ in range(12):
        cov = se3.compose_cov(AHEAD, cov, COV)
    expected = 100 * np.sqrt(np.trace(cov[3:, 3:]))
    assert drift.expected_cm(None, 2 * S) == pytest.approx(expected, rel=1e-12)
    drift.correct(3)  # an old one changes nothing
    assert drift.expected_cm(None, 2 * S) == pytest.approx(expected, rel=1e-12)
    drift.correct(19)
    assert drift.expected_cm(None, 2 * S) == 0.0


def test_what_is_long_ago_is_summed_up_not_forgotten() -> None:
    drift, cov = DriftEstimator(), np.zeros((6, 6))
    sent(drift, 500)
    for _ in range(499):
        cov = se3.compose_cov(AHEAD, cov, COV)
    assert drift.expected_cm(None, 50 * S) == pytest.approx(100 * np.sqrt(np.trace(cov[3:, 3:])), rel=1e-9)


def test_an_estimate_grows_as_a_random_walk_up_to_its_window() -> None:
    drift = DriftEstimator()
    sent(drift, 11)
    drift.correct(10)  # at 1 s
    told = [drift.expected_cm(2.0, round((1 + age) * S)) for age in (0, 0.05, 1.25, 5, 60)]
    assert told == pytest.approx([0.0, 0.2, 1.0, 2.0, 2.0])


def test_a_new_stretch_begins_anew() -> None:
    drift = DriftEstimator()
    sent(drift, 20)
    fresh = Keyframe(20, -1, 2 * S, np.eye(4), COV, np.eye(4), UP, 0.01, EMPTY)
    drift.add_keyframe(fresh, 2 * S)
    assert drift.expected_cm(None, 2 * S) == 0.0
    assert drift.expected_cm(1.0, 3 * S) == pytest.approx(np.sqrt(0.2))
