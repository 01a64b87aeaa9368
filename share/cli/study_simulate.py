"""`share study simulate`: a study with simulated participants, in virtual time."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.terminal import LiveLine, aligned_table, print_note
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.study.simulated_study import SimulatedStudy

_SHARED_AGENTS = 12


@click.command(short_help="Carry out a study with simulated participants.")
@click.option("--participants", type=click.IntRange(1, 1000), default=20, help="Number of participants.")
@click.option(
    "--goals", type=click.IntRange(1, 50), default=10, help="Number of spots, each called once in a trial."
)
@click.option(
    "--link",
    "network",
    metavar="NAME",
    help="Emulated network of each agent, as for `share evaluate run`.  [default: wifi5]",
)
@click.option(
    "--air",
    type=options.NumberRange(0.5, 1000),
    metavar="MBIT",
    help="All agents share the air of one access point of so many Mbit/s, in place of --link.",
)
@click.option(
    "--agents",
    type=click.IntRange(3, 50),
    help="Agents on the network; those beyond participant, researcher and robot are replayed.  "
    f"[default: 3; {_SHARED_AGENTS} with --air]",
)
@click.option("--scene", metavar="S", default="warehouse", help="Room, as for `share emulate`.")
@click.option("--mode", default="320x240@15", metavar="WxH@HZ", help="Image size and rate of all devices.")
@click.option("--distance", type=options.NumberRange(0.01, 100), default=0.5, help=options.DISTANCE)
@click.option("--timeout", type=options.NumberRange(0.1, 600), default=30.0, help=options.TIMEOUT)
@click.option("--seed", type=click.IntRange(0, 2**31), default=0, help="Seed of all that is drawn.")
@click.option("--workers", type=click.IntRange(1, 64), default=1, help="Trials in parallel, each a process.")
@click.option(
    "--scheduler",
    metavar="tcp://H:P",
    help="Dask cluster that plays the trials; its workers share the disk.",
)
@click.option("--table", "only_table", is_flag=True, help="Simulate nothing; print the results so far.")
@options.out_folder
@options.as_json
def simulate(
    participants: int,
    goals: int,
    network: str | None,
    air: float | None,
    agents: int | None,
    scene: str,
    mode: str,
    distance: float,
    timeout: float,
    seed: int,
    workers: int,
    scheduler: str | None,
    only_table: bool,
    out: Path,
    as_json: bool,
) -> None:
    """Carry out a study with simulated participants under the paper's four policies, in virtual time.

    Emulated people walk to spots, call the robot and wait; the researcher walks round them with a second
    headset; the robot drives by what its camera sees. DIR is a study's folder for `share study analyze`; the
    key is DIR-key.json. An interrupted command goes on when it is run again (docs/do/study.md).

    \b
    Example:  share study simulate --participants 12 --goals 5 --air 5 --workers 8 --out simulated
              share study analyze simulated --key simulated-key.json --out report
    """
    from share.lab.evaluate.provenance import code_digest
    from share.lab.study.simulated_report import about_lines, result_rows
    from share.lab.study.simulated_study import begin_study, key_path

    if network is not None and air is not None:
        raise UsageError("--air, --link: give one of them")
    settings = _settings(
        participants=participants,
        goals=goals,
        network=f"shared-{air:g}" if air else network or "wifi5",
        agents=agents or (_SHARED_AGENTS if air else 3),
        seed=seed,
        scene=scene,
        mode=mode,
        distance_m=distance,
        timeout_s=timeout,
    )
    study = begin_study(out.absolute(), settings)
    if study.missing() and not only_table:
        if study.code != code_digest():
            print_note(str(out), "was begun by another version of the program; its trials may differ")
        _carry_out(study, workers, scheduler)
    if as_json:
        title, *rows = result_rows(study)
        results = [dict(zip(title, row, strict=True)) for row in rows]
        click.echo(json.dumps({"about": about_lines(study), "results": results, "key": str(key_path(out))}))
        return
    for line in about_lines(study):
        click.echo(f"* {line}")
    click.echo(aligned_table(result_rows(study)))
    key = key_path(out)
    click.echo(f"study: {out}; statistics: share study analyze {out} --key {key} --out report")


def _carry_out(study: SimulatedStudy, processes: int, scheduler: str | None) -> None:
    """Carry out the missing trials; print the finished ones and an estimate of the time left."""
    from share.lab.evaluate.campaign import Cluster, worker_pool
    from share.lab.study.simulated_run import TimeLeft, estimated_s, run_missing

    pool: AbstractContextManager[Any] = (
        Cluster(scheduler) if scheduler else worker_pool(processes) or nullcontext()
    )
    with pool as opened:
        workers = 1 if opened is None else opened.worker_count
        total, live = len(study.missing()), LiveLine()
        about = f"about {estimated_s(study, workers) / 60:.0f} min with a core for each process"
        live.print_line(f"{total} trials to simulate, {about}; what is done stays done, so Ctrl-C is safe")
        left = TimeLeft(total)
        for number, done in enumerate(run_missing(study, workers, opened, partial(_show_stage, live)), 1):
            live.print_line(
                f"{number} of {total}: {done.participant} {done.policy}: {done.seconds:.0f} s simulated in "
                f"{done.cpu_s:.0f} s of CPU; about {left.after_one() / 60:.0f} min left"
            )
        live.end()


def _show_stage(live: LiveLine, stage: str, done: int, total: int) -> None:
    live.write(f"{stage}: {done} of {total}")


def _settings(**fields: Any) -> Any:
    from share.lab.study.simulated_study import SimulationSettings

    try:
        return SimulationSettings(**fields)
    except ValueError as error:
        raise UsageError(str(error)) from None
