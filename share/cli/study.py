"""`share study`: plan a study with people by letters, lead it, unblind it at its end, analyse it."""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.commands import CommandGroup
from share.cli.study_judge import judge
from share.cli.study_plan import plan
from share.cli.study_run import run
from share.cli.terminal import print_note
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.study.observations import Observations
    from share.lab.study.plan import SuccessRule
    from share.lab.study.study_analysis import StudyAnalysis


@click.group(cls=CommandGroup, prefix="study ")
def study() -> None:
    """Plan a blind study with people, lead its participants, unblind it at its end, and analyse it.

    \b
    Example:  share study plan --participants 20 --out study
              share study run study
              share study analyze study --out first-look
              share study unblind study --key study-key.json
              share study analyze study --out report
    """


study.add_command(plan)
study.add_command(run)
study.add_command(judge)


@study.command(short_help="Tell the policies behind the letters, once all trials are done.")
@click.argument("folder", metavar="STUDY", type=options.PATH)
@click.option(
    "--key", "key_file", metavar="FILE", required=True, type=options.PATH, help="File of the plan's key."
)
@click.option("--early", is_flag=True, help="Unblind although trials are missing; this is recorded.")
@options.as_json
def unblind(folder: Path, key_file: Path, early: bool, as_json: bool) -> None:
    """Write the policies behind the letters to STUDY/unblinded.json, for `share study analyze`.

    Refused while trials of the plan are missing, since a study is not blind any more then.

    \b
    Example:  share study unblind study --key study-key.json
    """
    from share.files.writing import new_file
    from share.lab.study.plan import UNBLINDED, Unblinding, read_key, read_plan, renamed, unblinding_text
    from share.lab.study.trials import read_trials

    plan = read_plan(folder)
    key = read_key(key_file, plan)
    policies = renamed(plan.letters, key.policies, str(key_file))
    planned = len(plan.participants) * len(plan.letters)
    done = sum(record.is_complete for record in read_trials(folder, plan).values())
    if done < planned and not early:
        raise UsageError(
            f"{folder}: {done} of {planned} trials are done; unblinding now ends the blindness of the "
            "others; finish them, or give --early, which is recorded"
        )
    when = datetime.now(UTC).isoformat(timespec="seconds")
    content = Unblinding(key, when, done, planned, done < planned)
    with new_file(folder / UNBLINDED) as file:
        file.write(unblinding_text(content).encode())
    if as_json:
        click.echo(json.dumps({"policies": policies, "trials_done": done, "trials_planned": planned}))
        return
    for letter, policy in policies.items():
        click.echo(f"{letter}  {policy}")


