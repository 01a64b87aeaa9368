"""`share study plan`: draw orders, spots and letters of a study."""

from __future__ import annotations

import json
import math
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.config import POLICY_NAMES, STREAMED
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.study.plan import StudyPlan


class _Numbers(click.ParamType[tuple[float, ...]]):
    """Two numbers with a character between them."""

    def __init__(self, separator: str, example: str) -> None:
        self.name, self._separator, self._example = "numbers", separator, example

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            a, b = (float(part) for part in value.split(self._separator))
        except ValueError:
            a = b = math.nan
        if not all(abs(number) <= 1000 for number in (a, b)):
            self.fail(f"'{value}' is not two numbers such as {self._example}", param, ctx)
        return a, b


@click.command(short_help="Draw a plan: orders, spots, letters; and its key.")
@click.option("--participants", type=click.IntRange(1, 1000), default=20, help="Number of participants.")
@click.option(
    "--policy",
    "policies",
    multiple=True,
    type=click.Choice([name for name in POLICY_NAMES if name != STREAMED]),  # that builds no map
    help="A condition. May be repeated: 2 to 8.  [default: the paper's: share, covins-g, linear, equal]",
)
@click.option(
    "--space", type=_Numbers("x", "4x4"), default="4x4", metavar="WxD", help="Size of the floor, m."
)
@click.option(
    "--corner",
    type=_Numbers(",", "-2,-2"),
    default="0,0",
    metavar="X,Y",
    help="Least x and y of the floor, m.",
)
@click.option("--spots", type=click.IntRange(1, 200), default=10, help="Number of spots to draw.")
@click.option(
    "--margin",
    type=options.NumberRange(0, 100),
    default=0.5,
    help="Least distance of spots from the floor's edge, m.",
)
@click.option(
    "--apart",
    type=options.NumberRange(0, 100),
    default=0.8,
    help="Least distance of spots from each other, m.",
)
@click.option(
    "--spots-file",
    metavar="FILE",
    type=options.EXISTING_FILE,
    help="Spots of your own: CSV x,y or YAML `spots`.",
)
@click.option(
    "--path-file",
    metavar="FILE",
    type=options.EXISTING_FILE,
    help="The researcher's path: CSV x,y or YAML `path`.  [default: a loop within the margin]",
)
@click.option(
    "--questions", metavar="FILE", type=options.EXISTING_FILE, help="Questions of your own, YAML `questions`."
)
@click.option("--distance", type=options.NumberRange(0.01, 100), default=0.5, help=options.DISTANCE)
@click.option("--timeout", type=options.NumberRange(0.1, 3600), default=30.0, help=options.TIMEOUT)
@click.option(
    "--seed",
    type=click.IntRange(0, 2**63),
    help="Seed of spots and orders, not of letters.  [default: drawn]",
)
@click.option(
    "--key", "key_file", metavar="FILE", type=options.PATH, help="File of the key.  [default: DIR-key.json]"
)
@options.out_folder
@options.as_json
@options.explain_policies
def plan(
    participants: int,
    policies: tuple[str, ...],
    space: tuple[float, float],
    corner: tuple[float, float],
    spots: int,
    margin: float,
    apart: float,
    spots_file: Path | None,
    path_file: Path | None,
    questions: Path | None,
    distance: float,
    timeout: float,
    seed: int | None,
    key_file: Path | None,
    out: Path,
    as_json: bool,
) -> None:
    """Draw who meets which condition when, by letters, and write the key to the letters to a file apart.

    Orders are balanced for place and carry-over; each trial has an order of its spots of its own. DIR gets
    plan.json and floor.png, a picture of spots and path. Whoever is to stay blind must not see the key.
    --seed draws the same spots and orders again, never the same letters: these are drawn by a secret of the
    key. Nothing is ever overwritten.

    \b
    Example:  share study plan --participants 20 --out study
    """
    import numpy as np

    from share.lab.study.floor_plan import FLOOR_PICTURE, walk_line
    from share.lab.study.plan import (
        PAPER_POLICIES,
        PLAN,
        QUESTIONS,
        PlanWishes,
        SuccessRule,
        draw_plan,
        read_questions,
    )
    from share.lab.study.spots import Space, draw_spots, loop_path, read_points

    floor = Space(*space, *corner)
    if min(space) <= 0:
        raise UsageError(f"--space {space[0]:g}x{space[1]:g}: both must be positive")
    plan_path, key_path = out / PLAN, key_file or out.with_name(f"{out.name}-key.json")
    for path in (plan_path, key_path, out / FLOOR_PICTURE):
        if path.exists():
            raise UsageError(f"{path}: exists and is not overwritten; give a new --out or --key")
    if key_path.resolve().is_relative_to(out.resolve()):
        raise UsageError(f"--key {key_path}: lies beside the plan; give a name outside of {out}")
    drawn_seed = secrets.randbits(63) if seed is None else seed
    wishes = PlanWishes(
        participants,
        policies or PAPER_POLICIES,
        draw_spots(floor, spots, margin, apart, np.random.default_rng([drawn_seed, 1]))
        if spots_file is None
        else read_points(spots_file, "spots", 1, floor),
        loop_path(floor, margin) if path_file is None else read_points(path_file, "path", 2, floor),
        SuccessRule(distance, timeout),
        QUESTIONS if questions is None else read_questions(questions),
    )
    drawn, key = draw_plan(wishes, drawn_seed, secrets.token_hex(16))
    _write_plan(plan_path, key_path, drawn, key.text())
    if as_json:
        files = {"plan": plan_path, "picture": out / FLOOR_PICTURE, "key": key_path}
        click.echo(json.dumps({"seed": drawn_seed} | {name: str(file) for name, file in files.items()}))
        return
    for line in drawn.balance.lines(list(drawn.letters)):
        click.echo(line)
    click.echo(walk_line(drawn))
    click.echo(
        f"plan: {plan_path} (letters only); spots and path: {out / FLOOR_PICTURE}; key: {key_path} (give it "
        "to somebody who is not in the room)"
    )


def _write_plan(plan_path: Path, key_path: Path, plan: StudyPlan, key_text: str) -> None:
    """Write both files and the picture of the floor, or none."""
    from share.files.writing import check_writable, new_file, write_private
    from share.lab.study.floor_plan import FLOOR_PICTURE, draw_floor
    from share.lab.study.plan import plan_text

    check_writable(plan_path)
    picture = plan_path.with_name(FLOOR_PICTURE)
    write_private(check_writable(key_path), key_text)
    try:
        draw_floor(picture, plan)
        with new_file(plan_path) as file:
            file.write(plan_text(plan).encode())
    except BaseException:
        for ours in (key_path, picture):  # of a plan that does not exist
            ours.unlink(missing_ok=True)
        raise
