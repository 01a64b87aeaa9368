"""A worker process: it answers, it dies, it ends with its parent."""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from share.runtime import worker_process
from share.runtime.worker_process import END, Inbox, WorkerProcess

LINES = """
import sys, time
from test_worker_process import doubles
from share.runtime.worker_process import WorkerProcess
if __name__ == "__main__":
    c = WorkerProcess("doubles", doubles, (), lambda m: None, lambda how: None)
    print(c.pid, flush=True)
    time.sleep(60)
"""


INTERRUPTED = """
from test_worker_process import doubles
from share.runtime import worker_process as companion
start = companion.SPAWN_CONTEXT.Process.start
def interrupted(process):
    start(process)
    raise KeyboardInterrupt
if __name__ == "__main__":
    companion.SPAWN_CONTEXT.Process.start = interrupted
    try:
        companion.WorkerProcess("doubles", doubles, (), lambda m: None, lambda how: None)
    except KeyboardInterrupt as error:
        kept = error  # as a traceback that is printed keeps it
    print("interrupted", flush=True)
"""


def doubles(inbox: Inbox, answer: Callable[[Any], None]) -> None:
    while (number := inbox.get()) is not END:
        if number == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        answer(2 * number)


def test_it_answers_and_ends() -> None:
    received: queue.SimpleQueue[Any] = queue.SimpleQueue()
    lost: list[str] = []
    companion = WorkerProcess("doubles", doubles, (), received.put, lost.append)
    for number in range(100):
        companion.send(number)
    companion.close()
    assert [received.get_nowait() for _ in range(100)] == [2 * n for n in range(100)]
    assert not lost


def test_its_death_is_reported_once() -> None:
    lost: queue.SimpleQueue[str] = queue.SimpleQueue()
    companion = WorkerProcess("doubles", doubles, (), lambda message: None, lost.put)
    companion.send("die")
    assert "SIGKILL" in lost.get(timeout=20)
    companion.send(1)  # goes nowhere, and waits for nobody
    companion.close()
    assert lost.empty()


def test_another_takes_over_its_answers_and_its_death() -> None:
    first: queue.SimpleQueue[Any] = queue.SimpleQueue()
    second: queue.SimpleQueue[Any] = queue.SimpleQueue()
    companion = WorkerProcess("doubles", doubles, (), first.put, first.put)
    companion.send(1)
    assert first.get(timeout=20) == 2
    companion.attach(second.put, second.put)
    for message in (2, "die"):
        companion.send(message)
    assert second.get(timeout=20) == 4
    assert "SIGKILL" in second.get(timeout=20)
    assert companion.is_dead
    companion.close()
    assert first.empty()


def test_who_takes_over_a_dead_process_hears_of_it() -> None:
    lost: queue.SimpleQueue[str] = queue.SimpleQueue()
    companion = WorkerProcess("doubles", doubles, (), lambda message: None, lost.put)
    companion.send("die")
    reason = lost.get(timeout=20)
    companion.attach(lambda message: None, lost.put)
    assert lost.get_nowait() == reason
    companion.close()


def test_it_ends_with_its_parent() -> None:
    here = os.path.dirname(__file__)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([here, *sys.path])}
    parent = subprocess.Popen([sys.executable, "-c", LINES], stdout=subprocess.PIPE, env=environment)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 20
    while _alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _alive(pid)


def test_it_ends_if_the_parent_is_interrupted_before_close() -> None:
    here = os.path.dirname(__file__)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([here, *sys.path])}
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, env=environment, timeout=20
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


def _alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("later", [0, 1])
def test_a_process_without_a_thread_to_talk_to_it_is_ended(
    monkeypatch: pytest.MonkeyPatch, later: int
) -> None:
    """It went on, and nobody knew it."""
    started = list[Any]()
    start = threading.Thread.start

    def limited(thread: threading.Thread) -> None:
        if len(started) >= later:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", limited)
        with pytest.raises(RuntimeError, match="can't start new thread"):
            WorkerProcess("lone", doubles, (), print, print)
    assert not any(process.name == "lone" for process in multiprocessing.active_children())
    for thread in started:
        thread.join(10)
        assert not thread.is_alive()


class _Unsendable:
    def __reduce__(self) -> Any:
        raise MemoryError


class _Unreadable:
    """What the process itself can read, and the other side cannot."""

    def __reduce__(self) -> Any:
        return _read_in_the_process, ()


def _read_in_the_process() -> _Unreadable:
    if multiprocessing.parent_process() is None:
        raise MemoryError
    return _Unreadable()


def echoes(inbox: Inbox, answer: Callable[[Any], None]) -> None:
    while (message := inbox.get()) is not END:
        answer(message)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (_Unsendable(), "was ended: a message cannot be sent to it (MemoryError"),
        (_Unreadable(), "was ended: its answer cannot be read (MemoryError"),
    ],
    ids=["sent", "received"],
)
def test_short_memory_for_a_message_is_the_death_of_the_process(message: Any, reason: str) -> None:
    """Its thread ended without a word: nothing was mapped any more, and nobody restarted it."""
    died: queue.SimpleQueue[str] = queue.SimpleQueue()
    worker = WorkerProcess("echoes", echoes, (), lambda answer: None, died.put)
    worker.send(message)
    assert died.get(timeout=60).startswith(reason)
    assert worker.is_dead
    worker.close()


@pytest.mark.parametrize("error", [RuntimeError("no thread"), MemoryError(), OSError(12, "no memory")])
def test_a_process_that_cannot_be_started_later_is_dead(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """After a mapper's death the next one starts with a delay, in a thread, which ended without a word."""

    def fails(process: object) -> None:
        raise error

    monkeypatch.setattr(worker_process.SPAWN_CONTEXT.Process, "start", fails)
    died: queue.SimpleQueue[str] = queue.SimpleQueue()
    worker = WorkerProcess("echoes", echoes, (), lambda answer: None, died.put, 0.01)
    assert died.get(timeout=60).startswith("could not be started: ")
    worker.close()
