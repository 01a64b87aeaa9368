"""Workers of rooms that run in this process, called as over an engine, and that can be lost."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from share.runtime.remote_room import WorkerLostError
from share.runtime.remote_worker import RoomWorker, read_answer, request_bytes


class NearWorker:
    """The way to a `RoomWorker`, through bytes."""

    def __init__(self, name: str = "machine near") -> None:
        self.machine = name
        self.worker = RoomWorker()
        self.called: list[str] = []
        self.lost = threading.Event()
        self.is_killed = False

    def call(self, method: str, *arguments: Any, timeout_s: float | None = None) -> Any:
        self.called.append(method)
        if self.lost.is_set() or self.is_killed:
            raise WorkerLostError("is gone")
        answer = self.worker.call(request_bytes(method, arguments))
        if self.lost.is_set():
            raise WorkerLostError("is gone")
        return read_answer(answer)

    def lose(self) -> None:
        """As when its machine is gone; the lock on its map file is, too."""
        self.lost.set()
        self.worker.end_mapper()
        if self.worker._store is not None:
            self.worker._store.close()

    def kill(self) -> None:
        self.is_killed = True


class FakeMapper:
    """Stands for a mapper's process: it keeps what it gets."""

    def __init__(self, on_answer: Callable[[Any], None], on_death: Callable[[str], None]) -> None:
        self.answer, self.die = on_answer, on_death
        self.got: list[Any] = []
        self.is_closed = False

    def send(self, message: Any) -> None:
        self.got.append(message)

    def close(self) -> None:
        self.is_closed = True
