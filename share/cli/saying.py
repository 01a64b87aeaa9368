"""What a command that runs live says on stderr, written by a thread of its own.

A terminal that is held (Ctrl-S), a pager that is not read on, a log whose disk is full or whose reader is
gone hold up and end nothing: without the thread a write to them would, for as long as that lasts.
"""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import threading

import click

MOST = 2000  # lines that may wait; more are left out (drop_newest)
_PATIENCE_S = 1.0  # for what is left at the end


class Stderr:
    """`tell` never waits and raises nothing. What cannot be written is lost."""

    def __init__(self) -> None:
        self._stream = sys.stderr
        self._texts: queue.SimpleQueue[tuple[str, threading.Event | None]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._starting = threading.Lock()
        self._left_out = 0

    @property
    def is_terminal(self) -> bool:
        try:
            return self._stream.isatty()
        except (AttributeError, ValueError):  # none; closed
            return False

    def tell(self, text: str, nl: bool = True) -> None:
        """From any thread."""
        if self._texts.qsize() >= MOST:
            self._left_out += 1
            return
        if self._left_out:
            self._put(f"({self._left_out} lines were left out here: nobody read this output)\n")
            self._left_out = 0
        self._put(f"{text}\n" if nl else text)

    def flush(self, patience_s: float = _PATIENCE_S) -> None:
        """Waits until what was told is written, but not for longer."""
        if self._thread is not None:
            written = threading.Event()
            self._put("", written)
            written.wait(patience_s)

    def close(self) -> None:
        self.flush()

    def _put(self, text: str, written: threading.Event | None = None) -> None:
        self._texts.put((text, written))
        with self._starting:
            if self._thread is None:
                self._thread = threading.Thread(target=self._go, name="stderr", daemon=True)
                self._thread.start()

    def _go(self) -> None:
        while True:
            text, written = self._texts.get()
            with contextlib.suppress(OSError, ValueError, AttributeError):
                self._write(text)
            if written is not None:
                written.set()

    def _write(self, text: str) -> None:
        """Past Python's buffer, whose lock a write that waits would hold when the interpreter ends."""
        try:
            handle = self._stream.fileno()
        except OSError:  # it is no file, as in a test
            click.echo(text, self._stream, nl=False)
            return
        data = text.encode(self._stream.encoding, "backslashreplace")
        while data:
            data = data[os.write(handle, data) :]
