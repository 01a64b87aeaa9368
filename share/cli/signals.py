"""Make signals that end a command unwind it, so that its children end and its temporary files go."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator
from types import FrameType

_RETRY_S = 0.02
_IMPORT_FILE = "<frozen importlib._bootstrap>"


@contextlib.contextmanager
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
