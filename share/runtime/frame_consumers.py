"""The two ways of an agent with its frames: track them, or have the edge track them (policy `streamed`)."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from share.cameras.live import LiveSource
from share.config import Config
from share.metrics.frame_log import RunLog
from share.odometry.track_result import TrackResult
from share.protocol import agent_events as ev
from share.runtime.arrivals import READ_AHEAD
from share.runtime.error_estimators import ErrorEstimator
from share.runtime.fault_guard import FaultGuard
from share.runtime.guarded_tracker import GuardedTracker
from share.runtime.imu_bias_store import ImuBiasStore
from share.runtime.source import Source
from share.types import Frame, TrackState

_POLL_S = 0.05
TRACKER_START_S = 20.0  # longest wait of a recording for the edge's tracker before it plays

Post = Callable[[ev.AgentEvent], None]


class FrameConsumer:
    """`start` and `consume` are called from the tracker's thread, the others from the main thread."""

    bottleneck: str  # what is too slow where poses come late

    def start(self) -> None:
        """Wait until frames may come."""

    def consume(self, frame: Frame, arrived_ns: int, post: Post) -> None:
        """Handle a frame; `post` events to the state machine."""
        raise NotImplementedError

    def predict(self, frame: Frame, arrived_ns: int, post: Post) -> None:
        """Handle a frame that comes too late to be tracked: it is left out."""

    def event_handled(self, event: ev.AgentEvent, is_connected: bool) -> None:
        """The state machine has handled `event`."""

    def loop_ended(self, cpu_s: float) -> None:
        """All events are handled. cpu_s: CPU time of the main thread."""

    def report(self, protocol: dict[str, Any]) -> dict[str, Any]:
        """Return entries of report.json. protocol: report of the state machine."""
        raise NotImplementedError

    def close(self, submit: Callable[[Callable[[], None]], None]) -> None:
        """End after the last frame. submit: runs file output."""


class LocalTracking(FrameConsumer):
    """Tracks each frame: pose, then keyframe."""

    bottleneck = "this machine"

    def __init__(
        self,
        source: Source,
        settings: Config,
        guard: FaultGuard,
        error_estimator: ErrorEstimator,
        log: RunLog,
        notify: Callable[[str], None],
    ) -> None:
        self._guard, self._error_estimator, self._log = guard, error_estimator, log
        self._bias_store = ImuBiasStore(source, settings.inertial, notify)
        self._tracker = GuardedTracker(source.rig, settings, guard, self._bias_store.bias)
        self._state = TrackState.INITIALISING  # of the last tracked frame

    def consume(self, frame: Frame, arrived_ns: int, post: Post) -> None:
        cpu_start_s = time.thread_time()
        result = self._tracker.track(frame)
        self._state = result.state
        tracked = ev.FrameTracked(
            index=frame.index,
            stamp_ns=frame.stamp_ns,
            arrived_ns=arrived_ns,
            done_ns=time.monotonic_ns(),
            state=result.state,
            T_odom_body=result.T_odom_body,
            is_keyframe=result.keyframe_ready,
            new_segment=result.new_segment,
            error_cm=self._estimate_error_cm(frame, result),
            waiting_for=result.waiting_for,
            cov=result.cov,
            velocity=result.velocity,
            angular_velocity=result.angular_velocity,
        )
        post(tracked)  # before keyframe work: the pose must not wait for it
        self._log.add_result(result.new_segment, result.is_consistent, result.waiting_for)
        if result.keyframe_ready:
            make_candidate = partial(self._error_estimator.make_keyframe, frame, self._tracker)
            candidate = self._tracker.attempt("making a keyframe", frame, make_candidate)
            post(ev.KeyframeMade(tracked, candidate))
        self._tracker.attempt("finishing a keyframe", frame, self._tracker.finish_keyframe)
        self._log.imu_outliers = self._tracker.rejected_imu_samples
        if self._tracker.has_dropped_bias:
            self._bias_store.note_dropped()
        self._log.cpu_s += time.thread_time() - cpu_start_s

    def predict(self, frame: Frame, arrived_ns: int, post: Post) -> None:
        """Post the pose that the IMU predicts, as late as it is: leaving a frame out never looks good."""
        T_odom_body = self._tracker.predict(frame)
        if T_odom_body is None:  # no pose yet, or none any more
            state = self._state if not self._state.has_pose else TrackState.LOST
        else:
            state = self._state if self._state.has_pose else TrackState.INERTIAL_ONLY
        times = frame.index, frame.stamp_ns, arrived_ns, time.monotonic_ns()
        post(ev.FrameTracked(*times, state, T_odom_body))

    def _estimate_error_cm(self, frame: Frame, result: TrackResult) -> float | None:
        error_cm: float | None = None
        with self._guard.step("estimating the error"):
            error_cm = self._error_estimator.update(frame, result)
        return error_cm

    def report(self, protocol: dict[str, Any]) -> dict[str, Any]:
        return self._bias_store.report() | self._error_estimator.report()

    def close(self, submit: Callable[[Callable[[], None]], None]) -> None:
        submit(partial(self._bias_store.save, self._tracker.bias))
        self._error_estimator.close()


class RemoteTracking(FrameConsumer):
    """Sends each frame to the edge. A recording starts once the edge can track it, so that its beginning is
    not lost; from then on nothing waits for the edge."""

    bottleneck = "the edge"

    def __init__(
        self,
        source: Source,
        settings: Config,
        log: RunLog,
        stop: threading.Event,
        notify: Callable[[str], None],
    ) -> None:
        self._max_wait_s = 0.0 if isinstance(source, LiveSource) else TRACKER_START_S
        self._log, self._stop, self._notify = log, stop, notify
        self._free_slots = threading.Semaphore(READ_AHEAD)  # frames between the threads: policy block
        self._can_start = threading.Event()

    def start(self) -> None:
        deadline = time.monotonic() + self._max_wait_s
        while self._max_wait_s and not (self._can_start.wait(_POLL_S) or self._stop.is_set()):
            if time.monotonic() >= deadline:
                self._notify("the edge does not track this agent yet; the recording starts anyway")
                break

    def consume(self, frame: Frame, arrived_ns: int, post: Post) -> None:
        while not self._free_slots.acquire(timeout=_POLL_S):
            if self._stop.is_set():
                return
        post(ev.FrameArrived(frame, arrived_ns))

    def event_handled(self, event: ev.AgentEvent, is_connected: bool) -> None:
        if isinstance(event, ev.FrameArrived):
            self._free_slots.release()
        if is_connected:
            self._can_start.set()

    def loop_ended(self, cpu_s: float) -> None:
        self._log.cpu_s = cpu_s

    def report(self, protocol: dict[str, Any]) -> dict[str, Any]:
        return {"untracked": protocol["arrived"] - protocol["answered"]}
