"""An agent that does not track itself: its frames go up, poses come back. A part of `share.core.agent`."""

from __future__ import annotations

from collections import Counter

from share.config import StreamConfig
from share.core import events as ev
from share.core.rate import seconds
from share.core.window import Window
from share.types import Frame
from share.wire.messages import Tracked


class Streaming:
    """Which frames go, and what became of them. One that gets no answer was not tracked."""

    def __init__(self, config: StreamConfig) -> None:
        self._patience_ns = seconds(config.patience_s)
        self._window = Window(config.window)
        self._counts: Counter[str] = Counter()
        self._broken = False  # what comes is of another odometry, though no frame has said so yet

    @property
    def is_idle(self) -> bool:
        return self._window.is_idle

    def arrived(self, event: ev.FrameArrived, connected: bool) -> None:
        self._counts["arrived"] += 1
        if connected:
            self._window.offer(event.frame, event.arrived_ns)
        else:
            self._counts["drop_link"] += 1
            self._window.skip(event.frame)

    def next(self, now_ns: int) -> Frame | None:
        """The frame that goes up now."""
        self._window.expire(now_ns - self._patience_ns)
        frame = self._window.next(now_ns)
        self._counts["streamed"] += frame is not None
        return frame

    def not_taken(self, index: int) -> None:
        """The link did not take it."""
        self._counts["drop_link"] += 1
        self._counts["streamed"] -= 1
        self._window.refused(index)

    def edge_restarted(self) -> None:
        """It knows nothing of what is under way, and its odometry begins anew."""
        self._window.clear()
        self._broken = True

    def tracked(self, answer: Tracked, now_ns: int) -> ev.FrameTracked | None:
        """The frame that was answered; None if it is not waited for any more."""
        sent = self._window.answered(answer.index)
        if sent is None:
            self._counts["late"] += 1
            self._broken = self._broken or answer.new_stretch  # so is what comes after it
            return None
        self._counts["answered"] += 1
        broken = self._broken and answer.state.has_pose
        self._broken = self._broken and not broken
        return ev.FrameTracked(
            index=answer.index,
            stamp_ns=sent.frame.stamp_ns,
            arrived_ns=sent.arrived_ns,
            done_ns=now_ns,
            state=answer.state,
            T_odom_body=answer.T_odom_body,
            keyframe=answer.keyframe,
            new_stretch=answer.new_stretch or broken,
            waits=answer.waits,
        )

    def report(self) -> dict[str, int]:
        """Frames: how many came, went, were answered; were dropped for a newer one, for want of an edge or of
        room in the link, and went but were not answered in time."""
        named = {name: self._counts[name] for name in ("arrived", "streamed", "answered", "drop_link")}
        return named | {"drop_frame": self._window.dropped, "unanswered": self._window.unanswered}
