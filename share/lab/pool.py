"""Jobs on several spawned processes, which inherit no threads, locks or graphics contexts."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from itertools import islice
from multiprocessing.connection import Connection
from types import TracebackType
from typing import TypeVar

from share.errors import ShareError
from share.spawning import SPAWN_CONTEXT, signals_deferred

Job = TypeVar("Job")
Result = TypeVar("Result")
_start_error: ShareError | None = None  # raised by `start` in this worker
_JOBS_AHEAD = 2  # jobs submitted per worker, so that none is idle


class Pool:
    """`workers` processes, each of which first calls `start(*arguments)`. They end with the block or with
    this process."""

    def __init__(self, workers: int, start: Callable[..., None], arguments: tuple[object, ...]) -> None:
        self._workers = workers
        # Nothing is sent over this pipe: workers end when it closes.
        self._child_end, self._parent_end = SPAWN_CONTEXT.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(
            workers, SPAWN_CONTEXT, _init_worker, (self._child_end, start, arguments)
        )

    @property
    def worker_count(self) -> int:
        return self._workers

    def run(self, work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[tuple[Job, Result]]:
        """Yield each job with `work(job)`, in order of completion. Raises the error of a job, or the
        ShareError of `start`."""
        waiting = iter(jobs)
        running: dict[Future[Result], Job] = {}
        try:
            while True:
                for job in islice(waiting, _JOBS_AHEAD * self._workers - len(running)):
                    with signals_deferred():
                        running[self._pool.submit(_run_job, work, job)] = job
                if not running:
                    return
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    yield running.pop(future), future.result()
        except BrokenProcessPool:
            raise ShareError("a worker process has died; check whether memory is short") from None

    def __enter__(self) -> Pool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._parent_end.close()  # do not wait for running jobs; their outputs are written atomically
        self._pool.shutdown(cancel_futures=True)
        self._parent_end.close()
        self._child_end.close()


def _init_worker(child_end: Connection, start: Callable[..., None], arguments: tuple[object, ...]) -> None:
    """Initialise a worker."""
    threading.Thread(target=_exit_with_parent, args=(child_end,), daemon=True).start()
    global _start_error  # an exception here would be printed and not reach the parent
    try:
        start(*arguments)
    except ShareError as error:
        _start_error = error


def _run_job(work: Callable[[Job], Result], job: Job) -> Result:
    if _start_error is not None:
        raise _start_error
    return work(job)


def _exit_with_parent(child_end: Connection) -> None:
    with suppress(OSError):
        child_end.poll(None)  # returns when the other end is closed
    os._exit(1)
