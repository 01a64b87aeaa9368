"""The thread that writes what a live run leaves behind: the run goes on while the disk works, or does not."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial

from share.errors import ShareError
from share.metrics.frame_log import LineStore

MAX_PENDING = 20_000  # pieces of work that may wait: minutes of all that an agent or an edge has to write
_SLOW_WRITE_S = 5.0  # for one of them: from then on it is said
_TIMEOUT_S = 5.0  # for what is left at the end


class OutputWriter:
    """`submit` never waits: pieces of work are done in their order, in a thread, and `notify` is told of a
    disk
    that does not answer. Where `MAX_PENDING` wait, what comes is left out (policy `drop_new`). What a piece
    raises is kept for `check`, and the others go on.
    """

    def __init__(self, where: object, notify: Callable[[str], None]) -> None:
        """where: what is written, for a person. said: from any thread."""
        self._where, self._notify = where, notify
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._error: BaseException | None = None
        self._writing_since: float | None = None
        self._is_slow = False
        self._dropped = 0
        self._thread = threading.Thread(target=self._run, name="scribe", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str | None:
        """What is wrong with the disk at the moment, if so. From any thread."""
        since = self._writing_since
        took_s = 0.0 if since is None else time.monotonic() - since
        return (
            None if took_s < _SLOW_WRITE_S else f"{self._where}: its disk has not answered for {took_s:.0f} s"
        )

    def submit(self, work: Callable[[], None]) -> None:
        if not self._is_slow and (trouble := self.trouble) is not None:
            self._is_slow = True
            self._notify(f"{trouble}; what is to be written waits")
        if self._jobs.qsize() < MAX_PENDING:
            self._jobs.put(work)
            return
        self._dropped += 1
        if self._dropped == 1:
            self._notify(f"{self._where}: too much waits for its disk; what comes now is left out")

    def wait(self, timeout_s: float = _TIMEOUT_S) -> None:
        """Until what was to be done by now is done. Raises ShareError if that takes longer. A piece of work
        need not: what came before it is done."""
        if threading.current_thread() is self._thread:
            return
        done = threading.Event()
        self._jobs.put(done.set)
        if not done.wait(timeout_s):
            raise ShareError(f"{self._where}: is not complete: its disk does not answer")

    def stop(self, timeout_s: float = _TIMEOUT_S) -> None:
        """Waits until all is done, but not for longer. May be repeated."""
        self._jobs.put(None)
        self._thread.join(timeout_s)

    def check(self) -> None:
        """After `stop`. Raises what a piece of work has raised, and ShareError if not all was done."""
        if self._error is not None:
            raise self._error
        if self._thread.is_alive():
            raise ShareError(f"{self._where}: is not complete: its disk does not answer")
        if self._dropped:
            raise ShareError(f"{self._where}: is not complete: its disk did not answer for too long")

    def _run(self) -> None:
        while (work := self._jobs.get()) is not None:
            self._writing_since = time.monotonic()
            try:
                work()
            except BaseException as error:
                self._error = self._error or error
            self._writing_since = None
            if self._is_slow:
                self._is_slow = False
                self._notify(f"{self._where}: is written again")


class BackgroundLines:
    """Lines of a `RunLog` that a scribe writes; to read them is to wait for it."""

    def __init__(self, lines: LineStore, writer: OutputWriter) -> None:
        self._lines, self._writer = lines, writer

    def write(self, line: str) -> None:
        self._writer.submit(partial(self._lines.write, line))

    def read(self) -> Iterable[str]:
        """Raises ShareError if the disk does not answer."""
        self._writer.wait()
        return self._lines.read()
