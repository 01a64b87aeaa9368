"""Frames on their way to somebody who answers them in order: few under way, and the newest waits."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from share.config import StreamConfig
from share.protocol import agent_events as ev
from share.rates import seconds
from share.types import Frame, ImuBatch
from share.wire.messages import MAX_SAMPLES, Tracked


@dataclass(frozen=True, eq=False)
class Sent:
    """A frame under way: when it came, and when it went."""

    frame: Frame
    arrived_ns: int
    sent_ns: int


class Window:
    """At most `most` frames under way. Of those that find no room the newest waits, the older is dropped
    (policy `drop_frame`); what the IMU said meanwhile goes with the next, the newest MAX_SAMPLES of it."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._under_way: deque[Sent] = deque()
        self._waiting: tuple[Frame, int] | None = None  # and when it came
        self._imu = ImuBatch.empty()  # of frames that did not go, since the last that went
        self.dropped = 0
        self.unanswered = 0

    @property
    def is_idle(self) -> bool:
        return not self._under_way and self._waiting is None

    def offer(self, frame: Frame, arrived_ns: int) -> None:
        """The newest frame; `next` says when it goes."""
        if self._waiting is not None:
            self.dropped += 1
            self.skip(self._waiting[0])
        self._waiting = frame, arrived_ns

    def skip(self, frame: Frame) -> None:
        """This one does not go."""
        self._imu = self._imu.join(frame.imu).take(slice(-MAX_SAMPLES, None))

    def next(self, now_ns: int) -> Frame | None:
        """The frame that goes now, with all that the IMU said since the last that went."""
        if self._waiting is None or len(self._under_way) >= self._most:
            return None
        (frame, arrived_ns), self._waiting = self._waiting, None
        if len(self._imu):
            self.skip(frame)
            frame, self._imu = replace(frame, imu=self._imu), ImuBatch.empty()
        self._under_way.append(Sent(frame, arrived_ns, now_ns))
        return frame

    def refused(self, index: int) -> None:
        """The newest, number `index`, could not go after all."""
        if self._under_way and self._under_way[-1].frame.index == index:
            self.skip(self._under_way.pop().frame)

    def answered(self, index: int) -> Sent | None:
        """The frame, if it was still waited for. Those that went before it will not be answered any more."""
        self._give_up(lambda sent: sent.frame.index < index)
        known = self._under_way and self._under_way[0].frame.index == index
        return self._under_way.popleft() if known else None

    def expire(self, before_ns: int) -> None:
        """No answer is expected any more to what went before then."""
        self._give_up(lambda sent: sent.sent_ns < before_ns)

    def clear(self) -> None:
        """Nor to anything under way."""
        self._give_up(lambda sent: True)

    def _give_up(self, gone: Callable[[Sent], bool]) -> None:
        while self._under_way and gone(self._under_way[0]):
            self._under_way.popleft()
            self.unanswered += 1


# ---- An agent that does not track itself: its frames go up, poses come back.


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
