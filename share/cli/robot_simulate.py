"""`share robot simulate`: send an emulated robot about in the room of a session."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.completion import complete_profile
from share.cli.terminal import Stages, aligned_table
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.robot.simulate import LoopOptions
    from share.robot.settings import RobotSettings

_LOCALISATIONS = ("share", "truth", "wheels")
_MAX_GOALS = 1000


@click.command()
@click.argument("session", type=options.PATH)
@click.option(
    "--goals",
    default="5",
    metavar="N|FILE",
    help="Number of goals, 2 to 6 m of way each; or a file with a goal a line: X Y [YAW], in the room, m and "
    "degrees.",
)
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of start, goals, robot and link.")
@click.option(
    "--localisation",
    type=click.Choice(_LOCALISATIONS),
    default="share",
    help="Where the robot has its place from: share (camera, tracker, edge), truth, or its wheels alone.",
)
@options.policy
@click.option(
    "--robot",
    "robot_file",
    metavar="FILE",
    type=options.EXISTING_FILE,
    help="The robot, as for `share robot bridge`.  [default: a D435i 9 cm ahead and 21 cm up, 0.3 m/s]",
)
@click.option(
    "--profile",
    default="d435i:640x480@15",
    metavar="PROFILE[:MODE]",
    shell_complete=complete_profile,
    help="The robot's device.",
)
@click.option(
    "--fault",
    "faults",
    multiple=True,
    metavar="KIND@TIME[:SECONDS]",
    help="What breaks, and when, s: edge, agent, network, bare-wall, bridge or rival. May be repeated.",
)
@click.option(
    "--seconds", type=click.FloatRange(min=5, max=3600), default=300, help="Longest run, simulated s."
)
@options.config
@click.option("--out", required=True, metavar="DIR", type=options.PATH, help="A new folder.")
@options.as_json
def simulate(
    session: Path,
    goals: str,
    seed: int,
    localisation: str,
    policy: str | None,
    robot_file: Path | None,
    profile: str,
    faults: tuple[str, ...],
    seconds: float,
    config_file: Path | None,
    out: Path,
    as_json: bool,
) -> None:
    """Send an emulated TurtleBot 4 about in the room of SESSION, made by `share emulate`, in virtual time.

    What the robot's camera sees from where it drives is drawn, tracked, and sent to an edge with the
    session's headsets; the bridge tells a navigator like Nav2's where the robot is, and passes it goals
    at which a headset's wearer points. DIR gets report.json and plan.png (docs/do/robot.md).

    \b
    Example:  share emulate --scene warehouse --motion ann=walk: --seconds 120 --out room1
              share robot simulate room1 --goals 5 --out drive
    """
    from share.files.writing import atomic_write, new_folder
    from share.lab.robot.report import draw_run, outcome_rows, run_report, summary_text
    from share.lab.robot.room import open_room, session_recipe
    from share.lab.robot.simulate import SHARE, prepare_run
    from share.recordings.session import read_session

    config = options.load_config(config_file, [policy])
    loop_options = _loop_options(goals, faults, localisation=localisation, policy=config.edge.policy)
    loop_options = replace(loop_options, seed=seed, seconds=seconds, profile=profile)
    robot, opened = _robot(robot_file), read_session(session)
    with new_folder(out) as folder, Stages() as stages:
        room = open_room(session_recipe(opened), stages, has_pictures=localisation == SHARE)
        run = prepare_run(opened, room, loop_options, config, robot, stages)
        for now_s in run.drive():
            stages("driving", int(now_s), round(seconds))
        report = run_report(run, str(session))
        atomic_write(folder / "report.json", json.dumps(report, indent=1) + "\n")
        draw_run(folder / "plan.png", room, run)
    if as_json:
        click.echo(json.dumps(report))
    else:
        click.echo(aligned_table(outcome_rows(run.outcomes)))
        click.echo(f"{summary_text(report)}\n{out}: report.json, plan.png")


def _loop_options(goals: str, faults: tuple[str, ...], localisation: str, policy: str) -> LoopOptions:
    from share.config import STREAMED
    from share.lab.robot.faults import parse_fault
    from share.lab.robot.goals import read_goals
    from share.lab.robot.simulate import LoopOptions

    if policy == STREAMED:
        raise UsageError("policy streamed: the robot's agent would not track; give another --policy")
    known = LoopOptions(localisation, policy, faults=tuple(parse_fault(text) for text in faults))
    if not goals.isdecimal():
        return replace(known, goals=tuple(read_goals(Path(goals))))
    if not 1 <= int(goals) <= _MAX_GOALS:
        raise UsageError(f"--goals {goals}: give 1 to {_MAX_GOALS}, or a file")
    return replace(known, count=int(goals))


def _robot(robot_file: Path | None) -> RobotSettings:
    from share.lab.robot.simulate import usual_robot
    from share.robot.robot_file import read_robot

    settings = usual_robot() if robot_file is None else read_robot(robot_file).settings
    return replace(settings, allow_goals=True, agent=None)
