"""Frames when they come: of a recording, when the sensor would have delivered them; of a camera, now."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Protocol

from share.cameras.live import LiveSource
from share.protocol.agent_events import AgentTick
from share.protocol.agent_status import LATE_S
from share.types import Frame, ImuBatch

READ_AHEAD = 30  # frames decoded before they are due
_WAIT_S = 0.1
_DROP_WARNING_S = 2.0  # so long images that were left out are spoken of
_TOO_SLOW = "too slow for the camera: images are left out"

FrameStream = Callable[[], Iterator[Frame]]  # begins to decode


class FrameArrivals(Protocol):
    """`iter_frames` gives frames and when they arrived, on the monotonic clock (ns), until the end or
    `stop`."""

    def iter_frames(self) -> Iterator[tuple[Frame, int]]: ...

    def stop(self) -> None: ...

    def tick(self) -> AgentTick:
        """What is known now of images that are not tracked yet, and of the sensors."""
        ...


class RecordedArrivals:
    """A recording at its own pace, decoded ahead in a thread of its own, which waits for room (`block`).

    What cannot be read on is raised after the frames before it.
    """

    def __init__(self, frames: FrameStream, late_dropper: LateFrameDropper) -> None:
        self._frames, self._late_dropper = frames, late_dropper
        self._queue: queue.Queue[Frame | None] = queue.Queue(READ_AHEAD)
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._is_tracking = False  # a frame that was given is worked on

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
        """Wait for room, unless the run is over."""
        while not self._stop.is_set():
            try:
                self._queue.put(frame, timeout=_WAIT_S)
                return True
            except queue.Full:
                continue
        return False


class LiveArrivals:
    """A live camera's frames, read by who tracks them: what waits meanwhile, waits in the camera's own queue,
    whose policy `drop_old_image` keeps the newest."""

    def __init__(self, frames: FrameStream, camera: LiveSource) -> None:
        self._frames, self._camera = frames, camera
        self._dropped: int | None = None  # before the first frame nobody has read the camera yet
        self._last_drop_s = -_DROP_WARNING_S  # when it last grew

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


# ---- A loop that cannot keep up leaves frames out and holds its rate: policy `drop_late`.


class LateFrameDropper:
    """Of frames in order, those that may be tracked. What the IMU said between them stays."""

    def __init__(self, late_ms: float) -> None:
        """late_ms: 0: however late, no frame is left out."""
        self._late_ns = late_ms * 1e6
        self._skipped_imu: list[ImuBatch] = []
        self.dropped = 0  # frames

    def admit(self, frame: Frame, late_ns: int, has_next: bool) -> Frame | None:
        """The frame, with the IMU samples since the last one; None where it is left out: it begins to be
        tracked `late_ns` after it arrived, and another waits."""
        if has_next and 0 < self._late_ns < late_ns:
            self.dropped += 1
            self._skipped_imu.append(frame.imu)
            return None
        skipped, self._skipped_imu = self._skipped_imu, []
        return replace(frame, imu=skipped[0].concatenate(*skipped[1:], frame.imu)) if skipped else frame


# ---- That poses come late is said, since nothing else shows it where no frame is left out.

_FIRST_WARNING_S = 1.0  # the first warning; the next at twice what was said
_LATE_FRAMES_ADVICE = (
    "consider agent.late_ms, by which frames that are late are left out, smaller images or a faster machine"
)


class LatenessMonitor:
    """Counts frames whose pose came more than LATE_S after their image, and says how late poses are, once and
    again where that doubles."""

    def __init__(self, notify: Callable[[str], None], bottleneck: str) -> None:
        """slow: who is to blame, such as "this machine"."""
        self._notify, self._bottleneck = notify, bottleneck
        self._next_warning_s = _FIRST_WARNING_S
        self._late_frames, self._max_late_s = 0, 0.0

    def record(self, track_ms: float) -> None:
        """A frame is tracked, so long after its image came."""
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
        return {"frames_late": self._late_frames, "latest_s": round(self._max_late_s, 3)}
