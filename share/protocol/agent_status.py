"""What an agent knows of its own state at any moment, also while no frame comes."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from share.geometry.se3 import compose_cov, position_sigma
from share.metrics.local_error import WINDOW_S
from share.protocol.agent_events import FrameTracked, StatusSaid, Tick
from share.protocol.edge_clock import smoothed
from share.protocol.localisation import MapFrame
from share.rates import SECOND_NS, Every, seconds
from share.types import F64, Keyframe, TrackState, Wait
from share.wire.messages import MAX_AGE_MS, MAX_DELAY_MS, MAX_ERROR_CM, MAX_REASON, Evaluation, Status

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


# ---- What an agent tells the edge of its own delay and error with each keyframe.


class OwnError:
    """`drift` grows with odometry and is answered by corrections."""

    def __init__(self, tell_placement: bool) -> None:
        """tell_placement: what the map is unsure of this agent's place counts too."""
        self.drift = Drift()
        self._tell_placement = tell_placement
        self._processing_ms: float | None = None  # from a frame's arrival to its keyframe, of late

    def processed(self, ms: float) -> None:
        """A frame became a candidate so long after it came."""
        self._processing_ms = smoothed(self._processing_ms, ms)

    def evaluation(
        self,
        keyframe: int,
        rtt_ms: float,
        local_cm: float | None,
        T_odom_body: F64 | None,
        placed: MapFrame,
        now_ns: int,
    ) -> Evaluation:
        """local_cm: as for `Drift.expected_cm`. Bounded by what the wire carries."""
        error_cm = self.drift.expected_cm(local_cm, now_ns)
        if error_cm is not None and T_odom_body is not None and self._tell_placement:
            error_cm = math.hypot(error_cm, placed.spread_cm(T_odom_body))
        if error_cm is not None:
            error_cm = min(error_cm, MAX_ERROR_CM)
        delay_ms = min(rtt_ms + (self._processing_ms or 0.0), MAX_DELAY_MS)
        return Evaluation(keyframe, delay_ms, error_cm)


# ---- How far odometry has gone astray since the map last set it right: what more keyframes can mend.

_REMEMBERED = 100  # keyframes since the last that was answered; older motion is summed up


class Drift:
    """Of one agent, from one answered keyframe to the next. Times are of the agent's clock, ns."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._motions: deque[tuple[int, int, F64, F64]] = deque()  # keyframe, when, T_last_this, cov

    def sent(self, keyframe: Keyframe, at_ns: int) -> None:
        """A keyframe is on its way; one without a reference begins a stretch, which is sure of itself."""
        if keyframe.reference < 0 or self._since_ns is None:
            self._motions.clear()
            self._since_ns = at_ns
            return
        self._motions.append((keyframe.id, at_ns, keyframe.T_ref_body, keyframe.cov))
        if len(self._motions) > _REMEMBERED:
            (_, _, _, cov), (second, when, T, more) = self._motions.popleft(), self._motions.popleft()
            self._motions.appendleft((second, when, T, compose_cov(T, cov, more)))

    def answered(self, keyframe: int) -> None:
        """The map has placed this one, and with it what came after."""
        while self._motions and self._motions[0][0] <= keyframe:
            self._since_ns = self._motions.popleft()[1]

    def expected_cm(self, local_cm: float | None, now_ns: int) -> float | None:
        """cm, of the newest sent keyframe's position; None before the first.

        local_cm: the error that odometry makes within `WINDOW_S` (`share.metrics.local_error`); it strays
        as a random walk does. None: by the covariances that odometry itself tells.
        """
        if self._since_ns is None:
            return None
        if local_cm is not None:
            return local_cm * math.sqrt(min(1.0, max(0, now_ns - self._since_ns) / seconds(WINDOW_S)))
        cov = np.zeros((6, 6))
        for _, _, T, more in self._motions:
            cov = compose_cov(T, cov, more)
        return 100 * position_sigma(cov)
