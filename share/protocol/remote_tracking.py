"""The edge of policy `streamed`: it tracks each agent alone, from the frames that the agent streams.

It has no map. An agent is welcomed once its tracker is ready, so that no first frames are lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from share.config import Config
from share.geometry import rig_check
from share.geometry.camera import Rig
from share.protocol import edge_events as ed
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_membership import RunTrackers
from share.protocol.peer import Peer
from share.protocol.streaming import FrameWindow
from share.types import Frame
from share.wire import messages as wire
from share.wire.messages import RemoteTrackingResult
from share.wire.room_messages import ClientHello


@dataclass
class RemoteTracker:
    """The tracker of one run: its frames, answers and restarts. Trackers are processes of
    `share.runtime.tracker_processes`. generation: number of earlier ones. frames_streamed: received;
    frames_tracked: answered."""

    key: str
    rig: Rig
    frame_window: FrameWindow
    generation: int = 0
    is_running: bool = False
    is_ready: bool = False
    frames_streamed: int = 0
    frames_tracked: int = 0
    _has_answered: bool = field(default=False)  # in this generation

    def start(self) -> Sequence[ed.TrackerEffect]:
        """Start a tracker, if none is running."""
        if self.is_running:
            return ()
        self.is_running, self._has_answered = True, False
        return (ed.StartTracker(self.key, self.generation, self.rig),)

    def stop(self) -> Sequence[ed.TrackerEffect]:
        """Stop the tracker, if one is running."""
        was_running = self._reset()
        return (ed.StopTracker(self.key),) if was_running else ()

    def offer_frame(self, frame: Frame, now_ns: int) -> Sequence[ed.TrackerEffect]:
        """Queue a frame. Raises ValueError if its images do not fit the rig."""
        self._check_frame(frame)
        self.frames_streamed += 1
        self.frame_window.offer(frame, now_ns)
        return self._next_frame(now_ns)

    def take_answer(self, result: RemoteTrackingResult, now_ns: int) -> Sequence[ed.TrackerEffect]:
        self.frame_window.take_answered(result.index)
        self.frames_tracked += 1
        self._has_answered = True
        return self._next_frame(now_ns)

    def record_loss(self) -> bool:
        """Record that the tracker died. Return whether to restart it: only if it had answered a frame."""
        self._reset()
        return self._has_answered

    def report(self) -> dict[str, int]:
        """Return counts for edge.json. frames_dropped: for newer ones, or lost with a tracker that died."""
        dropped = self.frame_window.dropped + self.frame_window.unanswered
        counts = {"streamed": self.frames_streamed, "tracked": self.frames_tracked, "dropped": dropped}
        return {f"frames_{name}": count for name, count in counts.items()}

    def _next_frame(self, now_ns: int) -> Sequence[ed.TrackerEffect]:
        frame = self.frame_window.take_next(now_ns) if self.is_running else None
        return () if frame is None else (ed.TrackFrame(self.key, frame),)

    def _reset(self) -> bool:
        """Forget the running tracker. Return whether there was one."""
        was_running, self.is_running, self.is_ready = self.is_running, False, False
        self.frame_window.clear()
        self.generation += was_running
        return was_running

    def _check_frame(self, frame: Frame) -> None:
        images = {"image0": frame.image0, "image1": frame.image1, "depth": frame.depth}
        cameras = (self.rig.cam0, self.rig.cam1, self.rig.depth)
        for (name, image), camera in zip(images.items(), cameras, strict=True):
            have = "none" if image is None else f"{image.shape[1]}x{image.shape[0]}"
            want = "none" if camera is None else f"{camera.width}x{camera.height}"
            if have != want:
                raise ValueError(f"frame {frame.index}: {name} is {have}, the rig says {want}")


@dataclass(frozen=True)
class TrackingCapacity:
    """Number of agents that can be tracked at once, and the reason for a person. memory_bytes: for all
    trackers together; None: unknown."""

    max_agents: int
    reason: str
    memory_bytes: int | None = None

    def objection(self, others: Sequence[Rig], rig: Rig) -> str | None:
        """Return why `rig` cannot be tracked beside the others; None if it can. The first always can."""
        if others and len(others) >= self.max_agents:
            limit = f"{self.max_agents} streamed agent{'' if self.max_agents == 1 else 's'}"
            return f"this machine can track {limit}: {self.reason}; wait until one leaves"
        required = sum(tracker_bytes(each) for each in (*others, rig))
        if others and self.memory_bytes is not None and required > self.memory_bytes:
            size = f"{rig.cam0.width}x{rig.cam0.height}"
            return f"not enough memory to track another {size} stream: {self.reason}; wait until one leaves"
        return None


def tracker_bytes(rig: Rig) -> int:
    """Return the memory of a tracker process, bytes. Measured: 112 MB at 640x480 after 5 s, 320 MB at
    3800x2400."""
    return 100_000_000 + 32 * rig.cam0.width * rig.cam0.height


class RemoteTrackers(RunTrackers):
    """A tracker for each run. capacity: runs beyond it are refused; None: no limit. frame_window: frames
    of an agent that may wait."""

    tracks_agents = True

    def __init__(self, frame_window: int, capacity: TrackingCapacity | None) -> None:
        self._frame_window, self._capacity = frame_window, capacity
        self._trackers: dict[str, RemoteTracker] = {}  # by the key of the run

    def __getitem__(self, key: str) -> RemoteTracker:
        return self._trackers[key]

    def objection(self, key: str | None, rig: Rig) -> str | None:
        if key is None and (reason := rig_check.rig_problem(rig)) is not None:
            return reason
        others = [one.rig for one in self._trackers.values() if one.is_running and one.key != key]
        return None if self._capacity is None else self._capacity.objection(others, rig)

    def add(self, key: str, rig: Rig) -> None:
        self._trackers[key] = RemoteTracker(key, rig, FrameWindow(self._frame_window))

    def remove(self, key: str) -> None:
        del self._trackers[key]

    def start(self, key: str) -> Sequence[ed.TrackerEffect]:
        return self._trackers[key].start()

    def stop(self, key: str) -> Sequence[ed.TrackerEffect]:
        return self._trackers[key].stop()

    def is_ready(self, key: str) -> bool:
        return self._trackers[key].is_ready


class TrackingEdge(EdgeProtocol):
    """An `EdgeProtocol` without mapper and map writer. It emits `TrackerEffect` and takes `TrackerEvent`.
    capacity: agents beyond it are refused; None: no limit."""

    _agent_messages = frozenset((wire.Hello, ClientHello, wire.Ping, wire.Bye, wire.Status, Frame))

    def __init__(
        self,
        config: Config,
        session: int,
        began_ns: int | None = None,
        capacity: TrackingCapacity | None = None,
    ) -> None:
        self._trackers = RemoteTrackers(config.stream.window, capacity)
        super().__init__(config, session, began_ns=began_ns, trackers=self._trackers)

    def _dispatch(self, event: ed.EdgeEvent) -> None:
        match event:
            case ed.TrackerReady() | ed.TrackerAnswered() | ed.TrackerLost():
                tracker = self._trackers[event.key]
                if event.generation == tracker.generation and tracker.is_running:
                    self._on_tracker_event(self._registry.by_key[event.key], tracker, event)
            case _:
                super()._dispatch(event)

    def _on_tracker_event(
        self, peer: Peer, tracker: RemoteTracker, event: ed.TrackerReady | ed.TrackerAnswered | ed.TrackerLost
    ) -> None:
        """Handle an event of the run's present tracker."""
        match event:
            case ed.TrackerReady():
                tracker.is_ready = True
                self._membership.welcome(peer)
            case ed.TrackerAnswered():
                peer.status.add_pose(event.result.state, self._out.now_ns)
                self._out.send(peer.id, event.result)
                self._out.add(*tracker.take_answer(event.result, self._out.now_ns))
            case ed.TrackerLost():
                should_restart = tracker.record_loss()
                reason = f"its process {event.reason}; odometry starts again"
                self._out.record("tracking lost", peer, reason, throttled=False)
                if should_restart:
                    self._out.add(*tracker.start())
                else:  # it sends a hello again after a while
                    self._out.send(peer.id, wire.Refused(f"its tracking process {event.reason}"))

    def _on_agent_message(self, peer: Peer, message: wire.Message) -> None:
        match message:
            case wire.Status():
                peer.status.update(message, self._out.now_ns)
            case Frame():
                try:
                    self._out.add(*self._trackers[peer.key].offer_frame(message, self._out.now_ns))
                except ValueError as error:
                    self._out.count_bad_message(peer, str(error))

    def _peer_report(self, peer: Peer) -> dict[str, Any]:
        return super()._peer_report(peer) | self._trackers[peer.key].report()
