"""A progress bar on stderr, silent when that is not a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click


@contextmanager
def progress(total: int, label: str) -> Iterator[Callable[[int], None]]:
    """Gives a function that is told how much more of `total` is done."""
    if not sys.stderr.isatty():
        yield lambda done: None
        return
    with click.progressbar(length=total, label=label, file=sys.stderr) as bar:
        yield bar.update


class LiveLine:
    """One line on a terminal that is written over; where stderr is none, nothing."""

    def __init__(self) -> None:
        self.seen, self._shown = sys.stderr.isatty(), False

    def write(self, text: str) -> None:
        if self.seen:
            click.echo("\r\x1b[K" + text, err=True, nl=False)
            self._shown = True

    def end(self) -> None:
        """Leaves the line as it is; what follows begins on a new one."""
        if self._shown:
            click.echo("", err=True)
        self._shown = False
