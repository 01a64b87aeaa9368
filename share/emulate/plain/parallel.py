"""Agents recorded side by side, a spawned process each: threads and locks are not inherited."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from multiprocessing import connection, get_context, parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import cv2

from share.emulate.plain.agents import AGENTS
from share.emulate.plain.record import record
from share.errors import ShareError

_POLL_S = 0.1


def record_all(
    folder: Path, frames: int, seed: int, workers: int, progress: Callable[[int, int], None]
) -> None:
    """`record` every agent into `folder`, at most `workers` at a time. Raises what one of them raised;
    none runs on when this returns or raises."""
    context = get_context("spawn")
    counter, failures = context.Value("q", 0), context.SimpleQueue()
    waiting: list[BaseProcess] = [
        context.Process(target=_work, args=(i, folder, frames, seed, counter, failures), daemon=True)
        for i in range(len(AGENTS))
    ]
    running: list[BaseProcess] = []
    try:
        while waiting or running:
            while waiting and len(running) < max(workers, 1):
                running.append(waiting.pop(0))
                running[-1].start()
            connection.wait([process.sentinel for process in running], _POLL_S)
            progress(counter.value, frames * len(AGENTS))
            running = [process for process in running if not _ended(process, failures)]
    finally:
        for process in running:
            process.kill()
            process.join()


def _ended(process: BaseProcess, failures: Any) -> bool:
    if process.exitcode and not failures.empty():
        raise failures.get()
    if process.exitcode:
        raise ShareError(
            f"a process that renders images ended with code {process.exitcode}; is memory short?"
        )
    return process.exitcode == 0


def _work(index: int, folder: Path, frames: int, seed: int, counter: Any, failures: Any) -> None:
    """The life of one process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    cv2.setNumThreads(1)
    parent = parent_process()

    def count() -> None:
        if parent is None or not parent.is_alive():  # nobody will finish the session
            os._exit(1)
        with counter.get_lock():
            counter.value += 1

    try:
        record(index, folder, frames, seed, count)
    except Exception as error:
        failures.put(error)
        raise SystemExit(1) from None
