"""One room of a site, which sleeps while nobody is in it: no mapper, no open map file.

awake -> nobody for a while -> a thread closes the room -> asleep
      -> a message for it, a keyframe to search or to forget -> the thread opens the map file -> awake
awake -> its machine is gone -> a thread closes the room -> the thread opens the map file on another -> awake

A room without a map file, or with one that may not be written, is always awake.
"""

from __future__ import annotations

import math
import queue
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from share.errors import VersionError, WireError, brief_reason, describe_exception
from share.mapping.places import FindKeyframe
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import PeerMessageReceived
from share.protocol.edge_records import SessionTotals
from share.protocol.peer import Sender, stranger_lines
from share.protocol.versions import refusal_of_version
from share.runtime.mapper_supervision import RecentTroubles
from share.runtime.output_writer import JobThread
from share.runtime.room_host import RoomHost
from share.runtime.room_jobs import (
    FileClosed,
    FileOpened,
    FileStamp,
    NotOpened,
    ProcessesEnded,
    RoomAnswer,
    close_file,
    end_processes,
    open_map,
)
from share.runtime.room_parts import OpenedRoom, OpenRoom, RoomStore, StartMapping, open_here
from share.runtime.served_room import ServedRoom
from share.timing import Backoff
from share.wire.codec import decode_only, encode, message_type
from share.wire.messages import NO_SESSION, Hello, Ping, Pong
from share.wire.room_messages import ClientHello

IDLE_S = 60.0  # without anybody, after which a room falls asleep
_MAX_WAITING = 64  # messages, and keyframes to search, that wait until the room is awake
_REPEATED_S = 1.0  # after which all repeat what waits, hellos and pings, but those who have gone
_SLOW_S = 5.0  # for the disk, from which it is reported as trouble
_TIMEOUT_S = 10.0  # for the thread at the end


@dataclass(frozen=True)
class RoomStart:
    """With what a room is served. totals: of its earlier sessions; is_unchanged: the map file is as the last
    of them has left it; is_unused: the room falls asleep at once, so it needs no processes."""

    store: RoomStore | None
    totals: SessionTotals
    is_unchanged: bool = False
    is_unused: bool = False
    start_mapper: StartMapping | None = None


ServeRoom = Callable[[RoomStart], ServedRoom]


