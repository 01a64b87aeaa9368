"""A camera's feed on a camera that is none: what it says, and what it goes on through."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from share.core.intake import Sample
from share.core.watchdog import Watchdog
from share.errors import NotAttachedError, ShareError, UsageError
from share.geometry.camera import Rig
from share.io.feed import Feed
from share.io.handover import Handover
from share.io.profile import profile

RATES = {"cam0": 30.0, "accel": 250.0, "gyro": 400.0}


@dataclass
class Fake:
    """A camera that delivers what it is told to."""

    rig: Rig = field(default_factory=profile("d435i").rig)
    serial: str = "0123"
    rates_hz: dict[str, float] = field(default_factory=lambda: dict(RATES))
    sink: Callable[[Sample], None] = print

    def start(self, sink: Callable[[Sample], None]) -> None:
        self.sink = sink

    def stop(self) -> None:
        pass

    def reset(self) -> None:
        pass


def quick(now_ns: int, streams: Collection[str]) -> Watchdog:
    return Watchdog(now_ns, streams, silent_ms=100, warm_up_ms=100, retry_ms=10)


def wait(until: Callable[[], bool]) -> None:
    end = time.monotonic() + 5
    while not until():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_why_a_camera_is_still_away_is_said_once_unless_it_is_just_not_there() -> None:
    answers: list[Fake | ShareError] = [
        Fake(),
        NotAttachedError("no RealSense camera is attached"),
        ShareError("cannot be opened: busy"),
        ShareError("cannot be opened: busy"),
        NotAttachedError("no RealSense camera is attached"),
        UsageError("is on USB 2.1, too slow"),
        Fake(),
    ]
    said: list[str] = []

    def connect(serial: str | None, epoch: int) -> Fake:
        answer = answers.pop(0) if answers else Fake()
        if isinstance(answer, ShareError):
            raise answer
        return answer

    feed = Feed(connect, None, RATES, 10.0, said.append, Handover(), quick)
    feed.open()
    reader = threading.Thread(target=lambda: list(feed.measurements()), daemon=True)
    reader.start()
    wait(lambda: len(said) >= 4)
    feed.stop()
    reader.join(5)
    assert said[:4] == [
        "no more samples come; looks for camera 0123 until it is back",
        "cannot be opened: busy",
        "is on USB 2.1, too slow",
        "camera 0123 is connected again; a new stretch begins",
    ]


def test_gaps_are_told_by_the_rates_that_the_camera_has() -> None:
    slow = Fake(rates_hz=RATES | {"accel": 100.0})
    feed = Feed(lambda serial, epoch: slow, None, RATES, 10.0, print, Handover())
    feed.open()
    for at_ms in range(0, 1000, 10):
        for stream in ("accel", "gyro"):
            slow.sink(Sample(stream, at_ms * 10**6, (0, 0, 0), at_ms * 10**6))
    feed.stop()
    joined = list(feed.measurements())
    assert len(joined) == 100
    assert (feed.intake.streams["accel"].gaps, feed.intake.streams["gyro"].gaps) == (0, 99)
