"""Output of commands: progress bars and a live line on stderr, silent if that is no terminal; tables."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import click

from share.cli.stderr import Stderr

Column = tuple[str, Callable[[Any], str]]  # title, and the text of its cell in a row


@contextmanager
def progress(total: int, label: str) -> Iterator[Callable[[int], None]]:
    """Yield a function to call with each increment of `total` that is done."""
    if not sys.stderr.isatty():
        yield lambda done: None
        return
    with click.progressbar(length=total, label=label, file=sys.stderr) as bar:
        yield bar.update


class LiveLine:
    """One line that is overwritten in place, cut to the terminal's width; nothing if stderr is no terminal.

    A terminal that is gone or held neither ends nor delays the command.
    """

    def __init__(self) -> None:
        self._stderr = Stderr()
        self.is_terminal, self._is_open = self._stderr.is_terminal, False
        self._block_rows = 0  # of a block that is open

    def write(self, text: str) -> None:
        if self.is_terminal:
            self._stderr.write("\r\x1b[K" + text[: _columns()])
            self._is_open = True

    def write_block(self, lines: Sequence[str]) -> None:
        """Write several lines, no wider than the terminal, over those of the call before."""
        if self.is_terminal:
            text = "\n".join(f"{line}\x1b[K" for line in lines)
            self._stderr.write(f"{self._block_start()}{text}\x1b[J")
            self._is_open, self._block_rows = True, len(lines)

    def _block_start(self) -> str:
        """Return what moves to the first line of an open block, or to the start of the line."""
        return "\r" + (f"\x1b[{self._block_rows - 1}A" if self._block_rows > 1 else "")

    def end(self) -> None:
        """Keep the line as it is and start a new one. Waits a moment until all is written."""
        self._break_line()
        self._stderr.flush()

    def print_line(self, text: str) -> None:
        """Print a line of its own on stderr, terminal or not; it takes the place of an open block, which the
        next call draws below it."""
        if self._block_rows:
            self._stderr.write(f"{self._block_start()}\x1b[J")
            self._is_open, self._block_rows = False, 0
        self._break_line()
        self._stderr.print_line(text)

    def _break_line(self) -> None:
        if self._is_open:
            self._stderr.print_line("")
        self._is_open, self._block_rows = False, 0


def _columns() -> int | None:
    """Return the terminal's width; None if it is unknown."""
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns or None
    except (OSError, ValueError):
        return None


class Stages:
    """A progress bar per stage of a task, one at a time. Call with (stage, done, total) within its block."""

    def __init__(self) -> None:
        self._stage, self._done = "", 0
        self._stack = ExitStack()
        self._bar: Callable[[int], None] = lambda more: None

    def __call__(self, stage: str, done: int, total: int) -> None:
        if stage != self._stage:
            self._end()
            self._stage = stage
            self._bar = self._stack.enter_context(progress(total, f"{stage:24}"))
        self._bar(done - self._done)
        self._done = done

    def __enter__(self) -> Stages:
        return self

    def __exit__(self, *error: object) -> None:
        self._end()

    def _end(self) -> None:
        self._stack.close()
        self._stage, self._done = "", 0


def print_note(about: str, text: str) -> None:
    """Print a note or warning about a file, a recording or a device on stderr."""
    click.echo(f"share: {about}: {text}", err=True)


def column_table(columns: Sequence[Column], rows: Iterable[Any]) -> str:
    """Return an aligned table: a line of titles, and a line per row."""
    titles = [title for title, _ in columns]
    return aligned_table([titles, *([text(row) for _, text in columns] for row in rows)])


def aligned_table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows of cells as lines with right-aligned columns."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
    )
