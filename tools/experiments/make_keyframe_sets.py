"""Make sets of keyframes for `keyframe_set` in the user's cache; existing ones are kept.

    python tools/experiments/make_keyframe_sets.py --scene corridor-twins --motion walk: --motion walk: \\
        --seeds 0:200 --seconds 40 --spacing-m 0.3 --spacing-rad 0.35

Prints a line a seed: keyframes of each agent, seconds taken, file. Seeds that cannot be planned are reported
and left out.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from share import startup

startup.prepare_process()

from keyframe_set import KeyframeSet, Spacing, keyframe_set, place  # noqa: E402
from tool_main import exit_code  # noqa: E402

from share.cli.terminal import Stages  # noqa: E402
from share.errors import UsageError  # noqa: E402
from share.lab.emulate.recipe import SessionRecipe  # noqa: E402
from share.lab.emulate.stage import make_layout  # noqa: E402

NAME = "make_keyframe_sets"


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    return exit_code(NAME, lambda: make_all(options))


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    made.add_argument("--scene", required=True)
    made.add_argument(
        "--motion", action="append", required=True, metavar="[NAME=]SPEC", help="may be repeated"
    )
    made.add_argument("--seeds", type=seeds_of, default=range(1), metavar="FIRST:END", help="END is left out")
    made.add_argument("--seconds", type=float, default=40.0)
    made.add_argument("--size", type=_size, metavar="LxWxH", help="m (default: the scene's)")
    made.add_argument("--profile", metavar="PROFILE[:MODE]", help="(default: d435i)")
    usual = Spacing()
    made.add_argument("--spacing-m", type=float, default=usual.metres, help="between keyframes")
    made.add_argument("--spacing-rad", type=float, default=usual.radians)
    made.add_argument("--cache", type=Path, help="(default: the user's)")
    made.add_argument("--workers", type=int, default=1, help="processes that draw")
    return made


def make_all(options: argparse.Namespace) -> None:
    """Make all sets. Raises ShareError, except for seeds whose room has no place for the motions."""
    # an unknown scene is an error of its own, not of each seed
    make_layout(recipe_of(options, options.seeds[0]))
    if sum(one(options, seed) for seed in options.seeds) == 0:
        raise UsageError("no set could be made; the lines above say why")


def one(options: argparse.Namespace, seed: int) -> bool:
    """Return whether this seed's set could be made."""
    every, recipe = Spacing(options.spacing_m, options.spacing_rad), recipe_of(options, seed)
    path, began = place(recipe, every, options.cache), time.perf_counter()
    was_there = path.exists()
    try:
        with Stages() as stages:
            made = keyframe_set(recipe, every, options.cache, options.workers, stages)
    except UsageError as error:
        print(f"{recipe.scene} {seed}: left out: {error}", flush=True)
        return False
    took = "was there" if was_there else f"{time.perf_counter() - began:.1f} s"
    print(f"{line(made)}  {took}  {path}", flush=True)
    return True


def recipe_of(options: argparse.Namespace, seed: int) -> SessionRecipe:
    profiles = {"": options.profile} if options.profile else {}
    motions = tuple(options.motion)
    return SessionRecipe(options.scene, motions, options.seconds, seed, options.size, profiles=profiles)


def line(made: KeyframeSet) -> str:
    counts = "  ".join(f"{name} {len(agent.keyframes)}" for name, agent in made.agents.items())
    return f"{made.recipe.scene} {made.recipe.seed}:  {counts}"


def seeds_of(text: str) -> range:
    found = re.fullmatch(r"(\d+):(\d+)", text)
    if not found or int(found[1]) >= int(found[2]):
        raise argparse.ArgumentTypeError(f"'{text}' is not FIRST:END, such as 0:200")
    return range(int(found[1]), int(found[2]))


def _size(text: str) -> tuple[float, ...]:
    try:
        x, y, z = (float(word) for word in text.split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a size in metres such as 18x8x2.9") from None
    return x, y, z


if __name__ == "__main__":
    sys.exit(main())
