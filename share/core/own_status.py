"""What an agent knows of its own state at any moment, also while no frame comes."""

from __future__ import annotations

from share.core.clock import smoothed
from share.core.events import FrameTracked, StatusSaid, Tick
from share.core.rate import SECOND_NS, Every, seconds
from share.types import TrackState, Wait
from share.wire.messages import MAX_AGE_MS, MAX_REASON, Status

STALE_S = 0.4  # without a tracked frame, or three usual intervals: the last pose says nothing of now
_SLOWEST_S = 0.2  # an interval that is usual; so what is stale is said within a second, however slow all is
LATE_S = 0.5  # a pose that is later than this after its image is said to be late
_AT_MOST_EACH_S = 0.1  # changes are said at once, but not oftener
_WORDS = {
    TrackState.WEAK: "few points in view",
    TrackState.VISION_ONLY: "no IMU sample for {:.1f} s",
    TrackState.INERTIAL_ONLY: "nothing in view for {:.1f} s",
    TrackState.LOST: "lost for {:.1f} s",
}


class OwnStatus:
    """Fed with frames and ticks, it answers with a `Status`: each period, and at once where that changes.

    A state with a pose becomes LOST where no frame is tracked for long. All times are the agent's clock, ns.
    """

    def __init__(self, period_s: float, streams: bool) -> None:
        """streams: the edge tracks, not this agent."""
        self._every = Every(period_s)
        self._too_slow = "the edge does not answer" if streams else "this machine is too slow"
        self._began_ns: int | None = None
        self._state, self._since_ns = TrackState.INITIALISING, 0
        self._waits: Wait | None = None
        self._image_ns: int | None = None  # arrival of the newest image, tracked or not
        self._posed_ns: int | None = None  # arrival of the newest frame with a pose
        self._tracked_ns: int | None = None  # when the newest frame was done
        self._stamp_ns: int | None = None  # of the newest frame
        self._step_ns: float | None = None  # between frames
        self._late_ns = 0
        self._trouble = ""  # with the sensors
        self._over = False
        self._said: tuple[TrackState, bool] | None = None
        self._said_ns = 0

    def begin(self, now_ns: int) -> None:
        """Ages count from here until there is a pose."""
        if self._began_ns is None:
            self._began_ns = self._since_ns = now_ns

    def image_came(self, arrived_ns: int) -> None:
        """An image, tracked or not."""
        self._image_ns = max(arrived_ns, self._image_ns or arrived_ns)

    def ticked(self, tick: Tick) -> None:
        self._trouble = tick.trouble
        if tick.image_ns is not None:
            self.image_came(tick.image_ns)

    def tracked(self, frame: FrameTracked, now_ns: int) -> None:
        """A frame is done, with a pose or without."""
        if self._tracked_ns is not None:
            self._step_ns = smoothed(self._step_ns, min(now_ns - self._tracked_ns, seconds(_SLOWEST_S)))
        if frame.state is not self._state:
            self._state, self._since_ns = frame.state, now_ns
        self._waits, self._tracked_ns, self._stamp_ns = frame.waits, now_ns, frame.stamp_ns
        self._late_ns = frame.done_ns - frame.arrived_ns
        self.image_came(frame.arrived_ns)
        if frame.state.has_pose:
            self._posed_ns = frame.arrived_ns

    def over(self) -> None:
        """No frame will follow."""
        self._over = True

    def has_just_begun(self, now_ns: int, within_ns: int) -> bool:
        """Whether little is lost where the run ends now: no frame, or it began so lately."""
        return self._stamp_ns is None or now_ns - (self._began_ns or 0) <= within_ns

    def is_idle(self, now_ns: int) -> bool:
        """Whether no frame was tracked for so long that the last pose says nothing of now."""
        since_ns = now_ns - (self._began_ns or 0 if self._tracked_ns is None else self._tracked_ns)
        return not self._over and since_ns > max(seconds(STALE_S), 3 * (self._step_ns or 0))

    def at(self, now_ns: int) -> Status:
        idle = self.is_idle(now_ns)
        state = TrackState.LOST if idle and self._state.has_pose else self._state
        reasons = (self._why_idle(now_ns) if idle else self._words(now_ns), self._trouble)
        reason = "".join(c if c.isprintable() else "?" for c in "; ".join(filter(None, reasons)))
        return Status(state, self._age_ms(now_ns), reason[:MAX_REASON])

    def due(self, now_ns: int) -> StatusSaid | None:
        """The status, where it is to be said now."""
        status = self.at(now_ns)
        kind = status.state, bool(status.reason)
        if kind != self._said and now_ns - self._said_ns >= seconds(_AT_MOST_EACH_S):
            self._every.postpone(now_ns)
        if not self._every.due(now_ns):
            return None
        self._said, self._said_ns = kind, now_ns
        return StatusSaid(status, self._stamp_ns, self.is_idle(now_ns))

    def _age_ms(self, now_ns: int) -> float:
        since_ns = self._posed_ns if self._posed_ns is not None else self._began_ns
        return min(max(0.0, (now_ns - (since_ns or 0)) / 1e6), MAX_AGE_MS)

    def _why_idle(self, now_ns: int) -> str:
        waited_ns = now_ns - (self._tracked_ns or self._began_ns or 0)
        unseen_ns = now_ns - (self._image_ns or self._began_ns or 0)
        if unseen_ns < seconds(STALE_S):
            return f"no pose for {waited_ns / SECOND_NS:.1f} s: {self._too_slow}"
        return f"no image for {unseen_ns / SECOND_NS:.1f} s"

    def _words(self, now_ns: int) -> str:
        if self._over:
            return "no more frames follow"
        if self._late_ns > seconds(LATE_S):
            return f"poses are {self._late_ns / SECOND_NS:.1f} s late: {self._too_slow}"
        if self._state is TrackState.INITIALISING:
            return "" if self._waits is None else f"waits for {self._waits.words}"
        return _WORDS.get(self._state, "").format((now_ns - self._since_ns) / SECOND_NS)
