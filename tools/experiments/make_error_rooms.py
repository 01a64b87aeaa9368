"""Make sessions to train the error model on: many, short, and varied.

    python tools/experiments/make_error_rooms.py --out DIR [--rooms 60] [--first 0] [--seconds 30] \\
        [--sensors stereo]
    share train labels DIR/* --runs 6 --out labels

Room N is deterministic: a scene, its seed, two agents (slow or fast people, robots) and, in every second
room, lamps that switch; rgbd-N is the same room with depth cameras. A minute or two each on two cores;
existing sessions are kept.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from tool_main import exit_code  # noqa: E402

from share.cli.terminal import Stages  # noqa: E402
from share.lab.emulate.recipe import SessionRecipe  # noqa: E402
from share.lab.emulate.sensor.effects import Effects  # noqa: E402
from share.lab.emulate.session import make_session  # noqa: E402

_SEED = 20261123
_SCENES = ("warehouse", "firestation", "warehouse", "firestation", "whitewall")
_PROFILE = {"": "d435i:640x480@15"}
_PREFIX = {"stereo": "room", "rgbd": "rgbd"}


def recipe(number: int, seconds: float, sensors: str) -> SessionRecipe:
    """Return the recipe of room `number`."""
    rng = np.random.default_rng((_SEED, number))
    first = f"ann={_person(rng)}"
    second = f"robot=robot:speed={rng.uniform(0.2, 0.7):.2f}" if number % 3 == 2 else f"bob={_person(rng)}"
    lamps = rng.uniform(4, 10), rng.uniform(1, 4)
    effects = (
        Effects(lamp_every_s=round(lamps[0], 1), lamp_stops=round(lamps[1], 1)) if number % 2 else Effects()
    )
    scene, seed = _SCENES[number % len(_SCENES)], 10_000 + number
    return SessionRecipe(scene, (first, second), seconds, seed, None, {"": sensors}, _PROFILE, effects)


def _person(rng: np.random.Generator) -> str:
    speed, pauses, turns = rng.uniform(0.3, 1.5), rng.uniform(0, 6), rng.uniform(1.2, 3)
    return f"walk:speed={speed:.2f},pauses={pauses:.1f},turns={turns:.2f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rooms", type=int, default=60)
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--sensors", choices=("stereo", "rgbd"), default="stereo")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    return exit_code("make_error_rooms", lambda: make(options))


def make(options: argparse.Namespace) -> None:
    for number in range(options.first, options.first + options.rooms):
        out = options.out / f"{_PREFIX[options.sensors]}-{number:03d}"
        if not out.exists():
            print(out.name, file=sys.stderr, flush=True)
            with Stages() as stages:
                make_session(recipe(number, options.seconds, options.sensors), out, options.workers, stages)


if __name__ == "__main__":
    sys.exit(main())
