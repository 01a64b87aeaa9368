"""Trackers of agents that stream (policy `streamed`), each in a process of its own: the very one that
`share track` runs."""

from __future__ import annotations

import threading
from collections.abc import Callable

from share.config import Config
from share.core.edge_events import Answered, BeginTracking, EndTracking, FromTracker, Lost, Ready, Track
from share.estimator.result import TrackResult
from share.geometry.camera import Rig
from share.run.companion import END, Companion, Inbox
from share.run.pipeline import tracker_of
from share.types import Frame
from share.wire.messages import Tracked

_PATIENCE_S = 6.0  # for one to end


class Trackers:
    """Begins, feeds and ends them, and waits for none. `heard` is called from other threads."""

    def __init__(self, settings: Config, heard: Callable[[FromTracker], None]) -> None:
        self._settings, self._heard = settings, heard
        self._running: dict[str, Companion] = {}
        self._ending: list[threading.Thread] = []

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

        def lost(how: str) -> None:
            self._heard(Lost(key, life, how))

        about = (self._settings, what.rig, key, life)
        return Companion(f"tracking {key}", track_all, about, self._heard, lost)

    def _end(self, key: str) -> None:
        if (companion := self._running.pop(key, None)) is not None:
            self._ending = [thread for thread in self._ending if thread.is_alive()]
            self._ending.append(threading.Thread(target=companion.close, daemon=True))
            self._ending[-1].start()


def track_all(
    inbox: Inbox, answer: Callable[[FromTracker], None], settings: Config, rig: Rig, key: str, life: int
) -> None:
    """For a `Companion`: takes frames, answers Ready and then each with Answered, until END."""
    tracker = tracker_of(rig, settings)
    broken = life > 0  # there was another before, in another odom
    answer(Ready(key, life))
    while (frame := inbox.get()) is not END:
        result = tracker.track(frame)
        new_stretch = result.new_stretch or (broken and result.state.has_pose)
        broken = broken and not new_stretch
        answer(Answered(key, life, _told(frame, result, new_stretch)))
        if result.keyframe:  # after its pose is out; what it shows to others is for nobody
            tracker.keyframe(frame)
            tracker.settle()


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
