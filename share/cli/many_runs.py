"""Many runs of `share evaluate`, in sequence or in parallel, with a live line."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli.terminal import LiveLine
from share.errors import ShareError

if TYPE_CHECKING:
    from share.lab.evaluate.campaign import PlannedRun, WorkerPool
    from share.lab.evaluate.real_time import Progress
    from share.lab.evaluate.trial import Trial

_MANY_RUN_OPTIONS = (
    click.option(
        "--seeds",
        type=click.IntRange(1),
        default=1,
        show_default=True,
        help="Number of seeds (0, 1, …), each a run.",
    ),
    click.option(
        "--workers",
        type=click.IntRange(1, 64),
        default=1,
        show_default=True,
        help="Runs in parallel; more than 1 needs --virtual.",
    ),
)


def many_run_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add --seeds and --workers to a command."""
    for option in reversed(_MANY_RUN_OPTIONS):
        command = option(command)
    return command


def play_runs(
    runs: Sequence[PlannedRun],
    workers: AbstractContextManager[WorkerPool] | None,
    label_of: Callable[[PlannedRun], str],
) -> dict[Path, Trial]:
    """Play runs; return those that succeeded, by folder, in the order of `runs`. Print why others failed."""
    from share.lab.evaluate.campaign import run_all

    live, done = LiveLine(), dict[Path, "Trial"]()

    def show(number: int, now: Progress | None) -> None:
        live.write(f"{number + 1} of {len(runs)}: {label_of(runs[number])}  {now or ''}")

    for one, result in run_all(runs, show, workers):
        if isinstance(result, ShareError):
            live.print_line(f"share: {one.out.name}: {result}")
        else:
            done[one.out] = result
    live.end()
    return {one.out: done[one.out] for one in runs if one.out in done}


def check_none_failed(succeeded: int, total: int) -> None:
    """Raise ShareError if any run failed."""
    if succeeded < total:
        raise ShareError(
            f"{total - succeeded} of {total} runs failed; run the same command again to repeat only those"
        )
