"""How far an agent went in a window, what its tracker's own covariances say of the error, how it fared."""

from __future__ import annotations

import numpy as np
import pytest

from share.geometry import se3
from share.odometry.error_model.history import FrameOutcome, MotionHistory
from share.types import KeyframeCandidate, TrackState, View

S = 1_000_000_000
NOTHING = View(np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 32), np.uint8))
AHEAD = se3.from_quat(np.array([[2.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]]))[0]


def candidate(T: np.ndarray, sigma_rad: float, sigma_m: float, new: bool = False) -> KeyframeCandidate:
    cov = np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)
    return KeyframeCandidate(np.eye(4), T, cov, np.zeros(3), 0.0, NOTHING, new)


def fared(stamp_ns: int) -> FrameOutcome:
    return FrameOutcome(stamp_ns, True, TrackState.OK, 50, 40, 1.4)


def test_independent_motions_add_up_as_their_variances_do():
    odometer = MotionHistory(5.0)
    for k in range(4):
        sigma_cm = odometer.add_keyframe(k * S, candidate(np.eye(4), 0.0, 0.001)).sigma_cm
        assert sigma_cm == pytest.approx(0.1 * np.sqrt(3 * k))


def test_what_is_older_than_the_window_is_forgotten():
    odometer = MotionHistory(5.0)
    odometer.add_keyframe(-S, candidate(np.eye(4), 0.0, 0.0, new=True))
    odometer.add_keyframe(0, candidate(AHEAD, 0.0, 1.0))
    odometer.add_keyframe(3 * S, candidate(AHEAD, 0.0, 0.002))
    for k in range(6):
        odometer.add_frame(fared(k * S))
    lately = odometer.add_keyframe(5 * S, candidate(AHEAD, 0.0, 0.001))
    assert lately.sigma_cm == pytest.approx(0.1 * np.sqrt(3 * 5))
    assert len(lately.sigmas_cm) == 2
    assert lately.path_m == pytest.approx(4)
    assert [frame.stamp_ns // S for frame in lately.frames] == [1, 2, 3, 4, 5]


def test_sigmas_of_the_window_are_kept():
    odometer = MotionHistory(5.0)
    for k in range(3):
        lately = odometer.add_keyframe(k * S, candidate(np.eye(4), 0.0, 0.001))
    assert lately.sigmas_cm == pytest.approx(0.1 * np.sqrt(3 * np.arange(3)))


def test_ways_and_turns_add_up():
    odometer = MotionHistory(5.0)
    left = se3.exp(np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0]))
    assert odometer.add_keyframe(S, candidate(left, 0.0, 0.0, new=True)) == ((), 0.0, 0.0, (0.0,))
    for _ in range(2):
        lately = odometer.add_keyframe(2 * S, candidate(left @ AHEAD, 0.0, 0.0))
    assert lately.path_m == pytest.approx(4)
    assert lately.rotation_rad == pytest.approx(np.pi)


def test_a_turn_that_is_doubted_moves_what_comes_after():
    """By its lever: 0.01 rad about either axis across 2 m ahead is 2 cm."""
    odometer = MotionHistory(5.0)
    odometer.add_keyframe(-S, candidate(np.eye(4), 0.0, 0.0, new=True))
    odometer.add_keyframe(0, candidate(np.eye(4), 0.01, 0.0))
    assert odometer.add_keyframe(S, candidate(AHEAD, 0.0, 0.0)).sigma_cm == pytest.approx(2 * np.sqrt(2))


def test_a_stretch_that_begins_is_sure_of_itself_and_forgets_what_was_before_it():
    odometer = MotionHistory(5.0)
    for k in range(3):
        odometer.add_frame(fared(k * S))
        lately = odometer.add_keyframe(k * S, candidate(AHEAD, 0.0, 1.0, new=k != 1))
    assert lately == ((fared(2 * S),), 0.0, 0.0, (0.0,))


def test_what_came_after_a_keyframe_that_is_told_late_is_not_of_it():
    odometer = MotionHistory(5.0)
    odometer.add_keyframe(-S, candidate(np.eye(4), 0.0, 0.0, new=True))
    for k in range(8):
        odometer.add_frame(fared(k * S))
    lately = odometer.add_keyframe(5 * S, candidate(AHEAD, 0.0, 0.001))
    assert [frame.stamp_ns // S for frame in lately.frames] == [1, 2, 3, 4, 5]
    lately = odometer.add_keyframe(7 * S, candidate(AHEAD, 0.0, 0.001))
    assert [frame.stamp_ns // S for frame in lately.frames] == [3, 4, 5, 6, 7]
