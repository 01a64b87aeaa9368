"""`share dataset forget`: delete agents' keyframes, or old ones, from an edge's map for good."""

from __future__ import annotations

import json
import re
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.terminal import Stages, print_note
from share.errors import ShareError, UsageError

if TYPE_CHECKING:
    from share.store.forgetting import ForgettingReport

_UNIT_S = {"d": 86_400.0, "h": 3600.0}


class _Age(click.ParamType[float]):
    name = "AGE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        found = re.fullmatch(r"(\d+(?:\.\d+)?)([dh])", str(value))
        if found is None:
            self.fail(f"'{value}' is not an age such as 30d or 12h")
        return float(found[1]) * _UNIT_S[found[2]]


@click.command(short_help="Delete agents or old keyframes from a map for good.")
@click.argument("map_file", metavar="MAP", type=options.PATH)
@click.option("--agent", "agents", multiple=True, metavar="NAME", help="Delete this agent. May be repeated.")
@click.option(
    "--older-than",
    "age_s",
    type=_Age(),
    help="Delete what came earlier: 30d, 12h. With --agent: only what that agent sent earlier.",
)
@click.option("--yes", is_flag=True, help="Do not ask.")
@options.as_json
def forget(map_file: Path, agents: tuple[str, ...], age_s: float | None, yes: bool, as_json: bool) -> None:
    """Delete keyframes from an edge's map for good: images, features, poses, loops, and names of agents of
    which nothing is left. The edge must not be running.

    The file is rewritten, so nothing of them stays in it or in its log. Loops between the others stay. What
    only the deleted keyframes connected becomes several maps; each stays where it was, and new keyframes join
    them again.

    \b
    Example:  share dataset forget room.sqlite --agent ann
              share dataset forget room.sqlite --older-than 30d --yes
    """
    if not agents and age_s is None:
        raise UsageError("nothing to forget: give --agent NAME or --older-than AGE")
    from share.store.forgetting import Forgetting
    from share.store.map_store import MapStore

    if not map_file.is_file():
        raise UsageError(f"{map_file}: no such file")
    before_s = None if age_s is None else time.time() - age_s
    with ExitStack() as stack:
        with Stages() as stages:
            stages("reading the map", 0, 1)
            store = stack.enter_context(MapStore.open(map_file))
            for complaint in store.problems:
                print_note(str(map_file), complaint)
            stages("planning", 0, 1)
            plan = Forgetting(store, agents or None, before_s)
        if plan.report.deleted_keyframes:
            _confirm(map_file, plan.report, yes)
        with Stages() as stages:
            stages("deleting", 0, 1)
            plan.carry_out()
            stages("deleting", 1, 1)
    click.echo(json.dumps(plan.report.to_mapping()) if as_json else _report_text(map_file, plan.report))


def _confirm(map_file: Path, report: ForgettingReport, yes: bool) -> None:
    if yes:
        return
    question = f"{map_file}: delete {_deleted_text(report)} for good?"
    if not _can_ask():
        raise UsageError(f"{question} stdin is not a terminal; add --yes")
    if not click.confirm(question, err=True):
        raise ShareError(f"{map_file}: nothing was deleted")


def _can_ask() -> bool:
    return sys.stdin.isatty()


def _deleted_text(report: ForgettingReport) -> str:
    agents = ", ".join(f"{name} {count}" for name, count in report.deleted_agents.items())
    images = f"{report.image_bytes / 1e6:.1f} MB of images"
    return f"{report.deleted_keyframes} keyframes ({agents}; {images}) and {report.deleted_loops} loops"


def _report_text(map_file: Path, report: ForgettingReport) -> str:
    if not report.deleted_keyframes:
        lines = [f"{map_file}: nothing to delete; {report.left_keyframes} keyframes stay"]
    else:
        agents = ", ".join(f"{name} {count}" for name, count in report.left_agents.items()) or "none"
        lines = [
            f"{map_file}: deleted {_deleted_text(report)}",
            f"  stay: {report.left_keyframes} keyframes ({agents}) and {report.left_loops} loops",
        ]
    lines += [f"  map {name}: {count} keyframes" for name, count in report.left_maps.items()]
    if len(report.left_maps) > report.earlier_maps:
        lines.append("  more maps than before: only what was deleted connected them; new keyframes join them")
    lines += [f"  {path} still holds all of it: delete it too" for path in report.copies]
    return "\n".join(lines)
