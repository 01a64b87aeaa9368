"""Path, rotation and position sigma of the motion in a window."""

from __future__ import annotations

import numpy as np
import pytest

from share.geometry import se3
from share.odometry.error_model.history import FrameOutcome, MotionHistory
from share.types import OdometryKeyframe, TrackState, View

S = 1_000_000_000
NOTHING = View(np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 32), np.uint8))
AHEAD = se3.from_quat(np.array([[2.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]]))[0]


def candidate(T: np.ndarray, sigma_rad: float, sigma_m: float, new: bool = False) -> OdometryKeyframe:
    cov = np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)
    return OdometryKeyframe(np.eye(4), T, cov, np.zeros(3), 0.0, NOTHING, new)


def outcome(stamp_ns: int) -> FrameOutcome:
    return FrameOutcome(stamp_ns, True, TrackState.OK, 50, 40, 1.4)


def test_variances_of_independent_motions_add_up():
    history = MotionHistory(5.0)
    for k in range(4):
        sigma_cm = history.add_keyframe(k * S, candidate(np.eye(4), 0.0, 0.001)).sigma_cm
        assert sigma_cm == pytest.approx(0.1 * np.sqrt(3 * k))


def test_older_motion_than_the_window_is_dropped():
    history = MotionHistory(5.0)
    history.add_keyframe(-S, candidate(np.eye(4), 0.0, 0.0, new=True))
    history.add_keyframe(0, candidate(AHEAD, 0.0, 1.0))
    history.add_keyframe(3 * S, candidate(AHEAD, 0.0, 0.002))
    for k in range(6):
        history.add_frame(outcome(k * S))
    motion = history.add_keyframe(5 * S, candidate(AHEAD, 0.0, 0.001))
    assert motion.sigma_cm == pytest.approx(0.1 * np.sqrt(3 * 5))
    assert len(motion.sigmas_cm) == 2
    assert motion.path_m == pytest.approx(4)
    assert [frame.stamp_ns // S for frame in motion.frames] == [1, 2, 3, 4, 5]


def test_sigmas_of_the_window_are_kept():
    history = MotionHistory(5.0)
    for k in range(3):
        motion = history.add_keyframe(k * S, candidate(np.eye(4), 0.0, 0.001))
    assert motion.sigmas_cm == pytest.approx(0.1 * np.sqrt(3 * np.arange(3)))


def test_path_and_rotation_add_up():
    history = MotionHistory(5.0)
    left = se3.exp(np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0]))
    assert history.add_keyframe(S, candidate(left, 0.0, 0.0, new=True)) == ((), 0.0, 0.0, (0.0,))
    for _ in range(2):
        motion = history.add_keyframe(2 * S, candidate(left @ AHEAD, 0.0, 0.0))
    assert motion.path_m == pytest.approx(4)
    assert motion.rotation_rad == pytest.approx(np.pi)


def test_rotation_uncertainty_moves_later_positions():
    """By its lever: 0.01 rad about either axis across 2 m ahead is 2 cm."""
    history = MotionHistory(5.0)
    history.add_keyframe(-S, candidate(np.eye(4), 0.0, 0.0, new=True))
    history.add_keyframe(0, candidate(np.eye(4), 0.01, 0.0))
    assert history.add_keyframe(S, candidate(AHEAD, 0.0, 0.0)).sigma_cm == pytest.approx(2 * np.sqrt(2))


def test_a_new_segment_starts_without_uncertainty_or_history():
    history = MotionHistory(5.0)
    for k in range(3):
        history.add_frame(outcome(k * S))
        motion = history.add_keyframe(k * S, candidate(AHEAD, 0.0, 1.0, new=k != 1))
    assert motion == ((outcome(2 * S),), 0.0, 0.0, (0.0,))


def test_frames_after_a_late_keyframe_do_not_count_to_it():
    history = MotionHistory(5.0)
    history.add_keyframe(-S, candidate(np.eye(4), 0.0, 0.0, new=True))
    for k in range(8):
        history.add_frame(outcome(k * S))
    motion = history.add_keyframe(5 * S, candidate(AHEAD, 0.0, 0.001))
    assert [frame.stamp_ns // S for frame in motion.frames] == [1, 2, 3, 4, 5]
    motion = history.add_keyframe(7 * S, candidate(AHEAD, 0.0, 0.001))
    assert [frame.stamp_ns // S for frame in motion.frames] == [3, 4, 5, 6, 7]
