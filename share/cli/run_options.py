"""The options that say how `share evaluate` plays a session."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.errors import UsageError

if TYPE_CHECKING:
    from share.config import Config
    from share.recordings.session import Session

_RUN_OPTIONS = (
    click.option(
        "--link",
        metavar="LINK[,AGENT=LINK…]",
        help="Emulated network, as share agent --link: one for all agents, or one per agent.",
    ),
    click.option(
        "--true-error", is_flag=True, help="Agents report their error against ground truth to the edge."
    ),
    click.option(
        "--virtual", is_flag=True, help="Play in virtual time: track once, draw the durations from a seed."
    ),
    click.option(
        "--costs", metavar="RUN", help="With --virtual: take the durations from this real-time run."
    ),
    click.option(
        "--agents-first",
        is_flag=True,
        help="Run the edge at lower CPU priority, as if agents had machines of their own.",
    ),
)


def run_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add these options to a command; their names are fields of `share.lab.evaluate.real_time.RunOptions`."""
    for option in reversed(_RUN_OPTIONS):
        command = option(command)
    return command


def load_run_config(
    config_file: str | None, options_given: dict[str, Any], sessions: Sequence[Session]
) -> Config:
    """Read the settings and check them and the run options before anything is played.

    Raises ConfigError, UsageError.
    """
    from share.lab.evaluate.emulated_network import LinkAssignment

    config, links = options.load_config(config_file), LinkAssignment.parse(options_given["link"])
    for session in sessions:
        links.check(session.agents)
    if options_given["costs"] is not None:
        from share.lab.evaluate.virtual_time import read_delays

        if not options_given["virtual"]:
            raise UsageError("--costs needs --virtual: in real time, durations are as they are")
        read_delays(Path(options_given["costs"]))
    return config
