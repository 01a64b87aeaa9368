"""An agent that has the edge track its frames (policy streamed): it sends them through a bounded window, in
which the newest frame waits."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from share.config import Config, StreamConfig
from share.protocol import agent_events as ev
from share.protocol.agent import AgentProtocol
from share.protocol.common_events import SendToEdge
from share.timing import seconds_to_ns
from share.types import Frame, ImuBatch
from share.wire.codec import encode, message_bytes
from share.wire.messages import MAX_IMU_SAMPLES, Hello, Message, RemoteTrackingResult

PATIENCE_S = 1.0  # a frame without an answer for this long counts as unanswered


@dataclass(frozen=True, eq=False)
class InFlightFrame:
    """A frame that was sent and is not answered."""

    frame: Frame
    arrived_ns: int
    sent_ns: int


class FrameWindow:
    """At most `capacity` frames in flight. Of frames beyond, the newest waits and older ones are dropped
    (policy drop_frame); their IMU samples go with the next frame, at most MAX_IMU_SAMPLES, the newest."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._in_flight: deque[InFlightFrame] = deque()
        self._waiting: tuple[Frame, int] | None = None  # a frame and its arrival, ns
        self._skipped_imu = ImuBatch.empty()  # of frames not sent since the last that was
        self.dropped = 0
        self.unanswered = 0

    @property
    def is_idle(self) -> bool:
        return not self._in_flight and self._waiting is None

    def offer(self, frame: Frame, arrived_ns: int) -> None:
        """Add the newest frame; `take_next` returns it when it may be sent."""
        if self._waiting is not None:
            self.dropped += 1
            self.skip(self._waiting[0])
        self._waiting = frame, arrived_ns

    def skip(self, frame: Frame) -> None:
        """Do not send this frame; keep its IMU samples for the next."""
        self._skipped_imu = self._skipped_imu.concatenate(frame.imu).take(slice(-MAX_IMU_SAMPLES, None))

    def take_next(self, now_ns: int) -> Frame | None:
        """Return the frame to send now, with all IMU samples since the last sent frame; None if there is
        none."""
        if self._waiting is None or len(self._in_flight) >= self._capacity:
            return None
        (frame, arrived_ns), self._waiting = self._waiting, None
        if len(self._skipped_imu):
            self.skip(frame)
            frame, self._skipped_imu = replace(frame, imu=self._skipped_imu), ImuBatch.empty()
        self._in_flight.append(InFlightFrame(frame, arrived_ns, now_ns))
        return frame

    def cancel(self, index: int) -> None:
        """Take back the newest sent frame, number `index`: the link refused it."""
        if self._in_flight and self._in_flight[-1].frame.index == index:
            self.skip(self._in_flight.pop().frame)

    def take_answered(self, index: int) -> InFlightFrame | None:
        """Return the answered frame if it is in flight. Frames sent before it count as unanswered."""
        self._discard_while(lambda sent: sent.frame.index < index)
        is_in_flight = self._in_flight and self._in_flight[0].frame.index == index
        return self._in_flight.popleft() if is_in_flight else None

    def expire(self, before_ns: int) -> None:
        """Give up on frames sent before this time."""
        self._discard_while(lambda sent: sent.sent_ns < before_ns)

    def clear(self) -> None:
        """Give up on all frames in flight."""
        self._discard_while(lambda sent: True)

    def _discard_while(self, is_lost: Callable[[InFlightFrame], bool]) -> None:
        while self._in_flight and is_lost(self._in_flight[0]):
            self._in_flight.popleft()
            self.unanswered += 1


