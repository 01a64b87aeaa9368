"""Agents recorded side by side, one task each, in fresh processes (spawned, so that threads and
locks of the parent are not inherited)."""

from __future__ import annotations

import signal
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2

from share.emulate.agents import AGENTS
from share.emulate.record import record

_POLL_S = 0.1


def record_all(
    folder: Path, frames: int, seed: int, workers: int, progress: Callable[[int, int], None]
) -> None:
    """`record` every agent. Raises what a worker raised; stops the others at their next frame."""
    total = frames * len(AGENTS)
    if workers <= 1:
        _here(folder, frames, seed, lambda done: progress(done, total))
        return
    context = get_context("spawn")
    counter, stop = context.Value("q", 0), context.Event()
    with ProcessPoolExecutor(min(workers, len(AGENTS)), context, _begin, (counter, stop)) as pool:
        try:
            tasks = [pool.submit(_task, i, folder, frames, seed) for i in range(len(AGENTS))]
            _follow(tasks, lambda: progress(counter.value, total))
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _here(folder: Path, frames: int, seed: int, progress: Callable[[int], None]) -> None:
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        progress(done)

    for i in range(len(AGENTS)):
        record(i, folder, frames, seed, count)


def _follow(tasks: list[Future[None]], report: Callable[[], None]) -> None:
    pending: set[Future[None]] = set(tasks)
    while pending:
        finished, pending = wait(pending, _POLL_S, FIRST_EXCEPTION)
        for task in finished:
            task.result()
        report()


# ---------------------------------------------------------------- in the worker

_shared: tuple[Any, Any]  # frames done by all, and whether to stop; set once, when the process begins


def _begin(counter: Any, stop: Any) -> None:
    global _shared
    _shared = counter, stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    cv2.setNumThreads(1)


def _task(index: int, folder: Path, frames: int, seed: int) -> None:
    record(index, folder, frames, seed, _count)


def _count() -> None:
    counter, stop = _shared
    if stop.is_set():
        raise InterruptedError("stopped")
    with counter.get_lock():
        counter.value += 1
