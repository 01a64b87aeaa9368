"""An agent that the edge tracks: its frames, its tracker's answers, and lives of that tracker. A part of
`share.core.edge`; trackers are processes of `share.run.tracking`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from share.core.edge_events import BeginTracking, EndTracking, ToTracker, Track
from share.core.window import Window
from share.geometry.camera import Camera, Rig
from share.types import Frame
from share.wire.messages import Tracked


@dataclass
class Afar:
    """is_ready: its tracker can track. streamed, tracked: frames that came, and that were answered."""

    key: str
    rig: Rig
    window: Window
    life: int = 0
    is_running: bool = False
    is_ready: bool = False
    streamed: int = 0
    tracked: int = 0
    _answered: bool = field(default=False)  # in this life

    def begin(self) -> Sequence[ToTracker]:
        """A tracker, if it has none."""
        if self.is_running:
            return ()
        self.is_running, self._answered = True, False
        return (BeginTracking(self.key, self.life, self.rig),)

    def end(self) -> Sequence[ToTracker]:
        """It is gone: none is needed."""
        was_running = self._stop()
        return (EndTracking(self.key),) if was_running else ()

    def frame(self, frame: Frame, now_ns: int) -> Sequence[ToTracker]:
        """What goes to the tracker. Raises ValueError if the frame is not of this rig."""
        self._check(frame)
        self.streamed += 1
        self.window.offer(frame, now_ns)
        return self._next(now_ns)

    def answered(self, answer: Tracked, now_ns: int) -> Sequence[ToTracker]:
        self.window.answered(answer.index)
        self.tracked += 1
        self._answered = True
        return self._next(now_ns)

    def lost(self) -> bool:
        """Its tracker has died. Whether another may do better: this one had answered."""
        self._stop()
        return self._answered

    def report(self) -> dict[str, int]:
        """For edge.json; dropped: for newer ones, or with a tracker that died."""
        dropped = self.window.dropped + self.window.unanswered
        return {"frames_streamed": self.streamed, "frames_tracked": self.tracked, "frames_dropped": dropped}

    def _next(self, now_ns: int) -> Sequence[ToTracker]:
        frame = self.window.next(now_ns) if self.is_running else None
        return () if frame is None else (Track(self.key, frame),)

    def _stop(self) -> bool:
        """Whether one was running."""
        was_running, self.is_running, self.is_ready = self.is_running, False, False
        self.window.clear()
        self.life += was_running
        return was_running

    def _check(self, frame: Frame) -> None:
        for name, image, camera in (
            ("image0", frame.image0, self.rig.cam0),
            ("image1", frame.image1, self.rig.cam1),
            ("depth", frame.depth, self.rig.depth),
        ):
            have, want = None if image is None else image.shape, _shape(camera)
            if have != want:
                raise ValueError(f"frame {frame.index}: {name} is {_words(have)}, its camera {_words(want)}")


def _shape(camera: Camera | None) -> tuple[int, ...] | None:
    return None if camera is None else (camera.height, camera.width)


def _words(shape: tuple[int, ...] | None) -> str:
    return "none" if shape is None else f"{shape[1]}x{shape[0]}"
