"""Frames in flight are bounded, the newest waits, and IMU samples of dropped frames are kept."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from share.protocol.streaming import FrameWindow
from share.types import Frame, ImuBatch
from share.wire.messages import MAX_IMU_SAMPLES


def frame(index: int, samples: int = 1) -> Frame:
    stamps = np.arange(samples) + 1000 * index
    imu = ImuBatch(stamps, np.zeros((samples, 3)), np.zeros((samples, 3)))
    return Frame(1000 * index, index, np.zeros((2, 2), np.uint8), imu=imu)


def offered(window: FrameWindow, index: int, now_ns: int = 0) -> int | None:
    window.offer(frame(index), index)
    went = window.take_next(now_ns)
    return None if went is None else went.index


def test_the_newest_frame_waits_and_carries_the_imu_samples_of_dropped_ones() -> None:
    window = FrameWindow(2)
    assert [offered(window, i) for i in range(6)] == [0, 1, None, None, None, None]
    assert (window.dropped, window.unanswered) == (3, 0)
    sent = window.take_answered(0)
    assert sent is not None
    assert (sent.frame.index, sent.arrived_ns) == (0, 0)
    went = window.take_next(0)
    assert went is not None
    assert went.index == 5
    assert went.imu.stamps_ns.tolist() == [2000, 3000, 4000, 5000]
    assert window.take_next(0) is None
    assert not window.is_idle


def test_an_answer_expires_earlier_frames() -> None:
    window = FrameWindow(3)
    assert [offered(window, i) for i in range(3)] == [0, 1, 2]
    assert window.take_answered(1) is not None
    assert window.unanswered == 1
    assert window.take_answered(0) is None
    assert window.take_answered(1) is None
    assert window.take_answered(2) is not None
    assert window.is_idle


def test_the_imu_samples_of_a_cancelled_frame_go_with_the_next() -> None:
    window = FrameWindow(1)
    assert offered(window, 0) == 0
    window.cancel(0)
    assert window.is_idle
    window.offer(frame(1), 0)
    went = window.take_next(0)
    assert went is not None
    assert went.imu.stamps_ns.tolist() == [0, 1000]


def test_unanswered_frames_expire() -> None:
    window = FrameWindow(2)
    for i in range(3):
        offered(window, i, now_ns=10 * i)
    window.expire(before_ns=5)
    assert window.unanswered == 1
    went = window.take_next(20)
    assert went is not None
    assert went.index == 2
    window.clear()
    assert (window.unanswered, window.is_idle) == (3, True)


def test_kept_imu_samples_are_bounded() -> None:
    window = FrameWindow(1)
    for i in range(5):
        window.skip(frame(i, MAX_IMU_SAMPLES // 2))
    window.offer(frame(5, 10), 0)
    went = window.take_next(0)
    assert went is not None
    assert len(went.imu) == MAX_IMU_SAMPLES
    assert went.imu.stamps_ns[-1] == 5009


@given(st.lists(st.sampled_from(["offer", "answer the oldest", "answer the newest"]), max_size=60))
def test_every_frame_is_counted_once_and_every_sample_is_sent_once(acts: list[str]) -> None:
    window, came, answered = FrameWindow(2), 0, 0
    under_way, heard = list[int](), list[int]()
    for act in acts:
        if act == "offer":
            window.offer(frame(came), 0)
            came += 1
        elif under_way:
            at = 0 if act == "answer the oldest" else len(under_way) - 1
            assert window.take_answered(under_way[at]) is not None
            del under_way[: at + 1]
            answered += 1
        if (went := window.take_next(0)) is not None:
            under_way.append(went.index)
            heard += went.imu.stamps_ns.tolist()
        assert len(under_way) <= 2
    waiting = came - answered - window.dropped - window.unanswered - len(under_way)
    assert waiting in (0, 1)
    assert window.is_idle == (not under_way and not waiting)
    assert heard == list(range(0, 1000 * len(heard), 1000))
