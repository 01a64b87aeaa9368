"""A progress bar on stderr, silent when that is not a terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import click

from share.cli.saying import Stderr


@contextmanager
def progress(total: int, label: str) -> Iterator[Callable[[int], None]]:
    """Gives a function that is told how much more of `total` is done."""
    if not sys.stderr.isatty():
        yield lambda done: None
        return
    with click.progressbar(length=total, label=label, file=sys.stderr) as bar:
        yield bar.update


class LiveLine:
    """One line on a terminal that is written over, cut where that ends; where stderr is none, nothing. A
    terminal that is gone or held ends and delays nothing."""

    def __init__(self) -> None:
        self._stderr = Stderr()
        self.is_terminal, self._is_open = self._stderr.is_terminal, False

    def write(self, text: str) -> None:
        if self.is_terminal:
            self._stderr.tell("\r\x1b[K" + text[: _columns()], nl=False)
            self._is_open = True

    def end(self) -> None:
        """Leaves the line as it is; what follows begins on a new one. Waits a moment until all is written."""
        self._leave()
        self._stderr.flush()

    def print_line(self, text: str) -> None:
        """A line of its own on stderr, terminal or not."""
        self._leave()
        self._stderr.tell(text)

    def _leave(self) -> None:
        if self._is_open:
            self._stderr.tell("")
        self._is_open = False


def _columns() -> int | None:
    """That fit into a line of the terminal; None if it does not tell."""
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns or None
    except (OSError, ValueError):
        return None


class Stages:
    """A bar for each stage of a longer task, one after the other. Call it with (stage, done, total)
    inside its block."""

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
