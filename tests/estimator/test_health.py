"""Whether the filter is wrong, and not the light."""

from __future__ import annotations

import numpy as np
import pytest

from share.odometry.outliers import Agreement, Straying

FRAME_S = 1 / 30
MANY = 60  # features


@pytest.fixture
def straying() -> Straying:
    return Straying(weak=25, blind=6)


def test_nothing_of_what_should_be_there_three_times_in_a_row(straying: Straying) -> None:
    for _ in range(2):
        straying.add(True, due=MANY, found=5, seen=5, seconds=FRAME_S)
    assert straying.suspected
    straying.add(True, due=MANY, found=6, seen=6, seconds=FRAME_S)
    assert not straying.suspected
    for count in range(3):
        assert straying.certain == (count == 3)
        straying.add(True, due=MANY, found=5, seen=5, seconds=FRAME_S)
    assert straying.certain


def test_nothing_believed_for_a_second(straying: Straying) -> None:
    """Though all is found where it should be."""
    for _ in range(30):
        straying.add(True, due=MANY, found=MANY, seen=5, seconds=FRAME_S)
    assert straying.suspected
    assert not straying.certain
    straying.add(True, due=MANY, found=MANY, seen=5, seconds=FRAME_S)
    assert straying.certain


def test_frames_in_which_nothing_is_left_to_be_seen_do_not_acquit(straying: Straying) -> None:
    """All is refused and given up; the next frame has nothing to look for, and takes new features."""
    for _ in range(30):
        straying.add(True, due=MANY, found=MANY, seen=0, seconds=FRAME_S)
        straying.add(True, due=0, found=0, seen=0, seconds=FRAME_S)
    assert straying.suspected and not straying.certain
    straying.add(True, due=MANY, found=MANY, seen=0, seconds=FRAME_S)
    assert straying.certain


def test_one_sight_acquits(straying: Straying) -> None:
    for k in range(90):
        straying.add(True, due=MANY, found=MANY, seen=MANY if k % 20 == 19 else 0, seconds=FRAME_S)
    assert not straying.certain


def test_a_gap_counts_for_no_more_than_a_frame_can(straying: Straying) -> None:
    for _ in range(4):
        straying.add(True, due=MANY, found=MANY, seen=0, seconds=10.0)
    assert not straying.certain


@pytest.mark.parametrize(("textured", "due"), [(False, MANY), (True, 5)])
def test_the_dark_and_what_has_left_the_view_tell_nothing(
    straying: Straying, textured: bool, due: int
) -> None:
    for _ in range(100):
        straying.add(textured, due, found=0, seen=0, seconds=FRAME_S)
    assert not straying.suspected


def test_the_dark_does_not_acquit(straying: Straying) -> None:
    """Two frames with nothing of what should be there, a dark one, and a third."""
    for textured in (True, True, False, True):
        straying.add(textured, due=MANY, found=0, seen=0, seconds=FRAME_S)
    assert straying.certain


def test_images_and_imu_that_contradict_each_other_for_seconds() -> None:
    agreement = Agreement()
    for _ in range(90):
        agreement.add(np.full(MANY, 0.4), FRAME_S)
    assert agreement.sound
    for _ in range(90):
        agreement.add(np.full(MANY, 2.0), FRAME_S)
    assert not agreement.sound
    for _ in range(600):
        agreement.add(np.full(MANY, 0.4), FRAME_S)
    assert agreement.sound


def test_a_few_features_and_the_first_second_say_nothing_of_the_calibration() -> None:
    few, young = Agreement(), Agreement()
    for _ in range(300):
        few.add(np.full(24, 5.0), FRAME_S)
    for _ in range(29):
        young.add(np.full(MANY, 5.0), FRAME_S)
    assert few.sound
    assert young.sound
