"""Jobs on several processes, spawned: threads, locks and graphics contexts are not inherited."""

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
_start_error: ShareError | None = None  # of this process, at its start
_JOBS_AHEAD = 2  # jobs handed out per worker, so that none waits for work


class Pool:
    """`workers` processes, each of which first calls `start(*arguments)`. They end with the block, or
    with this process."""

    def __init__(self, workers: int, start: Callable[..., None], arguments: tuple[object, ...]) -> None:
        self._workers = workers
        self._child_end, self._parent_end = SPAWN_CONTEXT.Pipe(
            duplex=False
        )  # nothing is sent: workers end when it closes
        self._pool = ProcessPoolExecutor(
            workers, SPAWN_CONTEXT, _init_worker, (self._child_end, start, arguments)
        )

    @property
    def worker_count(self) -> int:
        return self._workers

    def run(self, work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[tuple[Job, Result]]:
        """Every job with `work(job)`, in the order in which they are done. Raises what a job raised, or
        the ShareError that `start` did."""
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
            raise ShareError("one of its processes has died; is memory short?") from None

    def __enter__(self) -> Pool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._parent_end.close()  # a job may take many seconds; what it writes is whole or not there
        self._pool.shutdown(cancel_futures=True)
        self._parent_end.close()
        self._child_end.close()


def _init_worker(child_end: Connection, start: Callable[..., None], arguments: tuple[object, ...]) -> None:
    """The first thing that a process does."""
    threading.Thread(target=_exit_with_parent, args=(child_end,), daemon=True).start()
    global _start_error  # an exception here would be printed, and tell the parent nothing
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
        child_end.poll(None)  # nothing is sent: until the other end is closed
    os._exit(1)
