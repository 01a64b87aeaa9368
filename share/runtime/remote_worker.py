"""Rooms' map files and mappers, on the machine that their front has chosen (`remote_room`).

The file is opened where the mapper runs, since both read and write it, and SQLite's log is for one machine.
"""

from __future__ import annotations

import contextlib
import importlib.util
import pickle
import queue
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share import __version__
from share.errors import ShareError, StoreError, UsageError, describe_exception
from share.mapping.map_changes import MapChange, StoredMap
from share.runtime.mapper_process import RestoreMap, start_mapper_process
from share.runtime.worker_process import WorkerProcess
from share.store.map_store import MapStore
from share.store.salvage import ReadRows

_POLL_S = 2.0  # without an answer of the mapper, until `receive` returns nothing


@dataclass(frozen=True, eq=False)
class OpenedFile:
    """An open map file. outline: of its map, or why there is none."""

    writable: bool
    read_only_reason: str
    problems: tuple[str, ...]
    outline: StoredMap | ShareError | ValueError
    keyframes: int


@dataclass(frozen=True)
class RestoreFile:
    """As `RestoreMap`, with what the open file holds."""

    has_keys: bool


@dataclass(frozen=True, eq=False)
class MapperAnswers:
    """is_ended: these are the last. reason: why the mapper has died; None: it was asked to end."""

    answers: tuple[Any, ...]
    is_ended: bool = False
    reason: str | None = None


@dataclass(frozen=True)
class _Ended:
    reason: str | None


class RoomWorker:
    """Answers the calls of a room's front, several at a time."""

    def __init__(self) -> None:
        self._store: MapStore | None = None
        self._rows: ReadRows | None = None  # as the front's session begins with them
        self._using_store = threading.Lock()
        self._mapper: WorkerProcess | None = None
        self._answers: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def call(self, request: bytes) -> bytes:
        """Return the answer to a request that `request_bytes` has made, for `read_answer`: one way in, on
        which versions are compared and errors made lines."""
        version, *rest = pickle.loads(request)
        try:
            if version != __version__:
                raise UsageError(f"has SHARE {__version__}, the site {version}: install the same on both")
            method, arguments = rest
            answer = (True, getattr(self, method)(*arguments))
        except Exception as error:
            answer = (False, _sendable(error))
        return pickle.dumps(answer)

    def greet(self) -> None:
        """That this is called and answered says enough."""

    # ------------------------------------------------------------------ the map file

    def open_map(self, path: Path) -> OpenedFile:
        with self._using_store:
            self._store = MapStore.open(path)
            return self._describe()

    def describe_map(self) -> OpenedFile:
        with self._using_store:
            return self._describe()

    def write(self, changes: Sequence[MapChange]) -> tuple[str, ...]:
        """Return what is missing in the file."""
        with self._using_store:
            store = self._opened()
            store.write(changes)
            return store.problems

    def set_aside(self, forgotten: Mapping[str, int]) -> tuple[Path, OpenedFile]:
        with self._using_store:
            return self._opened().set_aside(forgotten), self._describe()

    def close_map(self) -> None:
        with self._using_store:
            self._opened().close()

    def end(self) -> None:
        """End the mapper and close the file, of a room that its front has given up or closed."""
        self.end_mapper()
        with self._using_store:
            if self._store is not None:
                self._store.close()

    def _opened(self) -> MapStore:
        if self._store is None:
            raise StoreError("the map file is not open")
        return self._store

    def _describe(self) -> OpenedFile:
        store = self._opened()
        outline: StoredMap | ShareError | ValueError
        try:
            outline = store.outline()
        except Exception as error:  # the front decides what becomes of the file
            outline = error if isinstance(error, StoreError) else ValueError(describe_exception(error))
        self._rows = None
        with contextlib.suppress(ShareError):  # the outline says it
            self._rows = store.rows()
        keyframes = 0 if self._rows is None else len(self._rows.tables["keyframe"])
        return OpenedFile(store.writable, store.read_only_reason, store.problems, outline, keyframes)

    def _take_rows(self) -> ReadRows:
        """Return the rows of which the front was told: it may have written since."""
        with self._using_store:
            taken, self._rows = self._rows, None
            return self._opened().rows() if taken is None else taken

    # ------------------------------------------------------------------ the mapper

    def start_mapper(self) -> None:
        """Start a mapper's process in place of an earlier one, if any."""
        self.end_mapper()
        # A process that is spawned runs its parent's main module, which here is the engine's.
        sys.modules["__main__"].__spec__ = importlib.util.find_spec("share.__main__")
        answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._answers = answers
        self._mapper = start_mapper_process(answers.put, lambda reason: answers.put(_Ended(reason)))

    def send(self, messages: Sequence[Any]) -> None:
        """Give messages to the mapper, in order: one call after the other."""
        if self._mapper is None:
            return
        for message in messages:
            if isinstance(message, RestoreFile):
                message = RestoreMap(self._take_rows(), message.has_keys)
            self._mapper.send(message)

    def receive(self) -> MapperAnswers:
        """Wait for answers of the mapper for a while, and return them."""
        answers: list[Any] = []
        with contextlib.suppress(queue.Empty):
            answers.append(self._answers.get(timeout=_POLL_S))
            while True:
                answers.append(self._answers.get_nowait())
        if answers and isinstance(last := answers[-1], _Ended):
            return MapperAnswers(tuple(answers[:-1]), True, last.reason)
        return MapperAnswers(tuple(answers))

    def end_mapper(self) -> None:
        """End the mapper after it has answered all messages."""
        mapper, self._mapper = self._mapper, None
        if mapper is not None:
            mapper.close()
            self._answers.put(_Ended(None))


class RoomHost:
    """The rooms of one machine, each by a number of its front's choice.

    One process has them all, which is there before it is needed: a room that is opened waits for no start.
    What computes are the mappers, in processes of their own.
    """

    def __init__(self) -> None:
        self._workers: dict[int, RoomWorker] = {}

    def call(self, room: int, request: bytes) -> bytes:
        """See `RoomWorker.call`."""
        return self._workers.setdefault(room, RoomWorker()).call(request)

    def drop(self, room: int) -> None:
        """End a room."""
        if (worker := self._workers.pop(room, None)) is not None:
            worker.end()


def request_bytes(method: str, arguments: tuple[Any, ...]) -> bytes:
    """Return a request for `RoomWorker.call`."""
    return pickle.dumps((__version__, method, arguments))


def read_answer(answer: bytes) -> Any:
    """Return what a method has returned, and raise what it has raised."""
    is_done, value = pickle.loads(answer)
    if not is_done:
        raise value
    return value


def _sendable(error: Exception) -> Exception:
    """Return an error of one line, which any SHARE can unpickle."""
    if isinstance(error, StoreError):
        return StoreError(str(error))
    if isinstance(error, UsageError):
        return UsageError(str(error))
    if isinstance(error, ShareError):
        return ShareError(str(error))
    return RuntimeError(describe_exception(error))
