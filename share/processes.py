"""Processes of multiprocessing that end with their parent, and leave a terminal's signals to it.

A parent that ends in good order does not wait for those that it has not closed, as multiprocessing would: a
signal may have come before anybody knew of them.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing.util
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

# ---- Child processes that end with their parent, however it ends: killed, crashed or in good order.
#
# Every process that SHARE starts is started through here: one of its own commands with `environment()`, a
# worker of multiprocessing by `share.processes.SPAWN`, a fork that calls `follow` itself. The first thing
# that the child does, before it imports anything heavy, is to ask the kernel to be killed when its parent
# dies (PR_SET_PDEATHSIG), and then to look whether the parent has died meanwhile. The kernel takes the
# *thread* that started the child for its parent. So a child that was started by another than the main thread,
# which may end long before its process, and one on a system without that request, looks at its parent's
# number every 0.2 s instead.

_MARK = "SHARE_PARENT"  # PID:1 if the main thread of that process is the parent, else PID:0
_PR_SET_PDEATHSIG = 1
_LOOK_S = 0.2


def environment() -> dict[str, str]:
    """For `subprocess.Popen` of one of SHARE's own commands."""
    return {**os.environ, _MARK: f"{os.getpid()}:{is_main():d}"}


def follow_starter() -> None:
    """The first thing that a SHARE command does: it ends with the SHARE process that started it, if any."""
    parent, _, kernel = os.environ.pop(_MARK, "").partition(":")
    if parent.isdecimal():
        follow(int(parent), kernel == "1")


def follow(parent: int, kernel: bool = True) -> None:
    """This process ends with its parent. parent: its process id. kernel: its main thread started this one."""
    asked = kernel and _ask_kernel()
    if os.getppid() != parent:
        os._exit(1)
    if not asked:
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def is_main() -> bool:
    """Whether the main thread asks: what it starts has this process for its parent, to the kernel too."""
    return threading.current_thread() is threading.main_thread()


def _ask_kernel() -> bool:
    """Whether the kernel has agreed to kill this process when its parent ends."""
    if sys.platform != "linux":
        return False
    import ctypes

    return bool(ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) == 0)


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_LOOK_S)
    os._exit(1)


_GROUP = {signal.SIGINT, signal.SIGHUP}  # a terminal sends them to all: the parent handles them
_WAITING = {*_GROUP, signal.SIGTERM, signal.SIGALRM}  # until they can be handled; ALRM: `share.cli.unwinding`


def _begin(parent: int, kernel: bool) -> None:
    """Called while a spawned process is told what it is to do, before that imports anything."""
    follow(parent, kernel)
    for number in _GROUP:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _WAITING)


class _First:
    """Pickled before all else of a process: to read it is to call `_begin`."""

    def __reduce__(self) -> Any:
        return _begin, (os.getpid(), is_main())


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Signals are handled after the block: a child that is left half started writes a traceback. The mask is
    inherited by the child and holds back this thread alone; another thread may take a signal, which Python
    then handles in the main thread."""
    came: list[int] = []
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _WAITING)
    handlers = {number: signal.getsignal(number) for number in _WAITING} if is_main() else {}
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
