"""Processes of multiprocessing that end with their parent, and leave a terminal's signals to it.

A parent that ends in good order does not wait for those that it has not closed, as multiprocessing would: a
signal may have come before anybody knew of them.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing.util  # before `_kill_left` is registered, so that it is called before theirs
import os
import signal
from collections.abc import Iterator, Mapping
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from share import children

_GROUP = {signal.SIGINT, signal.SIGHUP}  # a terminal sends them to all: the parent handles them
_WAITING = {*_GROUP, signal.SIGTERM, signal.SIGALRM}  # until they can be handled; ALRM: `share.cli.unwinding`


def _begin(parent: int, kernel: bool) -> None:
    """Called while a spawned process is told what it is to do, before that imports anything."""
    children.follow(parent, kernel)
    for number in _GROUP:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _WAITING)


class _First:
    """Pickled before all else of a process: to read it is to call `_begin`."""

    def __reduce__(self) -> Any:
        return _begin, (os.getpid(), children.is_main())


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Signals are handled after the block: a child that is left half started writes a traceback. The mask is
    inherited by the child and holds back this thread alone; another thread may take a signal, which Python
    then handles in the main thread."""
    came: list[int] = []
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _WAITING)
    handlers = {number: signal.getsignal(number) for number in _WAITING} if children.is_main() else {}
    for number, handler in handlers.items():
        if callable(handler):
            signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if callable(handler):
                signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for late in came:
            signal.raise_signal(late)


def _made(first: None, kind: type[_Process], state: Mapping[str, Any]) -> _Process:
    process = kind.__new__(kind)
    process.__dict__.update(state)
    return process


class _Process(SpawnProcess):
    """It ignores SIGINT and SIGHUP from its first instruction: a terminal sends them to the whole group."""

    def start(self) -> None:
        with held():
            super().start()

    def __reduce__(self) -> Any:
        return _made, (_First(), type(self), self.__dict__)


class _Context(SpawnContext):
    Process = _Process


@atexit.register
def _kill_left() -> None:
    for process in multiprocessing.active_children():
        if isinstance(process, _Process):
            process.kill()


SPAWN = _Context()
