"""Trackers of streaming agents (policy `streamed`), one process each, with the tracker of `share track`."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable

from share.config import Config
from share.devices.host import core_count, free_memory_bytes
from share.geometry.camera import Rig
from share.odometry.track_result import TrackResult
from share.protocol.edge_events import (
    StartTracker,
    StopTracker,
    TrackerAnswered,
    TrackerEvent,
    TrackerLost,
    TrackerReady,
    TrackFrame,
)
from share.protocol.remote_tracking import TrackingCapacity
from share.runtime.worker_process import END, Inbox, WorkerProcess
from share.startup import HeapTrimmer
from share.timing import Backoff
from share.types import Frame
from share.wire.messages import RemoteTrackingResult

_TIMEOUT_S = 6.0  # for a process to end
_TRACKERS_PER_CORE = 2  # at 15 frames a second each; a frame takes 15 to 30 ms


def tracker_capacity() -> TrackingCapacity:
    """Return how many trackers this machine can run now."""
    free = free_memory_bytes()
    memory = "" if free is None else f", {free / 1e9:.1f} GB free"
    return TrackingCapacity(
        _TRACKERS_PER_CORE * core_count(),
        f"{core_count()} core{'' if core_count() == 1 else 's'}{memory}",
        free,
    )


class TrackerProcesses:
    """Starts, feeds and stops tracker processes without waiting. `on_answer` is called from other threads."""

    def __init__(self, settings: Config, on_answer: Callable[[TrackerEvent], None]) -> None:
        self._settings, self._on_answer = settings, on_answer
        self._running: dict[str, WorkerProcess] = {}
        self._closing_threads: list[threading.Thread] = []
        self._backoffs: dict[str, Backoff] = {}
        self._restart_pauses_s: dict[str, float] = {}  # by key of a dead tracker, until its next start

    def execute(self, effect: StartTracker | TrackFrame | StopTracker) -> None:
        match effect:
            case StartTracker():
                self._stop(effect.key)
                self._start(effect)
            case TrackFrame() if (process := self._running.get(effect.key)) is not None:
                process.send(effect.frame)
            case StopTracker():
                self._stop(effect.key)

    def close(self) -> None:
        """Stop all trackers and wait for them."""
        for key in list(self._running):
            self._stop(key)
        for thread in self._closing_threads:
            thread.join(_TIMEOUT_S)

    def _start(self, effect: StartTracker) -> None:
        key, generation = effect.key, effect.generation
        backoff = self._backoffs.setdefault(key, Backoff(time.monotonic_ns()))

        def lost(how: str) -> None:
            self._restart_pauses_s[key] = pause_s = backoff.record_failure(time.monotonic_ns())
            self._on_answer(TrackerLost(key, generation, f"{how}; restarted in {pause_s:g} s"))

        arguments = (self._settings, effect.rig, key, generation)
        try:
            self._running[key] = WorkerProcess(
                f"tracking {key}", run_tracker, arguments, self._on_answer, lost, self._pause_s(key)
            )
        except (OSError, RuntimeError) as error:  # too many open files, or threads
            lost(f"could not be started: {error}")

    def _pause_s(self, key: str) -> float:
        """Return the delay before a start: after a death, or while too many processes are still ending, so
        that agents that come and go do not overload the machine."""
        pause_s = self._restart_pauses_s.pop(key, 0.0)
        ending = sum(thread.is_alive() for thread in self._closing_threads)
        return pause_s if ending < _TRACKERS_PER_CORE * core_count() else max(pause_s, _TIMEOUT_S)

    def _stop(self, key: str) -> None:
        if (process := self._running.pop(key, None)) is not None:
            self._closing_threads = [thread for thread in self._closing_threads if thread.is_alive()]
            thread = threading.Thread(target=process.close, daemon=True)
            try:
                thread.start()
            except RuntimeError:  # too many threads
                process.close()
            else:
                self._closing_threads.append(thread)


def run_tracker(
    inbox: Inbox,
    answer: Callable[[TrackerEvent], None],
    settings: Config,
    rig: Rig,
    key: str,
    generation: int,
) -> None:
    """Work of a `WorkerProcess`: answers TrackerReady, then takes frames and answers each with
    TrackerAnswered, until END."""
    from share.runtime.fault_guard import FaultGuard
    from share.runtime.guarded_tracker import GuardedTracker  # the edge itself tracks nobody

    guard = FaultGuard(lambda text: print(f"share: tracking {key}: {text}", file=sys.stderr, flush=True))
    tracker, heap = GuardedTracker(rig, settings, guard), HeapTrimmer()
    starts_new_odom = generation > 0  # an earlier tracker had another odom frame
    answer(TrackerReady(key, generation))
    while (frame := inbox.get()) is not END:
        result = tracker.track(frame)
        new_segment = result.new_segment or (starts_new_odom and result.state.has_pose)
        starts_new_odom = starts_new_odom and not new_segment
        answer(TrackerAnswered(key, generation, _tracked_message(frame, result, new_segment)))
        tracker.finish(frame, result.keyframe_ready)  # after the pose is sent
        heap.trim_if_due(time.monotonic())


def _tracked_message(frame: Frame, result: TrackResult, new_segment: bool) -> RemoteTrackingResult:
    return RemoteTrackingResult(
        frame.index,
        frame.stamp_ns,
        result.state,
        result.T_odom_body,
        result.keyframe_ready,
        new_segment,
        result.is_consistent,
        result.waiting_for,
    )
