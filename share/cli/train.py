"""`share train`: the model that estimates a tracker's error, from recordings with truth to a file to ship."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.progress import LiveLine

if TYPE_CHECKING:
    from share.train.label_file import Labels


@click.group()
def train() -> None:
    """Teach the error model how wrong a tracker is.

    \b
    Example:  share emulate --scene warehouse --motion ar=walk: --seconds 30 --seed 1 --out rooms/w1
              share train labels rooms/* --runs 4 --out labels
    """


@train.command(short_help="Run the tracker over sessions with truth, and keep how wrong it was.")
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--runs",
    type=click.IntRange(1, 1000),
    default=4,
    show_default=True,
    help="Of each agent: one as recorded, the others spoiled (dark, blurred, frames missing …).",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of what is spoiled.")
@click.option("--workers", type=click.IntRange(1, 64), default=2, show_default=True, help="Runs at a time.")
@options.config
@click.option("--out", required=True, metavar="DIR", type=click.Path(path_type=Path), help="A file a run.")
def labels(
    sessions: tuple[Path, ...], runs: int, seed: int, workers: int, config_file: str | None, out: Path
) -> None:
    """Run our own tracker over each agent of SESSIONS, as recorded and spoiled, and write what each keyframe
    looked like and how wrong the tracker was.

    The error is that of the positions of the last 5 s, laid over the truth (SE3), rms in cm. What is there
    already is not made again, so the same command goes on where it was broken off.

    \b
    Example:  share train labels rooms/* --runs 8 --out labels
    """
    config, live = options.load_config(config_file), LiveLine()
    from share.io.files import writable_dir
    from share.io.session import read_session
    from share.run.labels import make, plan

    jobs = plan([read_session(folder) for folder in sessions], runs, seed, out)
    writable_dir(out)
    made = []
    for job, found in make(jobs, config, workers):
        made.append(found)
        live.write(f"{len(made)} of {len(jobs)} runs: {job.out.name}, {len(found)} keyframes")
    live.end()
    click.echo(_summary(made))
    click.echo(f"labels: {out}")


def _summary(made: list[Labels]) -> str:
    import numpy as np

    error_cm = np.concatenate([one.error_cm for one in made])
    known = error_cm[np.isfinite(error_cm)]
    told = f"{len(made)} runs, {len(error_cm)} keyframes, {len(known)} with a known error"
    if not len(known):
        return told
    at = np.percentile(known, [5, 25, 50, 75, 95, 99])
    return f"{told}\nerror, cm: " + ", ".join(
        f"{of} % below {cm:.2g}" for of, cm in zip((5, 25, 50, 75, 95, 99), at, strict=True)
    )