class FrameStreamer:
    """Frames up, poses down. A frame without an answer was not tracked."""

    def __init__(self, config: StreamConfig) -> None:
        self._timeout_ns = seconds_to_ns(PATIENCE_S)
        self._window = FrameWindow(config.window)
        self._counts: Counter[str] = Counter()
        self._segment_broken = False  # the next pose starts a segment

    @property
    def is_idle(self) -> bool:
        return self._window.is_idle

    def add_frame(self, event: ev.FrameArrived, is_connected: bool) -> None:
        self._counts["arrived"] += 1
        if is_connected:
            self._window.offer(event.frame, event.arrived_ns)
        else:
            self._counts["drop_link"] += 1
            self._window.skip(event.frame)

    def next_frame(self, now_ns: int) -> Frame | None:
        """Return the frame to send now; None if there is none."""
        self._window.expire(now_ns - self._timeout_ns)
        frame = self._window.take_next(now_ns)
        self._counts["streamed"] += frame is not None
        return frame

    def cancel(self, index: int) -> None:
        """Record that the link refused frame `index`."""
        self._counts["drop_link"] += 1
        self._counts["streamed"] -= 1
        self._window.cancel(index)

    def reset(self) -> None:
        """Start over with a new edge session: frames in flight are lost and odometry starts a segment."""
        self._window.clear()
        self._segment_broken = True

    def take_result(self, result: RemoteTrackingResult, now_ns: int) -> ev.FrameTracked | None:
        """Return the tracked frame that this result answers; None if it is too late."""
        sent = self._window.take_answered(result.index)
        if sent is None:
            self._counts["late"] += 1
            self._segment_broken = self._segment_broken or result.new_segment  # for the next pose
            return None
        self._counts["answered"] += 1
        starts_segment = self._segment_broken and result.state.has_pose
        self._segment_broken = self._segment_broken and not starts_segment
        return ev.FrameTracked(
            index=result.index,
            stamp_ns=sent.frame.stamp_ns,
            arrived_ns=sent.arrived_ns,
            done_ns=now_ns,
            state=result.state,
            T_odom_body=result.T_odom_body,
            is_keyframe=result.is_keyframe,
            new_segment=result.new_segment or starts_segment,
            waiting_for=result.waiting_for,
        )

    def report(self) -> dict[str, int]:
        """Return counts of frames. drop_frame: dropped for a newer one; drop_link: no edge, or a full link;
        unanswered: sent, but not answered in time."""
        named = {name: self._counts[name] for name in ("arrived", "streamed", "answered", "drop_link")}
        return named | {"drop_frame": self._window.dropped, "unanswered": self._window.unanswered}


class StreamingAgent(AgentProtocol):
    """An `AgentProtocol` that has the edge track its frames. It takes `FrameArrived` and sends neither poses
    nor keyframes."""

    offline_text = "no tracking without the edge"
    slow_text = "the edge does not answer"
    makes_keyframes = False

    def __init__(self, hello: Hello, config: Config) -> None:
        super().__init__(hello, config)
        self._streamer = FrameStreamer(config.stream)

    def report(self) -> dict[str, Any]:
        return super().report() | self._streamer.report()

    def _on_frame_arrived(self, event: ev.FrameArrived) -> None:
        self._status_reporter.add_image(event.arrived_ns)
        self._streamer.add_frame(event, self.is_connected)

    def _on_other_message(self, message: Message) -> None:
        if not isinstance(message, RemoteTrackingResult):
            super()._on_other_message(message)
        elif (frame := self._streamer.take_result(message, self._now_ns)) is not None:
            self._effects.append(ev.FrameTrackedRemotely(frame, message.is_consistent))
            self._on_frame_tracked(frame)

    def _on_edge_restart(self, pending: int) -> str:
        self._streamer.reset()
        return "tracking starts again"

    @property
    def _is_idle(self) -> bool:
        return self._streamer.is_idle

    def _send_data(self) -> None:
        if (frame := self._streamer.next_frame(self._now_ns)) is not None:
            frames = encode(frame)
            self._counts["bytes_up"] += message_bytes(frames)
            self._effects.append(ev.SendFrameToEdge(frame.index, frames))

    def _on_send_failed(self, effect: SendToEdge | ev.SendFrameToEdge) -> None:
        super()._on_send_failed(effect)
        if isinstance(effect, ev.SendFrameToEdge):
            self._streamer.cancel(effect.index)
