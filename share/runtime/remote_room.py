"""The front's side of rooms whose map file and mapper are on other machines (`remote_worker`).

loop -> RemoteMapper.send -> thread -> worker -> mapper
mapper -> worker -> thread -> on_answer -> loop
map writer's thread -> RemoteStore.write -> worker
"""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from share.errors import StoreError
from share.mapping.map_changes import MapChange, StoredMap
from share.runtime.mapper_process import RestoreMap
from share.runtime.remote_worker import MapperAnswers, OpenedFile, RestoreFile
from share.runtime.room_parts import OpenedRoom
from share.runtime.worker_process import END
from share.store.salvage import ReadRows

_SILENT_S = 10.0  # without an answer of a worker that has nothing to wait for: its machine is gone
_OPEN_S = 120.0  # for a map file to be opened, and repaired
_LOOP_S = 10.0  # for what the loop waits for: a map that is set aside
_READ_S = 60.0  # for a map file that is read anew, and repaired if it is damaged, in a thread
_END_S = 30.0  # for the last answers and for closing the file, at the end


class WorkerLostError(StoreError):
    """The machine or the process of a room's worker is gone."""


class WorkerHandle(Protocol):
    """The way to one `RoomWorker`. Safe from any thread."""

    @property
    def machine(self) -> str: ...

    def call(self, method: str, *arguments: Any, timeout_s: float | None = None) -> Any:
        """Return what the method returns. Raises WorkerLostError, and what the method raises."""

    def kill(self) -> None:
        """End it, whatever it does. May be repeated."""


StartWorker = Callable[[], WorkerHandle]  # raises ShareError


class RemoteRoom:
    """One worker, until `end`. loss: how it was lost; None: it lives, or was ended."""

    def __init__(self, worker: WorkerHandle) -> None:
        self._worker = worker
        self.loss: str | None = None

    def call(self, method: str, *arguments: Any, timeout_s: float | None = None) -> Any:
        """As `WorkerHandle.call`. A worker that is lost once is so for good."""
        if self.loss is not None:
            raise WorkerLostError(self.loss)
        try:
            return self._worker.call(method, *arguments, timeout_s=timeout_s)
        except WorkerLostError as error:
            self.loss = f"{self._worker.machine} {error}"
            self._worker.kill()
            raise WorkerLostError(self.loss) from None

    def end(self) -> None:
        self._worker.kill()


class _Rows(ReadRows):
    """The rows of a file that is open elsewhere: only the number of keyframes is here."""

    def __init__(self, keyframes: int) -> None:
        super().__init__({"keyframe": [(0, ())] * keyframes})


class RemoteStore:
    """A map file that a worker has open; has the interface of `MapStore` as far as a room needs it."""

    def __init__(self, room: RemoteRoom, path: Path, opened: OpenedFile) -> None:
        self.path, self._room = path, room
        self.read_only_reason, self.problems = opened.read_only_reason, opened.problems
        self._writable = opened.writable
        self._opened: OpenedFile | None = opened  # None: outdated

    @property
    def writable(self) -> bool:
        return self._writable

    @property
    def loss(self) -> str | None:
        return self._room.loss

    def outline(self) -> StoredMap:
        outline = self._described().outline
        if isinstance(outline, Exception):
            raise outline
        return outline

    def rows(self) -> ReadRows:
        """Return rows that `RemoteMapper` knows to be where the mapper is."""
        return _Rows(self._described().keyframes)

    def _described(self) -> OpenedFile:
        if self._opened is None or isinstance(self._opened.outline, Exception):
            self._opened = opened = self._room.call("describe_map", timeout_s=_READ_S)
            self.problems = opened.problems  # it may have been repaired
        return self._opened

    def write(self, new_changes: Sequence[MapChange]) -> None:
        self._opened = None
        self.problems = self._room.call("write", list(new_changes))

    def set_aside(self, forgotten: Mapping[str, int]) -> Path:
        renamed: Path
        renamed, self._opened = self._room.call("set_aside", dict(forgotten), timeout_s=_LOOP_S)
        return renamed

    def close(self) -> None:
        """Close the file, and end the worker."""
        self._writable = False
        with contextlib.suppress(StoreError):
            self._room.call("close_map", timeout_s=_END_S)
        self._room.end()

    def abandon(self) -> None:
        self._writable = False
        self._room.end()


