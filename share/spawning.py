"""Processes of multiprocessing that end with their parent, and leave a terminal's signals to it.

A parent that ends in good order does not wait for those that it has not closed, as multiprocessing would: a
signal may have come before anybody knew of them.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing.util  # before `_kill_remaining` is registered, so that it is called before theirs
import os
import signal
from collections.abc import Iterator, Mapping
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from share import child_processes

_TERMINAL_SIGNALS = {signal.SIGINT, signal.SIGHUP}  # a terminal sends them to all: the parent handles them
_DEFERRED_SIGNALS = {
    *_TERMINAL_SIGNALS,
    signal.SIGTERM,
    signal.SIGALRM,
}  # until they can be handled; ALRM: `share.cli.signals`


def _initialise_child(parent: int, from_main_thread: bool) -> None:
    """Called while a spawned process is told what it is to do, before that imports anything."""
    child_processes.exit_with_parent(parent, from_main_thread)
    for number in _TERMINAL_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _DEFERRED_SIGNALS)


class _ChildInitialiser:
    """Pickled before all else of a process: to read it is to call `_initialise_child`."""

    def __reduce__(self) -> Any:
        return _initialise_child, (os.getpid(), child_processes.is_main_thread())


@contextlib.contextmanager
def signals_deferred() -> Iterator[None]:
    """Signals are handled after the block: a child that is left half started writes a traceback. The mask is
    inherited by the child and holds back this thread alone; another thread may take a signal, which Python
    then handles in the main thread."""
    received: list[int] = []
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, _DEFERRED_SIGNALS)
    handlers = (
        {number: signal.getsignal(number) for number in _DEFERRED_SIGNALS}
        if child_processes.is_main_thread()
        else {}
    )
    for number, handler in handlers.items():
        if callable(handler):
            signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if callable(handler):
                signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
        for pending in received:
            signal.raise_signal(pending)


def _restore_process(initialiser: None, process_type: type[_Process], state: Mapping[str, Any]) -> _Process:
    process = process_type.__new__(process_type)
    process.__dict__.update(state)
    return process


class _Process(SpawnProcess):
    """It ignores SIGINT and SIGHUP from its first instruction: a terminal sends them to the whole group."""

    def start(self) -> None:
        with signals_deferred():
            super().start()

    def __reduce__(self) -> Any:
        return _restore_process, (_ChildInitialiser(), type(self), self.__dict__)


class _Context(SpawnContext):
    Process = _Process


@atexit.register
def _kill_remaining() -> None:
    for process in multiprocessing.active_children():
        if isinstance(process, _Process):
            process.kill()


SPAWN_CONTEXT = _Context()
