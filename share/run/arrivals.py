"""Frames when they come: of a recording, when the sensor would have delivered them; of a camera, now."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol

from share.core.events import Tick
from share.io.live import LiveSource
from share.run.late import Late
from share.types import Frame

READ_AHEAD = 30  # frames decoded before they are due
_WAIT_S = 0.1
_DROPS_S = 2.0  # so long images that were left out are spoken of
_TOO_SLOW = "too slow for the camera: images are left out"

Frames = Callable[[], Iterator[Frame]]  # begins to decode


class Arrivals(Protocol):
    """`each` gives frames and when they arrived, on the monotonic clock (ns), until the end or `stop`."""

    def each(self) -> Iterator[tuple[Frame, int]]: ...

    def stop(self) -> None: ...

    def tick(self) -> Tick:
        """What is known now of images that are not tracked yet, and of the sensors."""
        ...


class Played:
    """A recording at its own pace, decoded ahead in a thread of its own, which waits for room (`block`).

    What cannot be read on is raised after the frames before it.
    """

    def __init__(self, frames: Frames, late: Late) -> None:
        self._frames, self._late = frames, late
        self._queue: queue.Queue[Frame | None] = queue.Queue(READ_AHEAD)
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._in_hand = False  # a frame that was given is worked on

    def tick(self) -> Tick:
        return Tick(time.monotonic_ns() if self._in_hand else None)

    def stop(self) -> None:
        self._stop.set()

    def each(self) -> Iterator[tuple[Frame, int]]:
        reader = threading.Thread(target=self._read, name="reader", daemon=True)
        reader.start()
        try:
            yield from self._due()
        finally:
            self._stop.set()
            reader.join(timeout=2)
        if self._error is not None:
            raise self._error

    def _due(self) -> Iterator[tuple[Frame, int]]:
        began: tuple[int, int] | None = None
        while not self._stop.is_set():
            try:
                frame = self._queue.get(timeout=_WAIT_S)
            except queue.Empty:
                continue
            if frame is None:
                return
            now = time.monotonic_ns()
            began = (now, frame.stamp_ns) if began is None else began
            due = began[0] + frame.stamp_ns - began[1]
            if due > now and self._stop.wait((due - now) * 1e-9):
                return
            behind_ns, another = time.monotonic_ns() - due, not self._queue.empty()
            if (taken := self._late.take(frame, behind_ns, another)) is not None:
                self._in_hand = True
                yield taken, due
                self._in_hand = False

    def _read(self) -> None:
        try:
            for frame in self._frames():
                if not self._put(frame):
                    return
        except BaseException as error:
            self._error = error
        finally:
            self._put(None)

    def _put(self, frame: Frame | None) -> bool:
        """Wait for room, unless the run is over."""
        while not self._stop.is_set():
            try:
                self._queue.put(frame, timeout=_WAIT_S)
                return True
            except queue.Full:
                continue
        return False


class Seen:
    """A live camera's frames, read by who tracks them: what waits meanwhile, waits in the camera's own queue,
    whose policy `drop_old_image` keeps the newest."""

    def __init__(self, frames: Frames, camera: LiveSource) -> None:
        self._frames, self._camera = frames, camera
        self._dropped = 0
        self._dropped_at = -_DROPS_S  # when it last grew

    def tick(self) -> Tick:
        now, dropped = time.monotonic(), self._camera.images_dropped
        if dropped > self._dropped:
            self._dropped, self._dropped_at = dropped, now
        slow = _TOO_SLOW if now - self._dropped_at < _DROPS_S else ""
        return Tick(self._camera.image_ns, "; ".join(filter(None, (self._camera.trouble, slow))))

    def stop(self) -> None:
        self._camera.stop()

    def each(self) -> Iterator[tuple[Frame, int]]:
        for frame in self._frames():
            yield frame, self._camera.arrived_ns(frame.stamp_ns)
