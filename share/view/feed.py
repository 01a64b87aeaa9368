"""Bounded queue from the edge to a page's process. It never blocks the edge; when full it drops its oldest.

The edge's loop only appends values that it has anyway, and wakes nobody; of poses, reports and refusals the
newest is kept. A thread looks some times a second, makes events of them and sends them to the process; if
that is slow, this thread waits, and the queue drops.
"""

from __future__ import annotations

import contextlib
import pickle
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from share.geometry.camera import Rig
from share.protocol.edge_events import AddKeyframe, AddRun, DropRun, EdgeEffect, MapperResult, WriteEvent
from share.protocol.peer import RestoredRun
from share.types import Keyframe
from share.view import events as ev
from share.view import sources
from share.view.events import SessionSnapshot
from share.wire.messages import Hello, PoseUpdate

MAX_QUEUED = 512  # with keyframes of 30 kB, 15 MB
_REPORTED = (
    *("run", "kind", "state", "reason", "gone", "trouble", "pose_ms", "qoe", "qoe_target", "rate_hz"),
    *("delay_ms", "map_id", "keyframes", "loops", "rtt_ms"),
)
END = b""
_MOST_AT_ONCE = 32  # with keyframes of 30 kB, 1 MB
COLLECT_S = 1 / 15  # between messages: as often as the viewer draws


class _QueuedKeyframe(NamedTuple):
    run: str
    keyframe: Keyframe
    rig: Rig


class _SeenPose(NamedTuple):
    pose: PoseUpdate
    received_ns: int  # monotonic


