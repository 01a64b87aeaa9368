"""Standard deviation of the agent's map position, and its expected drift."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.model_edge import EMPTY, MS, UP, S

from share.geometry import se3
from share.protocol.localisation import BlendedMapFrame, DriftEstimator
from share.types import Correction, Keyframe


def placed(cov: np.ndarray, T_map_odom: np.ndarray) -> BlendedMapFrame:
    frame = BlendedMapFrame(0.5)
    frame.apply(Correction(T_map_odom, cov, "a", 1, 0), np.eye(4), 0)
    return frame


def test_rotation_uncertainty_grows_with_the_distance_from_the_origin() -> None:
    cov = np.diag([0, 0, 0.01**2, 0.03**2, 0, 0])
    frame = placed(cov, np.eye(4))
    at = [frame.sigma_cm(se3.from_rt(np.eye(3), np.array([0, y, 0]))) for y in (0.0, 4.0)]
    assert at == pytest.approx([3.0, 5.0])  # cm: 3, and with 4 m x 0.01 rad


def test_the_map_sigma_agrees_with_samples(rng) -> None:
    T_map_odom = se3.from_rt(se3.so3_exp(np.array([0.1, -0.2, 1.0])), np.array([1.0, 2, 0]))
    T_odom_body = se3.from_rt(se3.so3_exp(np.array([0.3, 0.1, -0.5])), np.array([3.0, -1, 0.5]))
    root = rng.normal(0, 0.003, (6, 6))
    drawn = T_map_odom @ se3.exp(rng.normal(size=(20_000, 6)) @ root.T) @ T_odom_body
    spread = np.sqrt(drawn[:, :3, 3].var(axis=0).sum())
    assert placed(root @ root.T, T_map_odom).sigma_cm(T_odom_body) == pytest.approx(100 * spread, rel=0.02)


def test_the_map_sigma_is_zero_before_a_correction() -> None:
    frame = BlendedMapFrame(0.5)
    assert frame.sigma_cm(np.eye(4)) == 0.0
    frame = placed(np.eye(6), np.eye(4))
    frame.reset()
    assert frame.sigma_cm(np.eye(4)) == 0.0


COV = np.diag([1e-6, 1e-6, 1e-6, 4e-6, 4e-6, 4e-6])
AHEAD = se3.from_rt(se3.so3_exp(np.array([0, 0, 0.2])), np.array([0.3, 0, 0]))


def sent(drift: DriftEstimator, count: int, first: int = 0) -> None:
    """Add keyframes, ten a second, the first without a reference."""
    for k in range(first, first + count):
        keyframe = Keyframe(k, k - 1, k * 100 * MS, AHEAD, COV, np.eye(4), UP, 0.01, EMPTY)
        drift.add_keyframe(keyframe, k * 100 * MS)


def test_drift_is_the_covariance_of_the_motion_since_the_correction() -> None:
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


def test_old_motions_are_merged_not_dropped() -> None:
    drift, cov = DriftEstimator(), np.zeros((6, 6))
    sent(drift, 500)
    for _ in range(499):
        cov = se3.compose_cov(AHEAD, cov, COV)
    assert drift.expected_cm(None, 50 * S) == pytest.approx(100 * np.sqrt(np.trace(cov[3:, 3:])), rel=1e-9)


def test_an_error_estimate_grows_as_a_random_walk_up_to_its_window() -> None:
    drift = DriftEstimator()
    sent(drift, 11)
    drift.correct(10)  # at 1 s
    told = [drift.expected_cm(2.0, round((1 + age) * S)) for age in (0, 0.05, 1.25, 5, 60)]
    assert told == pytest.approx([0.0, 0.2, 1.0, 2.0, 2.0])


def test_a_new_segment_has_no_drift() -> None:
    drift = DriftEstimator()
    sent(drift, 20)
    fresh = Keyframe(20, -1, 2 * S, np.eye(4), COV, np.eye(4), UP, 0.01, EMPTY)
    drift.add_keyframe(fresh, 2 * S)
    assert drift.expected_cm(None, 2 * S) == 0.0
    assert drift.expected_cm(1.0, 3 * S) == pytest.approx(np.sqrt(0.2))