class RemoteMapper:
    """The way to a mapper that a worker starts; has the interface of `WorkerProcess` as far as a room needs
    it. take_room: returns the worker to use, in a thread. owns_room: it ends with the mapper."""

    def __init__(
        self,
        take_room: Callable[[], RemoteRoom],
        owns_room: bool,
        on_answer: Callable[[Any], None],
        on_death: Callable[[str], None],
        start_delay_s: float,
    ) -> None:
        self._take_room, self._owns_room = take_room, owns_room
        self._on_answer, self._on_death = on_answer, on_death
        self._start_delay_s = start_delay_s
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._closing = threading.Event()
        self._dying = threading.Lock()
        self._is_dead = False
        self._receiver: threading.Thread | None = None
        self._sender = threading.Thread(target=self._run, name="to mapper", daemon=True)
        self._sender.start()

    def send(self, message: Any) -> None:
        if isinstance(message, RestoreMap) and isinstance(message.rows, _Rows):
            message = RestoreFile(message.has_keys)
        self._outbox.put(message)

    def close(self) -> None:
        """End the mapper after it has handled all messages."""
        self._closing.set()
        self._outbox.put(END)
        self._sender.join(_END_S)

    def _run(self) -> None:
        """Start the mapper, send until the end, and take the last answers."""
        if self._start_delay_s > 0.0 and self._closing.wait(self._start_delay_s):
            return
        try:
            room = self._take_room()
        except Exception as error:  # no machine has room for it
            self._die(f"could not be started: {error}")
            return
        try:
            room.call("start_mapper", timeout_s=_END_S)
            self._receiver = threading.Thread(
                target=self._receive, args=(room,), name="from mapper", daemon=True
            )
            self._receiver.start()
            while self._send_waiting(room):
                pass
            if not self._is_dead:
                room.call("end_mapper", timeout_s=_END_S)
        except Exception as error:
            self._die(f"ended: {error}")
        if self._receiver is not None:
            self._receiver.join(_END_S)
        if self._owns_room:
            room.end()

    def _send_waiting(self, room: RemoteRoom) -> bool:
        """Wait for messages and send all that wait. Return False at the end."""
        messages = [self._outbox.get()]
        with contextlib.suppress(queue.Empty):
            while messages[-1] is not END:
                messages.append(self._outbox.get_nowait())
        is_end = messages[-1] is END
        if messages := messages[: len(messages) - is_end]:
            room.call("send", messages, timeout_s=_END_S)
        return not is_end

    def _receive(self, room: RemoteRoom) -> None:
        try:
            while True:
                received: MapperAnswers = room.call("receive", timeout_s=_SILENT_S)
                for answer in received.answers:
                    self._on_answer(answer)
                if received.is_ended:
                    break
        except Exception as error:
            self._die(f"ended: {error}")
            return
        if received.reason is not None:
            self._die(received.reason)

    def _die(self, reason: str) -> None:
        """Report the mapper's death once, unless it was asked to end."""
        with self._dying:
            was_dead, self._is_dead = self._is_dead, True
        self._outbox.put(END)
        if not was_dead and not self._closing.is_set():
            self._on_death(reason)


@dataclass(frozen=True)
class RemoteRooms:
    """Opens rooms on other machines, and starts the mappers of those whose map is not kept."""

    start_worker: StartWorker

    def open_room(self, path: Path) -> OpenedRoom:
        """Open a map file that all machines see by the same name. Raises ShareError."""
        path = Path(os.path.abspath(path))
        room = RemoteRoom(self.start_worker())
        try:
            opened: OpenedFile = room.call("open_map", path, timeout_s=_OPEN_S)
        except BaseException:
            room.end()
            raise
        store = RemoteStore(room, path, opened)
        return OpenedRoom(store, partial(RemoteMapper, lambda: room, False))

    def start_mapper(
        self, on_answer: Callable[[Any], None], on_death: Callable[[str], None], start_delay_s: float
    ) -> RemoteMapper:
        def take_room() -> RemoteRoom:
            return RemoteRoom(self.start_worker())

        return RemoteMapper(take_room, True, on_answer, on_death, start_delay_s)
