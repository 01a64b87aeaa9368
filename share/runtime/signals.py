"""SIGINT, SIGTERM and SIGHUP unwind a command, so that its children end and its temporary files
go, or ask a live run to end by itself.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_RETRY_S = 0.02
_IMPORT_FILE = "<frozen importlib._bootstrap>"


@contextmanager
def unwind_on_signal() -> Iterator[None]:
    """Within the block, SIGINT raises KeyboardInterrupt; SIGTERM and SIGHUP raise SystemExit(128 + number).

    A signal that is ignored (nohup) stays ignored.
    """
    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    caught = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, _unwind) for number in caught}
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, old in before.items():
            signal.signal(number, old)


def _unwind(number: int, frame: FrameType | None) -> None:
    """Raise; during an import, a moment later.

    There, some libraries turn the exception into another (poselib: "cannot import the C++ backend"), and
    some swallow it.
    """
    if is_importing(frame):
        signal.signal(signal.SIGALRM, lambda _, later: _unwind(number, later))
        signal.setitimer(signal.ITIMER_REAL, _RETRY_S)
    elif number == signal.SIGINT:
        raise KeyboardInterrupt
    else:
        sys.exit(128 + number)


def is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == _IMPORT_FILE:
            return True
        frame = frame.f_back
    return False


@contextmanager
def stop_on_signal(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` on the first SIGINT or SIGTERM in the block, or on a SIGHUP before; a second SIGINT or
    SIGTERM interrupts at once.

    From then on SIGHUP is ignored, also after the block: kernel and shell may both send it when a terminal
    closes, while files are still being written. If it was ignored before (nohup), it stays ignored.
    """

    def handler(number: int, frame: FrameType | None) -> None:
        # functions, since a signal that is pending has no handler if it is SIG_DFL or SIG_IGN by now
        if number != signal.SIGHUP:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, _end_at_once)
        signal.signal(signal.SIGHUP, _ignore)
        stop()

    signals = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signals.append(signal.SIGHUP)
    previous_handlers = {number: signal.signal(number, handler) for number in signals}
    try:
        yield
    finally:
        for number, old in previous_handlers.items():
            if signal.getsignal(number) is not _ignore:
                signal.signal(number, old)


def _ignore(number: int, frame: FrameType | None) -> None:
    """Do nothing."""


def _end_at_once(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
