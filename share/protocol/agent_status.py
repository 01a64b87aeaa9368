"""The agent's status: its state and the age of its pose, also without frames."""

from __future__ import annotations

from dataclasses import replace

from share.errors import printable
from share.protocol.agent_events import AgentTick, FrameTracked, StatusReport
from share.protocol.edge_clock import PING_S, ClockEstimate, exponential_average
from share.timing import SECOND_NS, PeriodicTimer, seconds_to_ns
from share.types import TrackState, WaitReason
from share.wire.messages import MAX_POSE_AGE_MS, MAX_REASON_LENGTH, Status

STALE_S = 0.4  # s without a tracked frame (or three frame intervals, if longer): the last pose is stale
_MAX_INTERVAL_S = 0.2  # cap of the averaged frame interval, so that staleness is reported within a second
LATE_S = 0.5  # a pose later than this after its image is reported as late
_MIN_CHANGE_S = 0.1  # least time between two reports of a change
_STATE_TEXTS = {
    TrackState.WEAK: "few features in view",
    TrackState.VISION_ONLY: "no IMU sample for {:.1f} s",
    TrackState.INERTIAL_ONLY: "fewer than 6 features accepted for {:.1f} s",
    TrackState.LOST: "lost for {:.1f} s",
}


class StatusReporter:
    """Makes a `Status` of frames and ticks, each period and on change.

    A state with a pose becomes LOST when it is stale. All times are the agent's clock, ns.
    """

    def __init__(self, slow_text: str) -> None:
        """slow_text: why poses are late, for a person."""
        self._timer = PeriodicTimer(PING_S)
        self._slow_text = slow_text
        self._began_ns: int | None = None
        self._state, self._since_ns = TrackState.INITIALISING, 0
        self._waiting_for: WaitReason | None = None
        self._image_ns: int | None = None  # arrival of the newest image, tracked or not
        self._pose_ns: int | None = None  # arrival of the newest frame with a pose
        self._tracked_ns: int | None = None  # when the newest frame was done
        self._stamp_ns: int | None = None  # of the newest frame
        self._frame_interval_ns: float | None = None  # average
        self._latency_ns = 0
        self._sensor_trouble = ""
        self._is_finished = False
        self._last_sent: tuple[TrackState, bool] | None = None
        self._last_sent_ns = 0

    def begin(self, now_ns: int) -> None:
        """Set the time from which the pose age counts until there is a pose."""
        if self._began_ns is None:
            self._began_ns = self._since_ns = now_ns

    def add_image(self, arrived_ns: int) -> None:
        """Record the arrival of an image, tracked or not."""
        self._image_ns = max(arrived_ns, self._image_ns or arrived_ns)

    def add_tick(self, tick: AgentTick) -> None:
        self._sensor_trouble = tick.sensor_trouble
        if tick.waiting_image_ns is not None:
            self.add_image(tick.waiting_image_ns)

    def add_frame(self, frame: FrameTracked, now_ns: int) -> None:
        """Record a frame that is done, with or without a pose."""
        if self._tracked_ns is not None:
            self._frame_interval_ns = exponential_average(
                self._frame_interval_ns, min(now_ns - self._tracked_ns, seconds_to_ns(_MAX_INTERVAL_S))
            )
        if frame.state is not self._state:
            self._state, self._since_ns = frame.state, now_ns
        self._waiting_for, self._tracked_ns, self._stamp_ns = frame.waiting_for, now_ns, frame.stamp_ns
        self._latency_ns = frame.done_ns - frame.arrived_ns
        self.add_image(frame.arrived_ns)
        if frame.state.has_pose:
            self._pose_ns = frame.arrived_ns

    def finish(self) -> None:
        """Record that no frame follows."""
        self._is_finished = True

    def has_just_begun(self, now_ns: int, within_ns: int) -> bool:
        """Return whether ending the run now loses little: no frame yet, or begun at most `within_ns` ago."""
        return self._stamp_ns is None or now_ns - (self._began_ns or 0) <= within_ns

    def is_stale(self, now_ns: int) -> bool:
        """Return whether no frame was tracked for so long that the last pose is stale."""
        since_ns = now_ns - (self._began_ns or 0 if self._tracked_ns is None else self._tracked_ns)
        return not self._is_finished and since_ns > max(
            seconds_to_ns(STALE_S), 3 * (self._frame_interval_ns or 0)
        )

    def status(self, now_ns: int) -> Status:
        stale = self.is_stale(now_ns)
        state = TrackState.LOST if stale and self._state.has_pose else self._state
        reasons = (self._stale_reason(now_ns) if stale else self._state_text(now_ns), self._sensor_trouble)
        reason = printable("; ".join(filter(None, reasons)))
        return Status(state, self._age_ms(now_ns), reason[:MAX_REASON_LENGTH])

    def due_report(self, now_ns: int) -> StatusReport | None:
        """Return the status if a report is due, else None."""
        status = self.status(now_ns)
        kind = status.state, bool(status.reason)
        if kind != self._last_sent and now_ns - self._last_sent_ns >= seconds_to_ns(_MIN_CHANGE_S):
            self._timer.postpone(now_ns)
        if not self._timer.fire_if_due(now_ns):
            return None
        self._last_sent, self._last_sent_ns = kind, now_ns
        return StatusReport(status, self._stamp_ns, self.is_stale(now_ns))

    def _age_ms(self, now_ns: int) -> float:
        since_ns = self._pose_ns if self._pose_ns is not None else self._began_ns
        return min(max(0.0, (now_ns - (since_ns or 0)) / 1e6), MAX_POSE_AGE_MS)

    def _stale_reason(self, now_ns: int) -> str:
        waited_ns = now_ns - (self._tracked_ns or self._began_ns or 0)
        since_image_ns = now_ns - (self._image_ns or self._began_ns or 0)
        if since_image_ns < seconds_to_ns(STALE_S):
            return f"no pose for {waited_ns / SECOND_NS:.1f} s: {self._slow_text}"
        return f"no image for {since_image_ns / SECOND_NS:.1f} s"

    def _state_text(self, now_ns: int) -> str:
        if self._is_finished:
            return "no more frames"
        if self._latency_ns > seconds_to_ns(LATE_S):
            return f"poses are {self._latency_ns / SECOND_NS:.1f} s late: {self._slow_text}"
        if self._state is TrackState.INITIALISING:
            return "" if self._waiting_for is None else f"waiting for {self._waiting_for.text}"
        return _STATE_TEXTS.get(self._state, "").format((now_ns - self._since_ns) / SECOND_NS)


def with_link(status: Status, waiting_ns: int, clock: ClockEstimate) -> Status:
    """Return a status with the state of the link to the edge. waiting_ns: how long the oldest keyframe has
    waited to be acknowledged."""
    error_ms = clock.uncertainty_ms
    return replace(
        status,
        unacknowledged_ms=min(waiting_ns / 1e6, MAX_POSE_AGE_MS),
        clock_error_ms=None if error_ms is None else min(error_ms, MAX_POSE_AGE_MS),
    )
