"""One thread that does the edge's heavy jobs, one at a time, off the receive path."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable

from share.core.edge import Done
from share.core.mapper import Job


class Worker:
    """`give` a job; `done` is called from the worker's thread with its result."""

    def __init__(self, done: Callable[[Done], None]) -> None:
        self._done = done
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="worker", daemon=True)
        self._thread.start()

    def give(self, job: Job) -> None:
        self._jobs.put(job)

    def close(self) -> None:
        """Let the job in hand finish; jobs not begun are left."""
        self._jobs.put(None)
        self._thread.join(timeout=5)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            began = time.perf_counter()
            result: object
            try:
                result = job.run()
            except Exception as error:  # a job that fails costs its keyframe, never the edge
                result = error
            self._done(Done(job, result, 1e3 * (time.perf_counter() - began)))
