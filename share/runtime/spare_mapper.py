"""A mapper's process that is started ahead, so that a room wakes up without waiting for imports."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any

from share.runtime.mapper_process import start_mapper_process
from share.runtime.worker_process import WorkerProcess

_START_DELAY_S = 0.5  # of the next one: it must not slow down the one that was taken


class SpareMapper:
    """Keeps one process ready until `close`. Safe from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._spare: WorkerProcess | None = None
        self._is_wanted = self._is_closed = False

    def prepare(self) -> None:
        """Start a process if none is ready, and from now on whenever one was taken."""
        with self._lock:
            self._is_wanted = True
            if self._spare is None and not self._is_closed:
                self._spare = start_mapper_process(_ignore, _ignore, _START_DELAY_S)

    def take(
        self, on_answer: Callable[[Any], None], on_death: Callable[[str], None], start_delay_s: float = 0.0
    ) -> WorkerProcess:
        """Return a process as `start_mapper_process` does: the one that is ready, if it may start now; and
        prepare another."""
        with self._lock:
            spare = None if start_delay_s > 0.0 else self._spare
            self._spare = None if spare is not None else self._spare
        if spare is None or spare.is_dead:
            taken = start_mapper_process(on_answer, on_death, start_delay_s)
        else:
            taken = spare
            taken.attach(on_answer, on_death)
        if self._is_wanted:
            with contextlib.suppress(OSError, RuntimeError):  # too many open files: the next time
                self.prepare()
        return taken

    def close(self) -> None:
        with self._lock:
            spare, self._spare, self._is_closed = self._spare, None, True
        if spare is not None:
            spare.close()


def _ignore(_: Any) -> None:
    """Nobody waits for its answers yet; `attach` reports its death again."""
