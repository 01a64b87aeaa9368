"""Threads that write, so that a live run never waits for a disk, a terminal or a pipe."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from functools import partial

from share.errors import ShareError

MAX_PENDING = 20_000  # jobs of an `OutputWriter` that may wait: minutes of output of an agent or an edge
_SLOW_WRITE_S = 5.0  # duration of one job from which it is reported as trouble
_TIMEOUT_S = 5.0  # for the remaining jobs at the end


class JobThread:
    """Runs jobs in order. Jobs must not raise.

    on_idle: called whenever no job waits. Returns after how many seconds it is to be called again even if no
    job comes, None: not. Raises RuntimeError where no thread can be started: now, as none may be had later.
    """

    def __init__(self, name: str, on_idle: Callable[[], float | None] = lambda: None) -> None:
        self._on_idle = on_idle
        self._jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._busy_since: float | None = None
        self._is_ended = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def pending_jobs(self) -> int:
        return self._jobs.qsize()

    @property
    def busy_s(self) -> float:
        """Duration of the current job so far, s; 0 without one."""
        since = self._busy_since
        return 0.0 if since is None else time.monotonic() - since

    def submit(self, job: Callable[[], None]) -> None:
        """Never waits. Safe from any thread."""
        self._jobs.put(job)

    def wait(self, timeout_s: float) -> bool:
        """Wait until all jobs submitted so far are done; within a job they are. Return False on timeout."""
        if self._thread.ident == threading.get_ident():
            return True
        done = threading.Event()
        self.submit(done.set)
        return done.wait(timeout_s)

    def stop(self, timeout_s: float) -> bool:
        """End the thread after all jobs. Return False if that takes longer than `timeout_s`. May be
        repeated."""
        self.submit(self._end)
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _end(self) -> None:
        self._is_ended = True

    def _run(self) -> None:
        while not self._is_ended:
            wait_s = self._timed(self._on_idle) if self._jobs.empty() else None
            try:
                self._timed(self._jobs.get(timeout=wait_s))
            except queue.Empty:
                continue

    def _timed(self, work: Callable[[], float | None]) -> float | None:
        self._busy_since = time.monotonic()
        try:
            return work()
        finally:
            self._busy_since = None


class OutputWriter:
    """Runs submitted jobs in order, in a thread; `submit` never waits. `notify` reports a disk that does not
    answer. While `MAX_PENDING` jobs wait, new ones are dropped (policy `drop_new`). The first error of a job
    is kept for `check`; later jobs still run.
    """

    def __init__(self, where: object, notify: Callable[[str], None]) -> None:
        """where: what is written, for messages. notify: called from any thread."""
        self._where, self._notify = where, notify
        self._error: BaseException | None = None
        self._is_slow = False
        self._is_done = False
        self._dropped = 0
        self._thread = JobThread("output writer")

    @property
    def trouble(self) -> str | None:
        """The present trouble of the disk; None without one. Safe from any thread."""
        took_s = self._thread.busy_s
        if took_s < _SLOW_WRITE_S:
            return None
        return f"{self._where}: its disk has not answered for {took_s:.0f} s"

    def submit(self, work: Callable[[], None]) -> None:
        if not self._is_slow and (trouble := self.trouble) is not None:
            self._is_slow = True
            self._notify(f"{trouble}; writes wait")
        if self._thread.pending_jobs < MAX_PENDING:
            self._thread.submit(partial(self._run, work))
            return
        self._dropped += 1
        if self._dropped == 1:
            self._notify(f"{self._where}: too many writes wait for its disk; further ones are dropped")

    def wait(self) -> None:
        """Wait until all jobs submitted so far are done. Raises ShareError on timeout."""
        if not self._thread.wait(_TIMEOUT_S):
            raise ShareError(f"{self._where}: is not complete: its disk does not answer")

    def stop(self, timeout_s: float = _TIMEOUT_S) -> None:
        """Wait until all jobs are done, at most `timeout_s`. May be repeated."""
        self._is_done = self._thread.stop(timeout_s)

    def check(self) -> None:
        """Call after `stop`. Raises the first error of a job, or ShareError if not all jobs were done."""
        if self._error is not None:
            raise self._error
        if not self._is_done:
            raise ShareError(f"{self._where}: is not complete: its disk does not answer")
        if self._dropped:
            raise ShareError(f"{self._where}: is not complete: its disk did not answer for too long")

    def _run(self, work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:
            self._error = self._error or error
        if self._is_slow:
            self._is_slow = False
            self._notify(f"{self._where}: is written again")
