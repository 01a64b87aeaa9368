"""The thread that writes the output files of a live run, so that the run never waits for the disk."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial

from share.errors import ShareError
from share.metrics.frame_log import LineStore

MAX_PENDING = 20_000  # jobs that may wait: minutes of output of an agent or an edge
_SLOW_WRITE_S = 5.0  # duration of one job from which it is reported as trouble
_TIMEOUT_S = 5.0  # for the remaining jobs at the end


class OutputWriter:
    """Runs submitted jobs in order, in a thread; `submit` never waits. `notify` reports a disk that does not
    answer. While `MAX_PENDING` jobs wait, new ones are dropped (policy `drop_new`). The first error of a job
    is kept for `check`; later jobs still run.
    """

    def __init__(self, where: object, notify: Callable[[str], None]) -> None:
        """where: what is written, for messages. notify: called from any thread."""
        self._where, self._notify = where, notify
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._error: BaseException | None = None
        self._writing_since: float | None = None
        self._is_slow = False
        self._dropped = 0
        self._thread = threading.Thread(target=self._run, name="output writer", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str | None:
        """What is wrong with the disk now, None if nothing. Safe from any thread."""
        since = self._writing_since
        took_s = 0.0 if since is None else time.monotonic() - since
        return (
            None if took_s < _SLOW_WRITE_S else f"{self._where}: its disk has not answered for {took_s:.0f} s"
        )

    def submit(self, work: Callable[[], None]) -> None:
        if not self._is_slow and (trouble := self.trouble) is not None:
            self._is_slow = True
            self._notify(f"{trouble}; writes wait")
        if self._jobs.qsize() < MAX_PENDING:
            self._jobs.put(work)
            return
        self._dropped += 1
        if self._dropped == 1:
            self._notify(f"{self._where}: too many writes wait for its disk; further ones are dropped")

    def wait(self, timeout_s: float = _TIMEOUT_S) -> None:
        """Wait until all jobs submitted so far are done; within a job they are. Raises ShareError on
        timeout."""
        if threading.current_thread() is self._thread:
            return
        done = threading.Event()
        self._jobs.put(done.set)
        if not done.wait(timeout_s):
            raise ShareError(f"{self._where}: is not complete: its disk does not answer")

    def stop(self, timeout_s: float = _TIMEOUT_S) -> None:
        """Wait until all jobs are done, at most `timeout_s`. May be repeated."""
        self._jobs.put(None)
        self._thread.join(timeout_s)

    def check(self) -> None:
        """Call after `stop`. Raises the first error of a job, or ShareError if not all jobs were done."""
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
    """Lines of a `RunLog`, written by an `OutputWriter`; `read` waits for it."""

    def __init__(self, lines: LineStore, writer: OutputWriter) -> None:
        self._lines, self._writer = lines, writer

    def write(self, line: str) -> None:
        self._writer.submit(partial(self._lines.write, line))

    def read(self) -> Iterable[str]:
        """Raises ShareError if the disk does not answer."""
        self._writer.wait()
        return self._lines.read()
