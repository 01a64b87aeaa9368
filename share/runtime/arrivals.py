"""Frames at their arrival times: recorded ones when the sensor would have delivered them, live ones at
once."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Protocol

from share.cameras.feed import CameraFeed
from share.protocol.agent_events import AgentTick
from share.protocol.agent_status import LATE_S
from share.types import Frame, ImuBatch

READ_AHEAD = 30  # frames decoded before they are due
_WAIT_S = 0.1
_DROP_WARNING_S = 2.0  # how long a warning about dropped images is shown
_TOO_SLOW = "too slow for the camera: images are dropped"
_FIRST_WARNING_S = 1.0  # lateness of poses at the first warning; the next comes at twice the last one
_LATE_FRAMES_ADVICE = "set agent.late_ms to drop late frames, or use smaller images or a faster machine"

FrameStream = Callable[[], Iterator[Frame]]  # starts decoding


class FrameArrivals(Protocol):
    """A source of frames with arrival times."""

    def iter_frames(self) -> Iterator[tuple[Frame, int]]:
        """Yield each frame and its arrival on the monotonic clock, ns, until the end or `stop`."""
        ...

    def stop(self) -> None: ...

    def tick(self) -> AgentTick:
        """Return the arrival of the oldest untracked image and the state of the sensors."""
        ...


class RecordedArrivals:
    """A recording at its recorded pace, decoded ahead by a thread that waits when its queue is full
    (`block`).

    A read error is raised after the frames before it.
    """

    def __init__(self, frames: FrameStream, late_dropper: LateFrameDropper) -> None:
        self._frames, self._late_dropper = frames, late_dropper
        self._queue: queue.Queue[Frame | None] = queue.Queue(READ_AHEAD)
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._is_tracking = False  # a yielded frame is being tracked

    def tick(self) -> AgentTick:
        return AgentTick(time.monotonic_ns() if self._is_tracking else None)

    def stop(self) -> None:
        self._stop.set()

    def iter_frames(self) -> Iterator[tuple[Frame, int]]:
        reader = threading.Thread(target=self._read_frames, name="reader", daemon=True)
        reader.start()
        try:
            yield from self._frames_when_due()
        finally:
            self._stop.set()
            reader.join(timeout=2)
        if self._error is not None:
            raise self._error

    def _frames_when_due(self) -> Iterator[tuple[Frame, int]]:
        first: tuple[int, int] | None = None
        while not self._stop.is_set():
            try:
                frame = self._queue.get(timeout=_WAIT_S)
            except queue.Empty:
                continue
            if frame is None:
                return
            now_ns = time.monotonic_ns()
            first = (now_ns, frame.stamp_ns) if first is None else first
            due_ns = first[0] + frame.stamp_ns - first[1]
            if due_ns > now_ns and self._stop.wait((due_ns - now_ns) * 1e-9):
                return
            late_ns, has_next = time.monotonic_ns() - due_ns, not self._queue.empty()
            if (admitted := self._late_dropper.admit(frame, late_ns, has_next)) is not None:
                self._is_tracking = True
                yield admitted, due_ns
                self._is_tracking = False

    def _read_frames(self) -> None:
        try:
            for frame in self._frames():
                if not self._put(frame):
                    return
        except BaseException as error:
            self._error = error
        finally:
            self._put(None)

    def _put(self, frame: Frame | None) -> bool:
        """Put `frame` into the queue; wait while it is full. Return False if stopped before."""
        while not self._stop.is_set():
            try:
                self._queue.put(frame, timeout=_WAIT_S)
                return True
            except queue.Full:
                continue
        return False


class LiveArrivals:
    """A live camera's frames, read by the tracker's thread. Images that come meanwhile wait in the camera's
    queue, which keeps the newest (policy `drop_old_image`)."""

    def __init__(self, frames: FrameStream, camera: CameraFeed) -> None:
        self._frames, self._camera = frames, camera
        self._dropped: int | None = None  # images; None before the first frame
        self._last_drop_s = -_DROP_WARNING_S

    def tick(self) -> AgentTick:
        now, dropped = time.monotonic(), self._camera.images_dropped
        if self._dropped is not None and dropped > self._dropped:
            self._dropped, self._last_drop_s = dropped, now
        slow = _TOO_SLOW if now - self._last_drop_s < _DROP_WARNING_S else ""
        return AgentTick(self._camera.image_ns, "; ".join(filter(None, (self._camera.trouble, slow))))

    def stop(self) -> None:
        self._camera.stop()

    def iter_frames(self) -> Iterator[tuple[Frame, int]]:
        for frame in self._frames():
            if self._dropped is None:
                self._dropped = self._camera.images_dropped
            yield frame, self._camera.arrived_ns(frame.stamp_ns)


class LateFrameDropper:
    """Drops frames that come too late to be tracked (policy `drop_late`), and keeps their IMU samples."""

    def __init__(self, late_ms: float) -> None:
        """late_ms: delay from which a frame is dropped; 0 drops none."""
        self._late_ns = late_ms * 1e6
        self._skipped_imu: list[ImuBatch] = []
        self.dropped = 0  # frames

    def admit(self, frame: Frame, late_ns: int, has_next: bool) -> Frame | None:
        """Return `frame` with all IMU samples since the last admitted one, or None to drop it.

        late_ns: time since it arrived. A frame is dropped only if a later one waits (`has_next`).
        """
        if has_next and 0 < self._late_ns < late_ns:
            self.dropped += 1
            self._skipped_imu.append(frame.imu)
            return None
        skipped, self._skipped_imu = self._skipped_imu, []
        return replace(frame, imu=skipped[0].concatenate(*skipped[1:], frame.imu)) if skipped else frame


class LatenessMonitor:
    """Counts frames with a pose more than LATE_S after the image; warns when lateness first exceeds 1 s, and
    each time it doubles."""

    def __init__(self, notify: Callable[[str], None], bottleneck: str) -> None:
        """bottleneck: the cause to name, such as "this machine"."""
        self._notify, self._bottleneck = notify, bottleneck
        self._next_warning_s = _FIRST_WARNING_S
        self._late_frames, self._max_late_s = 0, 0.0

    def record(self, track_ms: float) -> None:
        """Record that a frame's pose came `track_ms` after its image."""
        late_s = track_ms / 1e3
        self._late_frames += late_s > LATE_S
        self._max_late_s = max(self._max_late_s, late_s)
        if late_s >= self._next_warning_s:
            self._next_warning_s = 2 * late_s
            self._notify(
                f"poses are {late_s:.1f} s late: {self._bottleneck} "
                f"is too slow for this source; {_LATE_FRAMES_ADVICE}"
            )

    def report(self) -> dict[str, Any]:
        return {"late_frames": self._late_frames, "max_late_s": round(self._max_late_s, 3)}
