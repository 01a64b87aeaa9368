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
from share.spawning import SPAWN, held

Job = TypeVar("Job")
Result = TypeVar("Result")
_failed: ShareError | None = None  # of this process, at its start
_AHEAD = 2  # jobs handed out per worker, so that none waits for work


class Pool:
    """`workers` processes, each of which first calls `start(*arguments)`. They end with the block, or
    with this process."""

    def __init__(self, workers: int, start: Callable[..., None], arguments: tuple[object, ...]) -> None:
        self._workers = workers
        self._going_on, self._ours = SPAWN.Pipe(duplex=False)  # nothing is sent: workers end when it closes
        self._pool = ProcessPoolExecutor(workers, SPAWN, _begin, (self._going_on, start, arguments))

    @property
    def count(self) -> int:
        return self._workers

    def run(self, work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[tuple[Job, Result]]:
        """Every job with `work(job)`, in the order in which they are done. Raises what a job raised, or
        the ShareError that `start` did."""
        waiting = iter(jobs)
        running: dict[Future[Result], Job] = {}
        try:
            while True:
                for job in islice(waiting, _AHEAD * self._workers - len(running)):
                    with held():
                        running[self._pool.submit(_do, work, job)] = job
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
            self._ours.close()  # a job may take many seconds; what it writes is whole or not there
        self._pool.shutdown(cancel_futures=True)
        self._ours.close()
        self._going_on.close()


def _begin(going_on: Connection, start: Callable[..., None], arguments: tuple[object, ...]) -> None:
    """The first thing that a process does."""
    threading.Thread(target=_end_with_block, args=(going_on,), daemon=True).start()
    global _failed  # an exception here would be printed, and tell the parent nothing
    try:
        start(*arguments)
    except ShareError as error:
        _failed = error


def _do(work: Callable[[Job], Result], job: Job) -> Result:
    if _failed is not None:
        raise _failed
    return work(job)


def _end_with_block(going_on: Connection) -> None:
    with suppress(OSError):
        going_on.poll(None)  # nothing is sent: until the other end is closed
    os._exit(1)
