"""`share study judge`: judge a trial by motion capture in place of the map."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.terminal import aligned_table
from share.errors import DataError, UsageError

if TYPE_CHECKING:
    from share.lab.mocap.trajectory import MocapTrajectory
    from share.lab.study.plan import StudyPlan
    from share.lab.study.trials import TrialRecord
    from share.robot.planar import PlanarPose

_FAR_M = 0.5  # robot by the map and by the motion capture, at the median: the floor is likely wrong


@click.command(short_help="Judge a trial by motion capture in place of the map.")
@click.argument("folder", metavar="STUDY", type=options.PATH)
@click.argument("trial", metavar="TRIAL")
@click.option(
    "--mocap",
    "mocap_file",
    metavar="FILE",
    required=True,
    type=options.EXISTING_FILE,
    help="Vicon's or Motive's CSV, TUM, or CSV with t[ns], x y z, qw qx qy qz.",
)
@click.option("--body", metavar="BODY", help="Rigid body of the robot.  [default: robot, or the only one]")
@click.option(
    "--floor",
    required=True,
    metavar="BODY|X,Y,DEG",
    help="Where the floor's marker is: a rigid body there, or its place and heading with z up.",
)
@click.option("--up", type=click.Choice(["z", "y"]), default="z", help="Up axis of the file, z or y.")
@click.option(
    "--zero",
    metavar="UTC",
    help="Time at which the motion capture's clock was 0, such as 2026-11-28T10:03:12.34.  "
    "[default: found by the robot's motion]",
)
@options.rotations
@options.as_json
def judge(
    folder: Path,
    trial: str,
    mocap_file: Path,
    body: str | None,
    floor: str,
    up: str,
    zero: str | None,
    rotations: str,
    as_json: bool,
) -> None:
    """Judge TRIAL (such as p01-2) of STUDY by a motion capture of the robot.

    Put the body's pivot above the middle of the robot. The clocks need not agree: when the robot drives and
    stands tells the offset. Cubes count as lying at their planned spots; first motion, standstills, way and
    distances are the motion capture's. The trial's events.jsonl is replaced; what the map said is kept beside
    it, in events-map.jsonl, from which judging again begins.

    \b
    Example:  share study judge study p01-2 --mocap take7.csv --body Robot --floor FloorMarker --up y
    """
    import json

    from share.files.json_file import nan_to_none, own_format_errors, read_json_lines
    from share.files.writing import atomic_write
    from share.lab.mocap.files import pick_body, read_bodies
    from share.lab.study.mocap_judge import ClockMatch, RobotTrack, judged, match_clocks
    from share.lab.study.plan import read_plan
    from share.lab.study.trials import EVENTS_BY_MAP, MAX_LINES_BYTES, read_trial

    plan = read_plan(folder)
    planned, path = _planned_trial(folder, plan, trial)
    kept = path.with_name(EVENTS_BY_MAP)
    source, before = _judged_by_map(plan, planned, path, kept)
    events = read_json_lines(source, MAX_LINES_BYTES)
    bodies = read_bodies(mocap_file, rotations)
    _, mocap = pick_body(str(mocap_file), bodies, body, "robot", "--body")
    track = RobotTrack.of(mocap, _floor(str(mocap_file), bodies, floor, up), up)
    try:
        with own_format_errors(source):
            clock = (
                match_clocks(track, events) if zero is None else ClockMatch(_utc_s(zero), math.nan, math.nan)
            )
            lines = judged(events, plan, track, clock.zero_utc_s)
    except DataError as error:
        raise DataError(f"{mocap_file}: {error}") from None
    apart = _apart_m(lines)
    apart_m = sorted(apart.values())[len(apart) // 2] if apart else 0.0
    if apart_m > _FAR_M and zero is None:
        raise UsageError(
            f"map and motion capture have the robot {apart_m:.2f} m apart at most calls: is it this trial's "
            "take, and are --floor, --up and --body right? If the map was so wrong, give --zero"
        )
    if not kept.exists():
        atomic_write(kept, _content(path))
    atomic_write(path, "".join(json.dumps(line, allow_nan=False) + "\n" for line in lines))
    goals = _goals(before, read_trial(path, plan, *planned), plan, apart)
    when = datetime.fromtimestamp(clock.zero_utc_s, UTC).isoformat(timespec="milliseconds")[:-6]
    if as_json:
        fields = {"events": str(path), "events_by_map": str(kept), "zero_utc": when, "goals": goals}
        match = {"agreement": clock.agreement, "next_agreement": clock.next_agreement}
        click.echo(json.dumps(nan_to_none(fields | match)))
        return
    if zero is None:
        click.echo(
            f"its clock was 0 at {when} UTC (--zero for other trials of this take); driving and standing "
            f"agree to {clock.agreement:.2f}, at the next best time to {clock.next_agreement:.2f}"
        )
    click.echo(_goal_table(goals))
    click.echo(f"{path}: judged by motion capture; what the map said: {kept}")


def _judged_by_map(
    plan: StudyPlan, planned: tuple[str, int, str], path: Path, kept: Path
) -> tuple[Path, TrialRecord]:
    """Return the file with what the map said of a trial that was carried through, and its record. Raises
    UsageError, DataError."""
    from share.lab.study.trials import read_trial

    source, record = path, read_trial(path, plan, *planned)
    if record.judge == "mocap" and kept.exists():
        source, record = kept, read_trial(kept, plan, *planned)
    elif record.judge == "map" and kept.exists() and _content(kept) != _content(path):
        raise UsageError(f"{kept}: is of another trial than {path.name}; move it away")
    if record.is_left or not record.is_complete:
        raise UsageError(f"{path.parent.name}: was not carried through, so it counts in no statistics")
    if record.judge != "map":
        raise UsageError(f"{source}: is judged by {record.judge}, and there is no {kept.name}")
    return source, record


def _content(path: Path) -> bytes:
    from share.files.reading import read_bytes, read_errors
    from share.lab.study.trials import MAX_LINES_BYTES

    with read_errors(path):
        return read_bytes(path, MAX_LINES_BYTES)


def _planned_trial(folder: Path, plan: StudyPlan, trial: str) -> tuple[tuple[str, int, str], Path]:
    """Return participant, place and condition of a trial, and its events. Raises UsageError."""
    from share.lab.study.trials import EVENTS, planned_trials, trial_folder

    planned = planned_trials(plan).get(trial)
    if planned is None:
        raise UsageError(f"{trial}: the plan has no such trial; they are named p01-1, p01-2 and so on")
    path = trial_folder(folder, *planned[:2]) / EVENTS
    if not path.exists():
        raise UsageError(f"{path}: there is none; the trial was not run")
    return planned, path


def _floor(file: str, bodies: Mapping[str, MocapTrajectory | None], text: str, up: str) -> PlanarPose:
    """Return where the floor's marker is in the world with z up. Raises UsageError."""
    from share.lab.mocap.files import pick_body
    from share.lab.study.mocap_judge import floor_in_world
    from share.robot.planar import PlanarPose

    if text.lower() in (name.lower() for name in bodies):
        _, marker = pick_body(file, bodies, text, "floor", "--floor")
        return floor_in_world(marker.T[len(marker.T) // 2], up)
    try:
        x, y, deg = (float(part) for part in text.split(","))
    except ValueError:
        x = y = deg = math.nan
    if not max(abs(x), abs(y), abs(deg)) <= 1e4:
        listed = ", ".join(name for name in bodies if name) or "none with a name"
        raise UsageError(f"--floor {text}: neither X,Y,DEG nor a body of {file}; it has {listed}")
    return PlanarPose(x, y, math.radians(deg))


def _goals(
    before: TrialRecord, after: TrialRecord, plan: StudyPlan, apart: Mapping[int, float]
) -> list[dict[str, Any]]:
    """Return each goal as the map and as the motion capture have it. apart: see `_apart_m`."""
    goals = []
    for number, goal in sorted(after.goals.items()):
        row: dict[str, Any] = {"goal": number, "spot": goal.spot, "apart_m": apart.get(number)}
        for judge_name, record in (("map", before), ("mocap", after)):
            one = record.goals[number]
            reached_s = one.reached_s(plan.success)
            row[f"reached_s_{judge_name}"] = None if math.isnan(reached_s) else reached_s
            row[f"distance_m_{judge_name}"] = one.stops[-1].distance_m if one.stops else None
        goals.append(row)
    return goals


_COLUMNS = (
    "goal",
    "spot",
    "reached after, s: by the map",
    "by motion capture",
    "final distance, m",
    "",
    "apart, m",
)


def _goal_table(goals: Sequence[Mapping[str, Any]]) -> str:
    rows = [list(_COLUMNS)]
    for one in goals:
        times = [_number(one[name], "no") for name in ("reached_s_map", "reached_s_mocap")]
        lengths = [_number(one[name]) for name in ("distance_m_map", "distance_m_mocap", "apart_m")]
        rows.append([str(one["goal"]), str(one["spot"]), *times, *lengths])
    return aligned_table(rows)


def _apart_m(lines: Sequence[Mapping[str, Any]]) -> dict[int, float]:
    """Return how far apart map and motion capture have the robot at the calls, by goal."""
    return {
        line["goal"]: math.dist(line["robot_m"], line["robot_by_map_m"])
        for line in lines
        if line["event"] == "call" and line["robot_by_map_m"] is not None
    }


def _utc_s(text: str) -> float:
    """Return a UTC time, s since 1970. Raises UsageError."""
    from share.lab.study.mocap_judge import utc_s

    try:
        return utc_s(text)
    except (ValueError, OverflowError):
        raise UsageError(f"--zero {text:.40}: is not a UTC time such as 2026-11-28T10:03:12.34") from None


def _number(value: float | None, missing: str = "") -> str:
    return missing if value is None else f"{value:.2f}"
