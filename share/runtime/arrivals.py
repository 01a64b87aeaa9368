"""Frames at their arrival times: recorded ones when the sensor would have delivered them, live ones at
once."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

from share.cameras.feed import CameraFeed
from share.protocol.agent_events import AgentTick
from share.protocol.agent_status import LATE_S
from share.types import AgentKind, Frame, ImuBatch
from share.wire.messages import Hello

READ_AHEAD = 30  # frames decoded before they are due
MAX_PREDICTED_NS = 500_000_000  # of poses by the IMU alone; then a frame is tracked, however late
_WAIT_S = 0.1
_DROP_WARNING_S = 2.0  # how long a warning about dropped images is shown
_TOO_SLOW = "too slow for the camera: images are dropped"
_FIRST_WARNING_S = 1.0  # lateness of poses at the first warning; the next comes at twice the last one
_SLOW_ADVICE = "use smaller images or a faster machine"

FrameStream = Callable[[], Iterator[Frame]]  # starts decoding


class Arrival(NamedTuple):
    """A frame, with all IMU samples since the last one that was to be tracked. arrived_ns: monotonic.
    is_late: it came too late to be tracked."""

    frame: Frame
    arrived_ns: int
    is_late: bool = False


class FrameArrivals(Protocol):
    """A source of frames with arrival times."""

    def iter_frames(self) -> Iterator[Arrival]:
        """Yield each frame until the end or `stop`."""
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

    def iter_frames(self) -> Iterator[Arrival]:
        reader = threading.Thread(target=self._read_frames, name="reader", daemon=True)
        reader.start()
        try:
            yield from self._frames_when_due()
        finally:
            self._stop.set()
            reader.join(timeout=2)
        if self._error is not None:
            raise self._error

    def _frames_when_due(self) -> Iterator[Arrival]:
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
            with_imu, is_late = self._late_dropper.judge(frame, late_ns, has_next)
            self._is_tracking = True
            yield Arrival(with_imu, due_ns, is_late)
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

    def iter_frames(self) -> Iterator[Arrival]:
        for frame in self._frames():
            if self._dropped is None:
                self._dropped = self._camera.images_dropped
            yield Arrival(frame, self._camera.arrived_ns(frame.stamp_ns))


class LateFrameDropper:
    """Judges which frames come too late to be tracked (policy `drop_late`), and keeps their IMU samples.

    At most for `MAX_PREDICTED_NS`: a machine that is too slow even to leave frames out would else never track
    one again, and integrate more samples for each."""

    def __init__(self, late_ms: float) -> None:
        """late_ms: delay from which a frame is not tracked; 0: all are."""
        self._late_ns = late_ms * 1e6
        self._skipped_imu = ImuBatch.empty()
        self._tracked_ns: int | None = None  # stamp of the last tracked frame
        self.dropped = 0  # frames

    def judge(self, frame: Frame, late_ns: int, has_next: bool) -> tuple[Frame, bool]:
        """Return `frame` with all IMU samples since the last one that was not late, and whether it is late.

        late_ns: time since it arrived. A frame is late only if a later one waits (`has_next`), and one was
        tracked shortly before.
        """
        if len(self._skipped_imu):
            frame = replace(frame, imu=self._skipped_imu.concatenate(frame.imu))
        is_predictable = (
            self._tracked_ns is not None and frame.stamp_ns - self._tracked_ns <= MAX_PREDICTED_NS
        )
        is_late = has_next and 0 < self._late_ns < late_ns and is_predictable
        self._skipped_imu = frame.imu if is_late else ImuBatch.empty()
        if not is_late:
            self._tracked_ns = frame.stamp_ns
        self.dropped += is_late
        return frame, is_late


# an older pose is worse than a prediction: a wearer sees it; a robot's bridge holds one of 0.5 s for lost
_LATE_MS = {AgentKind.AR: 100.0, AgentKind.ROBOT: 400.0}


def late_limit_ms(late_ms: float | None, hello: Hello) -> float:
    """Return the delay from which a frame is not tracked; 0: all are. late_ms: as in the configuration.

    By default an agent stays fresh where its IMU can predict its pose, a headset more than a robot."""
    if late_ms is not None:
        return late_ms
    can_predict = hello.rig.imu is not None and not hello.streams_frames
    return _LATE_MS[hello.kind] if can_predict else 0.0


_WINDOW = 100  # frames
_FRAMES_BETWEEN_WARNINGS = 900  # a minute at 15 Hz


class LatenessMonitor:
    """Counts frames with a pose more than LATE_S after the image; warns when lateness first exceeds 1 s, and
    each time it doubles. Says that the agent cannot keep up when most of its newest poses come later than its
    kind tolerates, at most once a minute."""

    def __init__(self, notify: Callable[[str], None], bottleneck: str, limit_ms: float) -> None:
        """bottleneck: the cause to name, such as "this machine". limit_ms: what its kind tolerates."""
        self._notify, self._bottleneck, self._limit_ms = notify, bottleneck, limit_ms
        self._next_warning_s = _FIRST_WARNING_S
        self._late_frames, self._max_late_s = 0, 0.0
        self._is_over: deque[bool] = deque(maxlen=_WINDOW)
        self._behind_frames = 0
        self._quiet_frames = 0  # until a warning may come again

    def record(self, track_ms: float) -> None:
        """Record that a frame's pose came `track_ms` after its image."""
        late_s = track_ms / 1e3
        self._late_frames += late_s > LATE_S
        self._max_late_s = max(self._max_late_s, late_s)
        if late_s >= self._next_warning_s:
            self._next_warning_s = 2 * late_s
            self._notify(
                f"poses are {late_s:.1f} s late: {self._bottleneck} is too slow for this source; "
                f"{_SLOW_ADVICE}"
            )
        self._check_pace(track_ms)

    def _check_pace(self, track_ms: float) -> None:
        self._quiet_frames = max(0, self._quiet_frames - 1)
        self._is_over.append(track_ms > self._limit_ms)
        over = sum(self._is_over)
        if len(self._is_over) < _WINDOW or 2 * over <= _WINDOW:
            return
        self._behind_frames += 1
        if not self._quiet_frames:
            self._quiet_frames = _FRAMES_BETWEEN_WARNINGS
            self._notify(
                f"cannot keep up: {over} of the last {_WINDOW} poses came more than {self._limit_ms:.0f} ms "
                f"after their images; {_SLOW_ADVICE}"
            )

    def report(self) -> dict[str, Any]:
        return {
            "late_frames": self._late_frames,
            "max_late_s": round(self._max_late_s, 3),
            "behind_frames": self._behind_frames,
        }
