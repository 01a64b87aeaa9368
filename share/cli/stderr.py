"""Stderr of a live command, written by a thread of its own.

A held terminal (Ctrl-S), a pager at rest, a full disk or a closed pipe would block a write, or end the
command. The thread takes that upon itself: the command neither waits nor fails.
"""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import threading
import weakref

import click

MAX_PENDING_LINES = 2000  # later ones are dropped (drop_newest)
_FLUSH_S = 1.0  # for what is pending at the end
_writers: weakref.WeakSet[Stderr] = weakref.WeakSet()


def flush_all() -> None:
    """Wait a moment until all pending text is written, so that what is printed next comes after it."""
    for writer in list(_writers):
        writer.flush()


class Stderr:
    """Writes that never block and never raise. Text that cannot be written is lost."""

    def __init__(self) -> None:
        self._stream = sys.stderr
        self._pending: queue.SimpleQueue[tuple[str, threading.Event | None]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._starting = threading.Lock()
        self._dropped_lines = 0
        _writers.add(self)

    @property
    def is_terminal(self) -> bool:
        try:
            return self._stream.isatty()
        except (AttributeError, ValueError):  # no stream; closed
            return False

    def print_line(self, text: str) -> None:
        """Write a line. Callable from any thread."""
        self.write(f"{text}\n")

    def write(self, text: str) -> None:
        """Write text without a line end. Callable from any thread."""
        if self._pending.qsize() >= MAX_PENDING_LINES:
            self._dropped_lines += 1
            return
        if self._dropped_lines:
            self._put(f"({self._dropped_lines} lines were dropped here: the output was blocked)\n")
            self._dropped_lines = 0
        self._put(text)

    def flush(self, timeout_s: float = _FLUSH_S) -> None:
        """Wait until all pending text is written, timeout_s at most."""
        if self._thread is not None:
            written = threading.Event()
            self._put("", written)
            written.wait(timeout_s)

    def close(self) -> None:
        self.flush()

    def _put(self, text: str, written: threading.Event | None = None) -> None:
        self._pending.put((text, written))
        with self._starting:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="stderr", daemon=True)
                self._thread.start()

    def _run(self) -> None:
        while True:
            text, written = self._pending.get()
            with contextlib.suppress(OSError, ValueError, AttributeError):
                self._write_blocking(text)
            if written is not None:
                written.set()

    def _write_blocking(self, text: str) -> None:
        """Write past Python's buffer: a blocked write would hold its lock when the interpreter exits."""
        try:
            handle = self._stream.fileno()
        except OSError:  # not a file, as in tests
            click.echo(text, self._stream, nl=False)
            return
        data = text.encode(self._stream.encoding, "backslashreplace")
        while data:
            data = data[os.write(handle, data) :]
