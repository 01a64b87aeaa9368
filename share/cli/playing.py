"""Many runs, one after the other or side by side, with a live line: for the tables of `share evaluate`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli.progress import LiveLine
from share.errors import ShareError

if TYPE_CHECKING:
    from share.lab.evaluate.campaign import Planned, Workers
    from share.lab.evaluate.play import Progress
    from share.lab.evaluate.trial import Trial

_MANY = (
    click.option("--seeds", type=click.IntRange(1), default=1, show_default=True, help="How many: 0, 1, …"),
    click.option(
        "--workers",
        type=click.IntRange(1, 64),
        default=1,
        show_default=True,
        help="Processes that play (--virtual).",
    ),
)


def of_many(command: Callable[..., None]) -> Callable[..., None]:
    """How many seeds, and sessions at a time."""
    for option in reversed(_MANY):
        command = option(command)
    return command


def played(
    runs: Sequence[Planned],
    workers: AbstractContextManager[Workers] | None,
    named: Callable[[Planned], str],
) -> dict[Path, Trial]:
    """By folder, in the order of `runs`, those that did not fail; the others are said."""
    from share.lab.evaluate.campaign import go_through

    live, done = LiveLine(), dict[Path, "Trial"]()

    def show(number: int, now: Progress | None) -> None:
        live.write(f"{number + 1} of {len(runs)}: {named(runs[number])}  {now or ''}")

    for one, came in go_through(runs, show, workers):
        if isinstance(came, ShareError):
            live.say(f"share: {one.out.name}: {came}")
        else:
            done[one.out] = came
    live.end()
    return {one.out: done[one.out] for one in runs if one.out in done}


def check_all(done: int, of: int) -> None:
    """Raises ShareError where runs have failed."""
    if done < of:
        raise ShareError(f"{of - done} of {of} runs failed; the same command plays them again")