class RoomKeeper:
    """Serves one room, and lets it sleep, until `close`.

    serve: raises StoreError. idle_s: without anybody, until it sleeps. keep_s: how long keyframes are kept;
    None: for ever. begins_asleep: if it may sleep. open_room: opens the map file of a room that wakes up.
    """

    def __init__(
        self,
        store: RoomStore | None,
        serve: ServeRoom,
        host: RoomHost,
        idle_s: float,
        keep_s: float | None = None,
        begins_asleep: bool = False,
        open_room: OpenRoom = open_here,
    ) -> None:
        self._serve, self._host, self._idle_s, self._keep_s = serve, host, idle_s, keep_s
        self._open_room = open_room
        self._path = store.path if store is not None and store.writable else None
        self._totals = SessionTotals()
        self._thread = JobThread("room")
        self._answers: queue.SimpleQueue[RoomAnswer] = queue.SimpleQueue()
        self._messages: deque[tuple[float, PeerMessageReceived]] = deque(maxlen=_MAX_WAITING)
        self._searches: deque[FindKeyframe] = deque(maxlen=_MAX_WAITING)
        self._is_changing = False  # the thread closes or opens the room
        self._is_called = False  # somebody comes
        self._is_visit = False  # nobody has asked for it since it was woken up by `visit`
        self._failure = ""  # why the map file cannot be opened
        self._retry_s = 0.0  # monotonic, as below
        self._backoff = Backoff(time.monotonic_ns())
        self._is_lost = False  # its machine is gone, and it is closed for that
        self._losses, self._loss_backoff = RecentTroubles(), Backoff(time.monotonic_ns())
        self._strangers = Sender()  # what a sleeping room was sent in vain
        self._said_problems = set(() if store is None else store.problems)  # of the map file
        self._last_report: dict[str, Any] = {}
        self._last_series: Mapping[str, Mapping[str, Any]] = {}
        self._used_s = self._asleep_s = time.monotonic()  # last used, fallen asleep
        self._expiry_s = math.inf  # when the first keyframe of a sleeping room is too old, unix s
        self._closing: ServedRoom | None = None  # as long as the thread closes it
        self._closed_stamp: FileStamp | None = None  # as in `FileClosed`
        is_unused = begins_asleep and self._path is not None
        room = serve(RoomStart(store, self._totals, is_unused=is_unused))
        self._room: ServedRoom | None = room
        self._last_protocol = room.protocol  # of a sleeping room: nothing changes in it
        if is_unused:
            self._fall_asleep(room)

    @property
    def room(self) -> ServedRoom | None:
        """The room while it is awake."""
        return self._room

    @property
    def protocol(self) -> EdgeProtocol | None:
        """Its state machine while it is awake."""
        return None if self._room is None else self._room.protocol

    def handle(self, event: PeerMessageReceived) -> None:
        """Handle a message. A sleeping room wakes up for somebody that it knows and for a hello; it keeps
        hellos and pings, all else comes again. It answers a stranger's ping, and counts what is neither."""
        if self._room is not None:
            self._room.handle(event)
            return
        is_known = self.knows(event.peer_id) is not None
        self._is_called |= is_known
        try:
            message = decode_only(event.frames, Hello, ClientHello, Ping)
        except VersionError as error:
            if refusal_of_version(error) is not None:  # it is to hear that, of the header
                self._keep(replace(event, frames=event.frames[:1]))
            else:
                self._strangers.counts["other_version"] += 1
        except WireError as error:
            self._strangers.count("bad_messages", str(error), time.monotonic_ns())
        else:
            if isinstance(message, Ping) and not is_known:
                pong = Pong.answering(message, time.monotonic_ns(), NO_SESSION)
                self._host.send(event.peer_id, encode(pong))
            elif message is not None:
                self._keep(event)
            elif not is_known:
                kind = message_type(event.frames).__name__
                self._strangers.count("unexpected", f"a message {kind} before its hello", time.monotonic_ns())

    def _keep(self, event: PeerMessageReceived) -> None:
        self._messages.append((time.monotonic(), event))
        self._is_called = True

    def find(self, request: FindKeyframe) -> None:
        """Search a keyframe in the map, as soon as the room is awake."""
        self._used_s, self._is_visit = time.monotonic(), False
        if self._room is not None:
            self._room.find(request)
        else:
            self._searches.append(request)
            self._is_called = True

    def visit(self) -> None:
        """Wake the room up until its mapper has restored the map and has nothing to do."""
        if self._room is None:
            self._is_called = self._is_visit = True

    @property
    def is_visited(self) -> bool:
        """Whether a visit is going on. One that cannot begin since the map cannot be read does not count."""
        return self._is_visit and not self._failure

    def knows(self, peer_id: bytes) -> int | None:
        """As `EdgeProtocol.knows`, also of a sleeping room."""
        return (self.protocol or self._last_protocol).knows(peer_id)

    def step(self) -> None:
        """Handle the answers of the room's processes, and the time that has passed."""
        now_s = time.monotonic()
        while not self._answers.empty():
            self._handle_answer(self._answers.get())
        if self._room is not None:
            self._room.step()
            self._is_visit = self._is_visit and self._room.protocol.is_empty
            if (loss := self._room.loss) is not None:
                self._open_anew(self._room, loss)
            elif not self._room.is_idle:
                self._used_s = now_s
            elif self._path is not None and now_s - self._used_s >= (0.0 if self._is_visit else self._idle_s):
                self._fall_asleep(self._room)
        elif self._path is not None and not self._is_changing and self._is_to_wake(now_s):
            self._submit(partial(open_map, self._path, self._closed_stamp, self._open_room))

    def stop(self) -> None:
        """From now on the death of a process is expected. Safe from any thread and from a signal handler."""
        if (room := self._room) is not None:
            room.stop()

    def close(self) -> str | None:
        """End all processes and threads. Return why the map file is incomplete, None if it is complete."""
        if not self._thread.stop(_TIMEOUT_S):
            if self._closing is None:  # it reads the file
                return None
            return "the disk of the map file does not answer: keyframes not acknowledged may be missing"
        while not self._answers.empty():
            if isinstance(answer := self._answers.get(), FileOpened):
                answer.opened.store.close()
        room = self._room or self._closing
        return None if room is None else room.close()

    # ------------------------------------------------------------------ sleep

    def _is_to_wake(self, now_s: float) -> bool:
        is_called = self._is_called or time.time() >= self._expiry_s
        return is_called and now_s >= self._retry_s

    def _fall_asleep(self, room: ServedRoom) -> None:
        self._is_visit = False
        self._last_protocol, self._asleep_s = room.protocol, time.monotonic()
        try:
            self._last_series, self._last_report = self.series(), room.report()
            self._totals = room.end_totals()
        except Exception as error:  # what is shown does not keep a room awake
            self._host.log_event("internal error", f"its last report: {describe_exception(error)}")
        self._room, self._closing = None, room
        self._submit(partial(end_processes, room))

    def _open_anew(self, room: ServedRoom, loss: str) -> None:
        """Close a room whose machine is gone, and wake it up at once on another."""
        text = f"{loss}; the room is opened anew, agents resend what is not in the map file"
        self._host.log_event("map", text)
        self._losses.add(text)
        self._fall_asleep(room)
        self._is_called = self._is_lost = True
        pause_s = self._loss_backoff.record_failure(time.monotonic_ns())
        self._retry_s = time.monotonic() + (pause_s if self._loss_backoff.failures > 1 else 0.0)

    def _submit(self, job: Callable[[], RoomAnswer]) -> None:
        """Have the thread do a job; `step` handles the answer."""
        self._is_changing = True

        def run() -> None:
            self._answers.put(job())
            self._host.wake()

        self._thread.submit(run)

    def _handle_answer(self, answer: RoomAnswer) -> None:
        self._is_changing = False
        match answer:
            case ProcessesEnded(error) if self._closing is not None and self._path is not None:
                if error is not None:
                    self._host.log_event("internal error", error)
                try:
                    self._closing.handle_answers()
                finally:  # a file that stays open could not be opened again
                    expires = self._keep_s is not None and not self._is_lost
                    self._submit(partial(close_file, self._closing, self._path, expires))
            case FileClosed(incomplete_reason, oldest_s, stamp) if (closed := self._closing) is not None:
                self._expiry_s = oldest_s + (self._keep_s or 0.0)
                stamp = None if self._is_lost else stamp  # the directory may know more
                self._closing, self._closed_stamp, self._is_lost = None, stamp, False
                closed.finish(incomplete_reason)
            case FileOpened(opened, is_unchanged):
                self._wake_up(opened, is_unchanged)
            case NotOpened(reason):
                self._retry_later(reason)

    def _wake_up(self, opened: OpenedRoom, is_unchanged: bool) -> None:
        since_s = time.monotonic() - _REPEATED_S
        start = RoomStart(opened.store, self._totals, is_unchanged, start_mapper=opened.start_mapper)
        try:
            self._room = self._serve(start)
        except Exception as error:  # such as too many open files: the other rooms go on
            opened.store.close()
            self._retry_later(brief_reason(error))
            return
        self._failure, self._is_called, self._used_s = "", False, time.monotonic()
        self._expiry_s = math.inf
        for problem in opened.store.problems:
            if problem not in self._said_problems:
                self._said_problems.add(problem)
                self._host.log_event("map", problem)
        for request in self._searches:
            self._room.find(request)
        for received_s, event in self._messages:
            if received_s >= since_s:  # else its sender has gone, and would keep others of its name out
                self._room.handle(event)
        self._searches.clear()
        self._messages.clear()

    def _retry_later(self, reason: str) -> None:
        """Keep the room asleep for a while. Nobody can enter until its map can be read."""
        pause_s = self._backoff.record_failure(time.monotonic_ns())
        self._retry_s = time.monotonic() + pause_s
        if reason != self._failure:
            self._host.log_event("map", f"{reason}; retried every {pause_s:g} s and more")
        self._failure = reason

    # ------------------------------------------------------------------ what is shown

    def show_poses(self) -> None:
        if self._room is not None:
            self._room.show_poses()

    def may_have_map(self, map_id: str) -> bool:
        """As `ServedRoom.may_have_map`; nothing changes in a sleeping room."""
        return self._room is None or self._room.may_have_map(map_id)

    def series(self) -> Mapping[str, Mapping[str, Any]]:
        """Return `series` of edge.json; of a sleeping room, and of who has not come back, as it was."""
        series = {} if self._room is None else self._room.series()
        new = {name: one for name, one in series.items() if any(one.values())}
        return {**series, **self._last_series, **new}

    def report(self) -> dict[str, Any]:
        """Return edge.json of the room; of a sleeping one as it was, with `asleep`. Raises LookupError
        if it has none."""
        losses = self._losses.current()
        if self._room is not None:
            self._last_report = report = self._room.report()
            return self._with_strangers({**report, "trouble": [*losses, *report["trouble"]]})
        trouble = [*losses, self._failure] if self._failure else losses
        if (took_s := self._thread.busy_s) >= _SLOW_S:
            what = "opening" if self._closing is None else "closing"
            trouble = [*trouble, f"{what} the map file has taken {took_s:.0f} s so far: nobody can enter"]
        if not self._last_report:
            raise LookupError("it fell asleep without a report")
        report = _aged(self._last_report, time.monotonic() - self._asleep_s)
        report.pop("loading", None)  # of a room that was never awake
        refused = stranger_lines(self._strangers, time.monotonic_ns())
        return self._with_strangers({**report, "refused": refused, "trouble": trouble, "asleep": True})

    def _with_strangers(self, report: dict[str, Any]) -> dict[str, Any]:
        counts = Counter(report.get("unjoined", {}))
        counts.update(self._strangers.counts)
        return {**report, "unjoined": dict(counts)}


def _aged(report: dict[str, Any], more_s: float) -> dict[str, Any]:
    """Return a room's report with the ages in it that much larger."""
    return {
        **_increased(report, last_solve_s=more_s),
        "agents": {
            name: _increased(agent, last_received_s=more_s, pose_age_ms=1e3 * more_s)
            for name, agent in report.get("agents", {}).items()
        },
    }


def _increased(fields: Mapping[str, Any], **more: float) -> dict[str, Any]:
    older = {name: round(fields[name] + n, 3) for name, n in more.items() if fields.get(name) is not None}
    return {**fields, **older}
