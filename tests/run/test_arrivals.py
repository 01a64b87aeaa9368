"""A recording at its own pace: decoded so far ahead, in order, to its end or to what cannot be read on."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from share.protocol.agent_events import AgentTick
from share.runtime.arrivals import READ_AHEAD, LateFrameDropper, LiveArrivals, RecordedArrivals
from share.types import Frame, ImuBatch

_PATIENCE_S = 5.0
_WHILE_S = 0.3  # in which a thread that is free to decode would


class _Recording:
    """Frames that are all due at once; counts those that were decoded, and fails at number `broken`."""

    def __init__(self, count: int, broken: int = -1) -> None:
        self._count, self._broken = count, broken
        self.decoded = 0
        self.changed = threading.Condition()

    def frames(self) -> Iterator[Frame]:
        for index in range(self._count):
            if index == self._broken:
                raise ValueError("cannot be read on")
            with self.changed:
                self.decoded += 1
                self.changed.notify_all()
            yield Frame(0, index, np.zeros((2, 2), np.uint8), None, None, ImuBatch.empty())

    def reaches(self, decoded: int, within_s: float = _PATIENCE_S) -> bool:
        with self.changed:
            return self.changed.wait_for(lambda: self.decoded >= decoded, within_s)


def test_no_more_is_decoded_ahead_than_there_is_room_for() -> None:
    recording = _Recording(2 * READ_AHEAD)
    played = RecordedArrivals(recording.frames, LateFrameDropper(0.0)).iter_frames()
    next(played)
    most = READ_AHEAD + 2  # one with the tracker, one that waits for room
    assert recording.reaches(most)
    assert not recording.reaches(most + 1, _WHILE_S)


def test_every_frame_comes_in_order_and_the_end_ends_it() -> None:
    count = 3 * READ_AHEAD
    played = RecordedArrivals(_Recording(count).frames, LateFrameDropper(0.0)).iter_frames()
    assert [frame.index for frame, _ in played] == list(range(count))


def test_what_cannot_be_read_on_is_raised_after_the_frames_before_it() -> None:
    played = RecordedArrivals(_Recording(50, broken=40).frames, LateFrameDropper(0.0)).iter_frames()
    assert [next(played)[0].index for _ in range(40)] == list(range(40))
    with pytest.raises(ValueError, match="cannot be read on"):
        next(played)


def test_a_stop_ends_it_while_the_reader_waits_for_room() -> None:
    recording = _Recording(2 * READ_AHEAD)
    arrivals = RecordedArrivals(recording.frames, LateFrameDropper(0.0))
    played = arrivals.iter_frames()
    next(played)
    assert recording.reaches(READ_AHEAD)
    arrivals.stop()
    assert list(played) == []
    assert not [t for t in threading.enumerate() if t.name == "reader"]


class _Camera:
    """A live camera by what its arrivals ask of it."""

    image_ns, trouble, images_dropped = 7, "", 61

    def arrived_ns(self, stamp_ns: int) -> int:
        return stamp_ns


def test_images_left_out_are_told_but_not_those_before_anybody_read_the_camera() -> None:
    camera: Any = _Camera()
    seen = LiveArrivals(_Recording(3).frames, camera)
    assert seen.tick() == AgentTick(7, "")
    frames = seen.iter_frames()
    next(frames)
    assert seen.tick().sensor_trouble == ""
    camera.images_dropped += 1
    assert seen.tick().sensor_trouble == "too slow for the camera: images are dropped"
