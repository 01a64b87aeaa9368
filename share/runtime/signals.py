"""Ending a live run in good order: on Ctrl-C, SIGTERM, or when its terminal is gone."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_on_signal(stop: Callable[[], None]) -> Iterator[None]:
    """Within, the first SIGINT, SIGTERM or SIGHUP calls `stop`; then SIGINT and SIGTERM interrupt at once.

    SIGHUP is ignored from then on, also afterwards: kernel and shell may both send it for one terminal, and
    there may be files to write. Where it was ignored before (nohup), it ends nothing.
    """

    def handler(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        stop()

    signals = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signals.append(signal.SIGHUP)
    previous_handlers = {number: signal.signal(number, handler) for number in signals}
    try:
        yield
    finally:
        for number, old in previous_handlers.items():
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, old)
