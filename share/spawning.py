"""Multiprocessing context: its processes end with their parent and leave terminal signals to it.

A parent that ends in good order kills the ones it has not closed rather than wait for them as multiprocessing
does: a signal may have ended it before it recorded them.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing.util  # registers its exit handler before `_kill_remaining`, which so runs first
import os
import signal
from collections.abc import Iterator, Mapping
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from share import child_processes

_TERMINAL_SIGNALS = {signal.SIGINT, signal.SIGHUP}  # sent to the whole process group: the parent handles them
_DEFERRED_SIGNALS = {*_TERMINAL_SIGNALS, signal.SIGTERM, signal.SIGALRM}  # SIGALRM: `share.runtime.signals`


def _initialise_child(parent: int, from_main_thread: bool) -> None:
    """Set up a spawned process while it unpickles its task, before that imports anything."""
    child_processes.exit_with_parent(parent, from_main_thread)
    for number in _TERMINAL_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _DEFERRED_SIGNALS)


class _ChildInitialiser:
    """Pickled first of a process: unpickling it calls `_initialise_child`."""

    def __reduce__(self) -> Any:
        return _initialise_child, (os.getpid(), child_processes.is_main_thread())


@contextlib.contextmanager
def signals_deferred() -> Iterator[None]:
    """Defer signals until after the block, since a half-started child would print a traceback.

    The child inherits the mask. The mask covers this thread only; another thread may receive a signal, which
    Python then handles in the main thread, so handlers are replaced too."""
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
    """Ignores SIGINT and SIGHUP, which a terminal sends to the whole group, from its start."""

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
