"""Frames that come too late."""

import numpy as np
import pytest

from share.runtime.arrivals import LateFrameDropper
from share.types import Frame, ImuBatch

MS = 1_000_000
IMAGE = np.zeros((4, 4), np.uint8)


def frame(k):
    stamps = np.array([10 * k, 10 * k + 5], np.int64) * MS
    return Frame(10 * k * MS, k, IMAGE, imu=ImuBatch(stamps, np.full((2, 3), k), np.full((2, 3), -k)))


def test_a_late_frame_is_left_out_if_another_waits():
    late = LateFrameDropper(20.0)
    assert late.admit(frame(0), 19 * MS, has_next=True) is not None
    assert late.admit(frame(1), 21 * MS, has_next=True) is None
    assert late.admit(frame(2), 21 * MS, has_next=True) is None
    assert late.dropped == 2


def test_the_next_frame_has_all_that_the_imu_said():
    late = LateFrameDropper(20.0)
    late.admit(frame(1), 30 * MS, has_next=True)
    late.admit(frame(2), 30 * MS, has_next=True)
    taken = late.admit(frame(3), 5 * MS, has_next=True)
    assert taken.index == 3
    assert taken.imu.stamps_ns.tolist() == [10 * MS, 15 * MS, 20 * MS, 25 * MS, 30 * MS, 35 * MS]
    assert taken.imu.gyro[:, 0].tolist() == [1, 1, 2, 2, 3, 3]
    assert taken.imu.accel[:, 0].tolist() == [-1, -1, -2, -2, -3, -3]
    assert late.admit(frame(4), 0, has_next=True).imu.stamps_ns.tolist() == [40 * MS, 45 * MS]


@pytest.mark.parametrize(("late_ms", "another"), [(0.0, True), (20.0, False)])
def test_none_is_left_out_where_none_may_be_or_none_waits(late_ms, another):
    late = LateFrameDropper(late_ms)
    assert late.admit(frame(1), 10**12, another) is not None
    assert late.dropped == 0
