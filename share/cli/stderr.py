"""Stderr of a live command, written by a thread of its own.

A held terminal (Ctrl-S), a pager at rest, a full disk or a closed pipe would block a write, or end the
command. The thread takes that upon itself: the command neither waits nor fails.
"""

from __future__ import annotations

import contextlib
import os
import sys
import weakref
from functools import partial

import click

from share.runtime.output_writer import JobThread

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
        self._thread = JobThread("stderr")
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
        if self._thread.pending_jobs >= MAX_PENDING_LINES:
            self._dropped_lines += 1
            return
        if self._dropped_lines:
            text = f"({self._dropped_lines} lines were dropped here: the output was blocked)\n{text}"
            self._dropped_lines = 0
        self._thread.submit(partial(self._write_blocking, text))

    def flush(self, timeout_s: float = _FLUSH_S) -> None:
        """Wait until all pending text is written, timeout_s at most."""
        self._thread.wait(timeout_s)

    def close(self) -> None:
        self.flush()

    def _write_blocking(self, text: str) -> None:
        """Write past Python's buffer: a blocked write would hold its lock when the interpreter exits."""
        with contextlib.suppress(OSError, ValueError, AttributeError):
            try:
                handle = self._stream.fileno()
            except OSError:  # not a file, as in tests
                click.echo(text, self._stream, nl=False)
                return
            data = text.encode(self._stream.encoding, "backslashreplace")
            while data:
                data = data[os.write(handle, data) :]
