"""Frames when they come: of a recording, when the sensor would have delivered them; of a camera, now."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Protocol

from share.cameras.live import LiveSource
from share.protocol.agent_events import Tick
from share.protocol.agent_status import LATE_S
from share.types import Frame, ImuBatch

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
        self._dropped: int | None = None  # before the first frame nobody has read the camera yet
        self._dropped_at = -_DROPS_S  # when it last grew

    def tick(self) -> Tick:
        now, dropped = time.monotonic(), self._camera.images_dropped
        if self._dropped is not None and dropped > self._dropped:
            self._dropped, self._dropped_at = dropped, now
        slow = _TOO_SLOW if now - self._dropped_at < _DROPS_S else ""
        return Tick(self._camera.image_ns, "; ".join(filter(None, (self._camera.trouble, slow))))

    def stop(self) -> None:
        self._camera.stop()

    def each(self) -> Iterator[tuple[Frame, int]]:
        for frame in self._frames():
            if self._dropped is None:
                self._dropped = self._camera.images_dropped
            yield frame, self._camera.arrived_ns(frame.stamp_ns)


# ---- A loop that cannot keep up leaves frames out and holds its rate: policy `drop_late`.


class Late:
    """Of frames in order, those that may be tracked. What the IMU said between them stays."""

    def __init__(self, late_ms: float) -> None:
        """late_ms: 0: however late, no frame is left out."""
        self._late_ns = late_ms * 1e6
        self._imu: list[ImuBatch] = []
        self.dropped = 0  # frames

    def take(self, frame: Frame, behind_ns: int, another: bool) -> Frame | None:
        """The frame, with the IMU samples since the last one; None where it is left out: it begins to be
        tracked `behind_ns` after it arrived, and another waits."""
        if another and 0 < self._late_ns < behind_ns:
            self.dropped += 1
            self._imu.append(frame.imu)
            return None
        heard, self._imu = self._imu, []
        return replace(frame, imu=heard[0].join(*heard[1:], frame.imu)) if heard else frame


# ---- That poses come late is said, since nothing else shows it where no frame is left out.

_SAID_S = 1.0  # the first warning; the next at twice what was said
_MEND = (
    "consider agent.late_ms, by which frames that are late are left out, smaller images or a faster machine"
)


class Lateness:
    """Counts frames whose pose came more than LATE_S after their image, and says how late poses are, once and
    again where that doubles."""

    def __init__(self, say: Callable[[str], None], slow: str) -> None:
        """slow: who is to blame, such as "this machine"."""
        self._say, self._slow = say, slow
        self._next_s = _SAID_S
        self._frames, self._most_s = 0, 0.0

    def done(self, track_ms: float) -> None:
        """A frame is tracked, so long after its image came."""
        late_s = track_ms / 1e3
        self._frames += late_s > LATE_S
        self._most_s = max(self._most_s, late_s)
        if late_s >= self._next_s:
            self._next_s = 2 * late_s
            self._say(f"poses are {late_s:.1f} s late: {self._slow} is too slow for this source; {_MEND}")

    def report(self) -> dict[str, Any]:
        return {"frames_late": self._frames, "latest_s": round(self._most_s, 3)}
