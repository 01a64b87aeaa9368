"""Trackers of agents that stream (policy `streamed`), each in a process of its own: the very one that
`share track` runs."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable

from share.config import Config
from share.geometry.camera import Rig
from share.odometry.result import TrackResult
from share.protocol.edge_events import Answered, BeginTracking, EndTracking, FromTracker, Lost, Ready, Track
from share.protocol.remote_tracking import Room
from share.rates import Backoff
from share.runtime.guarded_tracker import Guard, GuardedTracker
from share.runtime.machine import cores, free_bytes
from share.runtime.worker import END, Companion, Inbox
from share.startup import Heap
from share.types import Frame
from share.wire.messages import Tracked

_PATIENCE_S = 6.0  # for one to end
_A_CORE = 2  # at 15 frames a second each; a frame takes 15 to 30 ms


def room() -> Room:
    """For trackers, on this machine as it is now."""
    free = free_bytes()
    told = "" if free is None else f", {free / 1e9:.1f} GB free"
    return Room(_A_CORE * cores(), f"{cores()} core{'' if cores() == 1 else 's'}{told}", free)


class Trackers:
    """Begins, feeds and ends them, and waits for none. `heard` is called from other threads."""

    def __init__(self, settings: Config, heard: Callable[[FromTracker], None]) -> None:
        self._settings, self._heard = settings, heard
        self._running: dict[str, Companion] = {}
        self._ending: list[threading.Thread] = []
        self._backoffs: dict[str, Backoff] = {}
        self._pauses: dict[str, float] = {}  # of those that died, until the next begins

    def do(self, what: BeginTracking | Track | EndTracking) -> None:
        match what:
            case BeginTracking():
                self._end(what.key)
                self._running[what.key] = self._begin(what)
            case Track():
                self._running[what.key].send(what.frame)
            case EndTracking():
                self._end(what.key)

    def close(self) -> None:
        """All end."""
        for key in list(self._running):
            self._end(key)
        for thread in self._ending:
            thread.join(_PATIENCE_S)

    def _begin(self, what: BeginTracking) -> Companion:
        key, life = what.key, what.life
        backoff = self._backoffs.setdefault(key, Backoff(time.monotonic_ns()))

        def lost(how: str) -> None:
            self._pauses[key] = pause_s = backoff.died(time.monotonic_ns())
            self._heard(Lost(key, life, f"{how}; the next one begins in {pause_s:g} s"))

        about = (self._settings, what.rig, key, life)
        return Companion(f"tracking {key}", track_all, about, self._heard, lost, self._pause_s(key))

    def _pause_s(self, key: str) -> float:
        """After a death; also while as many as there is room for are ending, or agents that come and go would
        fill the machine with them."""
        pause_s = self._pauses.pop(key, 0.0)
        ending = sum(thread.is_alive() for thread in self._ending)
        return pause_s if ending < _A_CORE * cores() else max(pause_s, _PATIENCE_S)

    def _end(self, key: str) -> None:
        if (companion := self._running.pop(key, None)) is not None:
            self._ending = [thread for thread in self._ending if thread.is_alive()]
            self._ending.append(threading.Thread(target=companion.close, daemon=True))
            self._ending[-1].start()


def track_all(
    inbox: Inbox, answer: Callable[[FromTracker], None], settings: Config, rig: Rig, key: str, life: int
) -> None:
    """For a `Companion`: takes frames, answers Ready and then each with Answered, until END."""
    guard = Guard(lambda text: print(f"share: tracking {key}: {text}", file=sys.stderr, flush=True))
    tracker, heap = GuardedTracker(rig, settings, guard), Heap()
    broken = life > 0  # there was another before, in another odom
    answer(Ready(key, life))
    while (frame := inbox.get()) is not END:
        result = tracker.track(frame)
        new_stretch = result.new_stretch or (broken and result.state.has_pose)
        broken = broken and not new_stretch
        answer(Answered(key, life, _told(frame, result, new_stretch)))
        tracker.finish(frame, result.keyframe)  # after its pose is out; what it shows to others is for nobody
        heap.tidy(time.monotonic())


def _told(frame: Frame, result: TrackResult, new_stretch: bool) -> Tracked:
    return Tracked(
        frame.index,
        frame.stamp_ns,
        result.state,
        result.T_odom_body,
        result.keyframe,
        new_stretch,
        result.sound,
        result.waits,
    )
