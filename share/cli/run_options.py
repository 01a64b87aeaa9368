"""The terms on which `share evaluate` plays a session, as options."""

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
        help="Through emulated networks, as share agent --link; one for all, or an agent its own.",
    ),
    click.option("--true-error", is_flag=True, help="Agents tell the edge their true error."),
    click.option(
        "--virtual", is_flag=True, help="In virtual time: tracked once, how long things take is drawn."
    ),
    click.option(
        "--costs", metavar="RUN", help="With --virtual: things take as long as in this run in real time."
    ),
    click.option(
        "--agents-first", is_flag=True, help="The edge gets what agents leave, as if they had own machines."
    ),
)


def run_options(command: Callable[..., None]) -> Callable[..., None]:
    """The options on which any run is played; by name as fields of `share.lab.evaluate.real_time.Terms`."""
    for option in reversed(_RUN_OPTIONS):
        command = option(command)
    return command


def load_run_config(
    config_file: str | None, options_given: dict[str, Any], sessions: Sequence[Session]
) -> Config:
    """What is wrong with them or with the terms is said before anything is played."""
    from share.net.emulated_link import LinkAssignment

    config, links = options.load_config(config_file), LinkAssignment.parse(options_given["link"])
    for session in sessions:
        links.check(session.agents)
    if options_given["costs"] is not None:
        from share.lab.evaluate.virtual_time import read_delays

        if not options_given["virtual"]:
            raise UsageError("--costs: in real time things take as long as they take; it goes with --virtual")
        read_delays(Path(options_given["costs"]))
    return config