class ViewFeed:
    """Sends to `connection` until `close`; where there is none, or the other end has gone, to none until
    `reconnect`. No method waits or raises.

    collect_s: between messages. has_images: keyframes come with cam0's image.
    """

    def __init__(
        self, connection: Connection | None = None, collect_s: float = COLLECT_S, has_images: bool = True
    ) -> None:
        self._connection = connection
        self._collect_s, self._has_images = collect_s, has_images
        self._next_connection: Connection | None = None
        self._snapshot = SessionSnapshot()
        self._queue: deque[object] = deque(maxlen=MAX_QUEUED)
        # the newest of each run or agent, not queued
        self._poses: Mapping[str, _SeenPose] = {}
        self._refusals: dict[str | None, ev.DecisionMade] = {}
        self._report: ev.AgentsReported | None = None
        self._sent_stamps: dict[str, int] = {}
        self._rigs: dict[str, Rig] = {}
        self._runs: dict[str, ev.RunArrived] = {}
        self._left_out_before = 0  # when runs were sent
        self.left_out = 0  # entries that were dropped
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._send_loop, name="view", daemon=True)
        self._thread.start()

    # ------------------------------------------------------------------ from the edge's loop

    def begin_session(self, map_file: Path | None, known: Sequence[RestoredRun]) -> None:
        """Start with what a map file holds. known: its runs, which may come back."""
        self._rigs = {run.key: run.hello.rig for run in known}
        self._runs = {run.key: _run_event(run.key, run.hello) for run in known}
        self._add(ev.SessionBegun(map_file))

    def add_effect(self, effect: EdgeEffect) -> None:
        match effect:
            case AddRun():
                self._rigs[effect.key] = effect.hello.rig
                self._runs[effect.key] = _run_event(effect.key, effect.hello)
                self._add(self._runs[effect.key])
            case AddKeyframe() if (rig := self._rigs.get(effect.key)) is not None:
                self._add(_QueuedKeyframe(effect.key, effect.keyframe, rig))
            case DropRun():
                for known in (self._rigs, self._runs, self._sent_stamps):
                    known.pop(effect.key, None)
                self._add(ev.RunRemoved(effect.key))
            case WriteEvent(fields):
                self._add_decision(fields)

    def _add_decision(self, fields: Mapping[str, Any]) -> None:
        """Queue a merge; of refusals, of which there are many, keep the newest of each agent."""
        if fields["event"] in ev.MERGES:
            self._add(_decision(fields))
        elif fields["event"] in ev.REFUSALS:
            self._refusals[fields["agent"]] = _decision(fields)

    def add_result(self, result: MapperResult) -> None:
        self._add(result)

    def add_poses(self, poses: Mapping[str, PoseUpdate]) -> None:
        """Replace the newest poses, by run."""
        now_ns, before = time.monotonic_ns(), self._poses
        self._poses = {
            run: old if (old := before.get(run)) is not None and old.pose is pose else _SeenPose(pose, now_ns)
            for run, pose in poses.items()
        }

    def add_report(self, report: Mapping[str, Any]) -> None:
        """Add edge.json as it is now."""
        agents = {
            label: {name: agent.get(name) for name in _REPORTED}
            for label, agent in report.get("agents", {}).items()
        }
        self._report = ev.AgentsReported(agents, tuple(report.get("trouble", ())), self.left_out)

    def add_event(self, event: ev.RoomEvent) -> None:
        """Add an event as it is."""
        self._add(event)

    def reconnect(self, connection: Connection) -> None:
        """Continue with another process, which first receives a snapshot."""
        self._next_connection = connection

    def close(self, wait_s: float = 1.0) -> None:
        """End; what is queued is sent for at most `wait_s`. May be repeated."""
        self._closing.set()
        self._thread.join(wait_s)

    def _add(self, entry: object) -> None:
        self.left_out += len(self._queue) == MAX_QUEUED
        self._queue.append(entry)  # drops the oldest

    # ------------------------------------------------------------------ the sender's thread

    def _send_loop(self) -> None:
        is_closing = False
        while not (is_closing and not self._queue):
            is_closing = self._closing.wait(self._collect_s)
            if (connection := self._next_connection) is not None:
                self._connection, self._next_connection = connection, None
                self._sent_stamps.clear()
                for events in batched(self._snapshot.events()):
                    self._send(events)
            for events in batched(self._take_events()):
                for event in events:
                    self._snapshot.apply(event)
                self._send(events)
        self._send(END)

    def _send(self, events: list[ev.RoomEvent] | bytes) -> None:
        """Send events, or the end as it is; skip the work while there is no receiver."""
        if self._connection is not None:
            data = events if isinstance(events, bytes) else pickle.dumps(events, pickle.HIGHEST_PROTOCOL)
            try:
                self._connection.send_bytes(data)
            except OSError:  # the viewer's process has ended
                self._connection = None

    def _take_events(self) -> Iterator[ev.RoomEvent]:
        if self.left_out != self._left_out_before:  # a run may have been among what was dropped
            self._left_out_before = self.left_out
            yield from list(self._runs.values())
        while self._queue:
            with contextlib.suppress(IndexError):  # dropped in between
                entry = self._queue.popleft()
                yield from self._events(entry)
        while self._refusals:
            yield self._refusals.pop(next(iter(self._refusals)))
        if (report := self._report) is not None:
            self._report = None
            yield report
        for run, (pose, received_ns) in self._poses.items():
            if self._sent_stamps.get(run) != pose.stamp_ns:
                self._sent_stamps[run] = pose.stamp_ns
                yield ev.PoseArrived(
                    run,
                    pose.state,
                    pose.keyframe,
                    pose.T_keyframe_body,
                    pose.age_ms,
                    pose.stamp_ns,
                    received_ns,
                    pose.sigma_m,
                    pose.sigma_rad,
                )

    def _events(self, entry: object) -> Iterator[ev.RoomEvent]:
        match entry:
            case _QueuedKeyframe():
                keyframe = sources.keyframe_event(*entry)
                yield keyframe if self._has_images else replace(keyframe, jpeg=b"")
            case MapperResult():
                for change in entry.changes:
                    if (shown := sources.change_event(change)) is not None:
                        yield shown
                for map_event in entry.map_events:
                    if (correction := sources.correction_event(map_event)) is not None:
                        yield correction
            case _ if isinstance(entry, ev.RoomEvent):
                yield entry


def batched(events: Iterator[ev.RoomEvent]) -> Iterator[list[ev.RoomEvent]]:
    """Yield the events, several at a time: a message each would cost more than most events do."""
    while batch := list(islice(events, _MOST_AT_ONCE)):
        yield batch


def _run_event(run: str, hello: Hello) -> ev.RunArrived:
    return sources.run_event(run, hello.name, hello.kind, hello.rig)


def _decision(fields: Mapping[str, Any]) -> ev.DecisionMade:
    return ev.DecisionMade(fields["t_s"], fields["event"], fields["agent"], fields["reason"])