@study.command(short_help="Compute a study's statistics.")
@click.argument("data", metavar="STUDY|CSV", type=click.Path(path_type=Path, exists=True))
@click.option(
    "--key",
    "key_file",
    metavar="FILE",
    type=options.PATH,
    help="File of the key: policies stand in place of letters.",
)
@click.option(
    "--preferences",
    metavar="FILE",
    type=options.EXISTING_FILE,
    help="With a CSV: a CSV file participant,most,least.",
)
@click.option(
    "--range",
    "ranges",
    multiple=True,
    metavar="NAME=LOW:HIGH",
    help="With a CSV: the range of a measure, beyond which a value is an error. May be repeated.",
)
@click.option(
    "--distance", type=options.NumberRange(0.01, 100), help=f"{options.DISTANCE}  [default: the plan's]"
)
@click.option(
    "--timeout", type=options.NumberRange(0.1, 3600), help=f"{options.TIMEOUT}  [default: the plan's]"
)
@click.option("--out", metavar="DIR", type=options.PATH, help="Folder for the report.")
@options.as_json
def analyze(
    data: Path,
    key_file: Path | None,
    preferences: Path | None,
    ranges: tuple[str, ...],
    distance: float | None,
    timeout: float | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Compute the statistics of a study: of STUDY, a folder by `share study plan`, or of a CSV file with
    participant, condition, place (its number in the participant's order) and a column for each measure.

    By letters, until `share study unblind` or with --key. DIR gets report.html (opens offline), report.md,
    descriptives.csv, tests.csv, pairs.csv, tables.tex (LaTeX), study.png, preferences.png.

    \b
    Example:  share study analyze study --out report
              share study analyze ratings.csv --range rating=1:10 --out report
    """
    from share.files.json_file import nan_to_none
    from share.files.writing import writable_dir
    from share.lab.study.study_analysis import analyse
    from share.lab.study.study_report import FILES, write_report
    from share.lab.study.study_tables import coverage_lines, rule_line

    if out is not None:
        writable_dir(out, *FILES)
    if data.is_dir():
        _refuse(preferences is not None or bool(ranges), "--preferences and --range are for a CSV file")
        table, rule = _study_table(data, key_file, distance, timeout)
    else:
        _refuse(
            distance is not None or timeout is not None, "--distance, --timeout: only with a study's folder"
        )
        table, rule = _csv_table(data, key_file, preferences, ranges), None
    found = analyse(table)
    files = [] if out is None else write_report(found, table, rule, out)
    if as_json:
        success = None if rule is None else asdict(rule)
        click.echo(json.dumps(nan_to_none({"success": success} | asdict(found))))
        return
    for line in [*coverage_lines(found), *([] if rule is None else [rule_line(rule)])]:
        click.echo(f"* {line}")
    _print_tables(found)
    if files:
        click.echo(f"report: {', '.join(map(str, files))}")


def _print_tables(found: StudyAnalysis) -> None:
    from share.cli.terminal import aligned_table
    from share.lab.study.study_tables import choice_rows, differing_rows, order_rows, overview_rows

    differing = differing_rows(found)
    compared = sum(len(measure.pairs) for measure in found.measures)
    for title, rows in (
        ("means and tests", overview_rows(found)),
        (f"pairs with Holm's p below 0.05: {len(differing) - 1} of {compared}", differing),
        ("order and learning", order_rows(found)),
        ("preferences", choice_rows(found)),
    ):
        if len(rows) > 1:
            click.echo(f"\n{title}\n{aligned_table(rows)}")
    click.echo()


def _refuse(is_wrong: bool, text: str) -> None:
    if is_wrong:
        raise UsageError(text)


def _study_table(
    folder: Path, key_file: Path | None, distance: float | None, timeout: float | None
) -> tuple[Observations, SuccessRule]:
    from share.lab.study.observations import read_study
    from share.lab.study.plan import SuccessRule, read_key, read_plan, read_unblinding, renamed

    plan = read_plan(folder)
    rule = SuccessRule(distance or plan.success.distance_m, timeout or plan.success.timeout_s)
    table = read_study(folder, plan, rule)
    unblinding = read_unblinding(folder, plan)
    if unblinding is not None:
        if unblinding.early:
            early = f"unblinded early, with {unblinding.done} of {unblinding.planned} trials done"
            print_note(str(folder), early)
            table = table.with_note(early)
        return table.named(renamed(plan.letters, unblinding.key.policies, str(folder))), rule
    if key_file is None:
        return table, rule
    policies = renamed(plan.letters, read_key(key_file, plan).policies, str(key_file))
    if table.done < table.planned:
        raise UsageError(
            f"--key: {table.done} of {table.planned} trials are done, and the study is blind; leave --key "
            "out for statistics by letters, or end its blindness with `share study unblind --early`"
        )
    return table.named(policies), rule


def _csv_table(
    path: Path, key_file: Path | None, preferences: Path | None, ranges: tuple[str, ...]
) -> Observations:
    from share.lab.study.observations import read_table
    from share.lab.study.plan import read_key, renamed

    limits = {}
    for text in ranges:
        match = re.fullmatch(r"(.+)=(-?[\d.]+):(-?[\d.]+)", text)
        if match is None or not _float(match[2]) < _float(match[3]):
            raise UsageError(f"--range '{text}' is not NAME=LOW:HIGH, such as rating=1:10")
        limits[match[1]] = _float(match[2]), _float(match[3])
    table = read_table(path, limits, preferences)
    if key_file is None:
        return table
    return table.named(renamed(table.conditions, read_key(key_file, None).policies, str(key_file)))


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
