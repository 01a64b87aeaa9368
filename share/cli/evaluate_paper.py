"""`share evaluate paper`: every table and figure of the paper, in one report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.evaluate_many import check_none_failed, play_runs
from share.cli.terminal import Stages

if TYPE_CHECKING:
    from share.lab.evaluate.paper_plan import PaperPlan
    from share.recordings.session import Session


@click.command()
@click.argument("sessions", nargs=-1, type=options.PATH)
@click.option(
    "--quick", is_flag=True, help="One session of 20 s at 15 Hz, two values of each gain: minutes, not a day."
)
@click.option(
    "--with",
    "scores_file",
    metavar="FILE",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Add to the report: error models compared, a file by `train compare --json`.",
)
@options.workers
@options.config
@options.out_folder
def paper(
    sessions: tuple[Path, ...],
    quick: bool,
    scores_file: Path | None,
    workers: int,
    config_file: Path | None,
    out: Path,
) -> None:
    """Play what the paper plays, and report each of its tables and figures: what the paper says, what is
    measured here, why they differ.

    SESSIONS, or the paper's motions in two emulated scenes: made in DIR/sessions. Policies and gains are
    played in virtual time; `streamed` in real time, so let the machine do nothing else then. DIR gets
    paper.html (opens offline), paper.md, tables and pictures. An interrupted command continues when it is run
    again.

    \b
    Example:  share evaluate paper --quick --out paper
    """
    from share.files.writing import writable_dir
    from share.lab.evaluate.campaign import worker_pool
    from share.lab.evaluate.paper_pages import write_paper
    from share.lab.evaluate.paper_plan import FULL, QUICK, plan_runs
    from share.lab.train.score import read_scores
    from share.recordings.session import read_session

    plan = QUICK if quick else FULL
    scores = [] if scores_file is None else read_scores(scores_file)
    config = options.load_config(config_file)
    writable_dir(out, "paper.md", "paper.html", "agents.csv")
    opened = [read_session(folder) for folder in sessions] or _emulated(plan, out / "sessions", workers)
    runs = plan_runs(plan, opened, config, out)
    virtual = [run for run in runs.all if run.options.virtual]
    pool = worker_pool(workers)
    done = play_runs(virtual, pool, lambda one: one.out.name)
    done |= play_runs(runs.streamed, None, lambda one: f"{one.out.name}, in real time")
    failed = [run.out.name for run in runs.all if run.out not in done]
    write_paper(out, plan, runs, done, failed, scores)
    click.echo((out / "paper.md").read_text(encoding="utf-8").partition("\n## ")[0])
    click.echo(f"report: {out / 'paper.html'}, {out / 'paper.md'}")
    check_none_failed(len(done), len(runs.all))


def _emulated(plan: PaperPlan, folder: Path, workers: int) -> list[Session]:
    """Make the plan's sessions that are not there, and open all."""
    from share.lab.emulate.session import make_session
    from share.recordings.session import is_session, read_session

    for name, recipe in plan.sessions.items():
        if not is_session(folder / name):
            with Stages() as stages:
                make_session(recipe, folder / name, workers, stages)
    return [read_session(folder / name) for name in plan.sessions]
