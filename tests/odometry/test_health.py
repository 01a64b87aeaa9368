"""Whether the filter is wrong, and not the light."""

from __future__ import annotations

import numpy as np
import pytest

from share.odometry.health import DivergenceMonitor, ImageImuConsistency

FRAME_S = 1 / 30
MANY = 60  # features


@pytest.fixture
def straying() -> DivergenceMonitor:
    return DivergenceMonitor()


def test_nothing_of_what_should_be_there_three_times_in_a_row(straying: DivergenceMonitor) -> None:
    for _ in range(2):
        straying.add(True, in_view=MANY, found_count=5, inlier_count=5, interval_s=FRAME_S)
    assert straying.is_suspected
    straying.add(True, in_view=MANY, found_count=6, inlier_count=6, interval_s=FRAME_S)
    assert not straying.is_suspected
    for count in range(3):
        assert straying.has_diverged == (count == 3)
        straying.add(True, in_view=MANY, found_count=5, inlier_count=5, interval_s=FRAME_S)
    assert straying.has_diverged


def test_nothing_believed_for_a_second(straying: DivergenceMonitor) -> None:
    """Though all is found where it should be."""
    for _ in range(30):
        straying.add(True, in_view=MANY, found_count=MANY, inlier_count=5, interval_s=FRAME_S)
    assert straying.is_suspected
    assert not straying.has_diverged
    straying.add(True, in_view=MANY, found_count=MANY, inlier_count=5, interval_s=FRAME_S)
    assert straying.has_diverged


def test_frames_in_which_nothing_is_left_to_be_seen_do_not_acquit(straying: DivergenceMonitor) -> None:
    """All is refused and given up; the next frame has nothing to look for, and takes new features."""
    for _ in range(30):
        straying.add(True, in_view=MANY, found_count=MANY, inlier_count=0, interval_s=FRAME_S)
        straying.add(True, in_view=0, found_count=0, inlier_count=0, interval_s=FRAME_S)
    assert straying.is_suspected and not straying.has_diverged
    straying.add(True, in_view=MANY, found_count=MANY, inlier_count=0, interval_s=FRAME_S)
    assert straying.has_diverged


def test_one_sight_acquits(straying: DivergenceMonitor) -> None:
    for k in range(90):
        straying.add(
            True, in_view=MANY, found_count=MANY, inlier_count=MANY if k % 20 == 19 else 0, interval_s=FRAME_S
        )
    assert not straying.has_diverged


def test_a_gap_counts_for_no_more_than_a_frame_can(straying: DivergenceMonitor) -> None:
    for _ in range(4):
        straying.add(True, in_view=MANY, found_count=MANY, inlier_count=0, interval_s=10.0)
    assert not straying.has_diverged


@pytest.mark.parametrize(("textured", "due"), [(False, MANY), (True, 5)])
def test_the_dark_and_what_has_left_the_view_tell_nothing(
    straying: DivergenceMonitor, textured: bool, due: int
) -> None:
    for _ in range(100):
        straying.add(textured, due, found_count=0, inlier_count=0, interval_s=FRAME_S)
    assert not straying.is_suspected


def test_the_dark_does_not_acquit(straying: DivergenceMonitor) -> None:
    """Two frames with nothing of what should be there, a dark one, and a third."""
    for textured in (True, True, False, True):
        straying.add(textured, in_view=MANY, found_count=0, inlier_count=0, interval_s=FRAME_S)
    assert straying.has_diverged


def test_images_and_imu_that_contradict_each_other_for_seconds() -> None:
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


def test_a_few_features_and_the_first_second_say_nothing_of_the_calibration() -> None:
    few, young = ImageImuConsistency(), ImageImuConsistency()
    for _ in range(300):
        few.add(np.full(24, 5.0), FRAME_S)
    for _ in range(29):
        young.add(np.full(MANY, 5.0), FRAME_S)
    assert few.is_consistent
    assert young.is_consistent
