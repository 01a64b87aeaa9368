"""Divergence of the filter and consistency of images and IMU; dark images do not count."""

from __future__ import annotations

import numpy as np
import pytest

from share.odometry.health import DivergenceMonitor, ImageImuConsistency, is_plausible
from share.odometry.state import CORE_SIZE, POSE, add_keyframe, initial_state

FRAME_S = 1 / 30
MANY = 60  # features


@pytest.fixture
def monitor() -> DivergenceMonitor:
    return DivergenceMonitor()


def test_three_frames_without_expected_features_diverge(monitor: DivergenceMonitor) -> None:
    for _ in range(2):
        monitor.add(True, in_view=MANY, found_count=5, inlier_count=5, interval_s=FRAME_S)
    assert monitor.is_suspected
    for _ in range(3):
        monitor.add(True, in_view=MANY, found_count=6, inlier_count=6, interval_s=FRAME_S)
    assert not monitor.is_suspected
    for count in range(3):
        assert monitor.has_diverged == (count == 3)
        monitor.add(True, in_view=MANY, found_count=5, inlier_count=5, interval_s=FRAME_S)
    assert monitor.has_diverged


def test_a_second_of_outliers_only_diverges(monitor: DivergenceMonitor) -> None:
    """Though all is found where it should be."""
    for _ in range(30):
        monitor.add(True, in_view=MANY, found_count=MANY, inlier_count=5, interval_s=FRAME_S)
    assert monitor.is_suspected
    assert not monitor.has_diverged
    monitor.add(True, in_view=MANY, found_count=MANY, inlier_count=5, interval_s=FRAME_S)
    assert monitor.has_diverged


def test_frames_without_features_in_view_do_not_reset(monitor: DivergenceMonitor) -> None:
    """All is refused and given up; the next frame has nothing to look for, and takes new features."""
    for _ in range(30):
        monitor.add(True, in_view=MANY, found_count=MANY, inlier_count=0, interval_s=FRAME_S)
        monitor.add(True, in_view=0, found_count=0, inlier_count=0, interval_s=FRAME_S)
    assert monitor.is_suspected and not monitor.has_diverged
    monitor.add(True, in_view=MANY, found_count=MANY, inlier_count=0, interval_s=FRAME_S)
    assert monitor.has_diverged


def test_a_frame_with_inliers_now_and_then_does_not_reset(monitor: DivergenceMonitor) -> None:
    """New features agree with a wrong IMU for a frame or two."""
    diverged = []
    for k in range(90):
        inliers = MANY if k % 20 == 19 else 0
        monitor.add(True, in_view=MANY, found_count=MANY, inlier_count=inliers, interval_s=FRAME_S)
        diverged.append(monitor.has_diverged)
    assert diverged.index(True) == 32  # two frames more than without


def test_frames_with_inliers_make_up_for_as_many_without(monitor: DivergenceMonitor) -> None:
    for k in range(300):
        inliers = MANY if k % 20 >= 10 else 0
        monitor.add(True, in_view=MANY, found_count=MANY, inlier_count=inliers, interval_s=FRAME_S)
        assert not monitor.has_diverged


def test_drift_since_the_newest_keyframe_with_features_is_the_sum_since_then(
    monitor: DivergenceMonitor,
) -> None:
    monitor.add_keyframe(0.2, MANY)
    assert monitor.blind_drift_m == 0.0
    for _ in range(2):
        monitor.add_keyframe(0.2, 5)
    assert monitor.blind_drift_m == pytest.approx(0.4)
    state = initial_state(
        0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.eye(4), np.full(CORE_SIZE, 0.09)
    )
    add_keyframe(state, 0, np.zeros(3))
    state.cov[POSE.start + 3, POSE.start + 3] += 0.2**2  # moved since
    assert is_plausible(state, 8.0, 0.2)
    assert not is_plausible(state, 8.0, monitor.blind_drift_m)
    monitor.add_keyframe(0.2, 6)
    assert is_plausible(state, 8.0, monitor.blind_drift_m)


def test_a_gap_adds_at_most_the_longest_interval(monitor: DivergenceMonitor) -> None:
    for _ in range(4):
        monitor.add(True, in_view=MANY, found_count=MANY, inlier_count=0, interval_s=10.0)
    assert not monitor.has_diverged


@pytest.mark.parametrize(("textured", "due"), [(False, MANY), (True, 5)])
def test_dark_frames_and_features_out_of_view_do_not_count(
    monitor: DivergenceMonitor, textured: bool, due: int
) -> None:
    for _ in range(100):
        monitor.add(textured, due, found_count=0, inlier_count=0, interval_s=FRAME_S)
    assert not monitor.is_suspected


def test_dark_frames_do_not_reset(monitor: DivergenceMonitor) -> None:
    """Two frames with nothing of what should be there, a dark one, and a third."""
    for textured in (True, True, False, True):
        monitor.add(textured, in_view=MANY, found_count=0, inlier_count=0, interval_s=FRAME_S)
    assert monitor.has_diverged


def test_images_and_imu_that_disagree_for_seconds_are_inconsistent() -> None:
    agreement = ImageImuConsistency()
    for _ in range(90):
        agreement.add(np.full(MANY, 0.4), FRAME_S)
    assert agreement.is_consistent
    for _ in range(90):
        agreement.add(np.full(MANY, 2.0), FRAME_S)
    assert not agreement.is_consistent
    for _ in range(600):
        agreement.add(np.full(MANY, 0.4), FRAME_S)
    assert agreement.is_consistent


def test_few_features_and_the_first_second_do_not_count() -> None:
    few, young = ImageImuConsistency(), ImageImuConsistency()
    for _ in range(300):
        few.add(np.full(24, 5.0), FRAME_S)
    for _ in range(29):
        young.add(np.full(MANY, 5.0), FRAME_S)
    assert few.is_consistent
    assert young.is_consistent
