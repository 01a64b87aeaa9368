"""`-v` of every command: tracebacks, logged lines, times."""

from __future__ import annotations

import logging
import platform
import sys
import time
import traceback
from typing import Any

import click

_HELP = "Print more."


class VerboseOption(click.Option):
    """`-v` of a command that has no use of its own for it."""


class Verbosity:
    """Whether `-v` was given, for the command that runs in this process."""

    def __init__(self) -> None:
        self.is_on, self._start_s = False, 0.0

    def begin(self) -> None:
        """Forget what an earlier command was given."""
        self.is_on, self._start_s = False, time.monotonic()

    def turn_on(self) -> None:
        """Print what SHARE's modules log."""
        self.is_on = True
        logger = logging.getLogger("share")
        if not logger.handlers:
            handler = logging.StreamHandler(sys.stderr)
            handler.setFormatter(logging.Formatter("share: %(message)s"))
            logger.addHandler(handler)
        logger.setLevel(logging.INFO)

    def explain(self, error: BaseException) -> None:
        """Print where in the code an error was raised, with `-v`."""
        if self.is_on:
            click.echo("".join(traceback.format_exception(error)).rstrip(), err=True)

    def summarise(self, version: str) -> None:
        """Print version and duration, with `-v`."""
        if self.is_on:
            took_s = time.monotonic() - self._start_s
            click.echo(f"share {version}, Python {platform.python_version()}: took {took_s:.2f} s", err=True)


verbosity = Verbosity()


def remember(context: click.Context, option: click.Parameter, value: bool) -> bool:
    """Turn verbosity on where `-v` was given."""
    if value:
        verbosity.turn_on()
    return value


def with_verbose(command: click.Command) -> click.Command:
    """Return the command with `-v`, unless it is a group or has one of its own."""
    has_own: Any = any("--verbose" in option.opts for option in command.params)
    if not isinstance(command, click.Group) and not has_own:
        names = ["-v", "--verbose"]
        command.params.append(
            VerboseOption(names, is_flag=True, expose_value=False, help=_HELP, callback=remember)
        )
    return command
