"""Make the sessions of the evaluation: the paper's five motions in two rooms, and agents with recorded
motions.

    python tools/experiments/make_sessions.py --out DIR [--only NAME] [--list]

Names: warehouse-1 to -5 and firestation-1 to -5 (three agents, 60 s, within 9 x 6 m), euroc-v1 and euroc-mh
(two recorded flights in one room), tumvi-rooms (three recorded motions in one room). Existing sessions are
kept; three to eight minutes each on two cores. The last three need recordings (--data), and are left out
without them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from share import startup

startup.prepare_process()

from tool_main import exit_code  # noqa: E402

from share.cli.terminal import Stages  # noqa: E402
from share.lab.emulate.recipe import SessionRecipe  # noqa: E402
from share.lab.emulate.session import make_session  # noqa: E402

_DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "motion"
_D435I = "d435i:640x480@15"
_V1, _MH, _HALL = (11.0, 9.0, 4.5), (14.0, 11.0, 5.0), (10.0, 8.0, 4.0)  # m, large enough for the motions
Size = tuple[float, float, float]


def recipes(data: Path) -> dict[str, SessionRecipe]:
    """Return the recipes by name. data: folder with euroc/NAME and tumvi/NAME."""

    def real(scene: str, seed: int, profile: str, size: Size, **who: str) -> SessionRecipe:
        motions = [f"{name}={path.partition('/')[0]}:{data / path}" for name, path in who.items()]
        return SessionRecipe(scene, tuple(motions), 60.0, seed, size, profiles={"": profile})

    paper = {
        f"{scene}-{k}": SessionRecipe(scene, (f"paper:{k}",), 60.0, 50 + k, profiles={"": _D435I})
        for k in range(1, 6)
        for scene in ("warehouse", "firestation")
    }
    return paper | {
        "euroc-v1": real("firestation", 61, "euroc", _V1, one="euroc/V1_01_easy", two="euroc/V1_02_medium"),
        "euroc-mh": real("warehouse", 62, "euroc", _MH, one="euroc/MH_01_easy", three="euroc/MH_03_medium"),
        "tumvi-rooms": real(
            "warehouse", 63, _D435I, _HALL, ann="tumvi/room1", bob="tumvi/room2", eve="tumvi/room3"
        ),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for the sessions")
    parser.add_argument("--only", action="append", metavar="NAME", help="may be repeated")
    parser.add_argument("--data", type=Path, default=_DATA, help="recordings: euroc/NAME, tumvi/NAME")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--list", action="store_true", help="list names and content")
    options = parser.parse_args()
    known = recipes(options.data.resolve())
    if unknown := [name for name in options.only or () if name not in known]:
        parser.error(f"--only {unknown[0]}: known are {', '.join(known)}")
    if options.out is None and not options.list:
        parser.error("give --out DIR, or --list")
    chosen = {name: recipe for name, recipe in known.items() if name in (options.only or known)}
    return exit_code("make_sessions", lambda: make(chosen, options))


def make(chosen: dict[str, SessionRecipe], options: argparse.Namespace) -> None:
    for name, recipe in chosen.items():
        missing = [folder for folder in recorded(recipe) if not folder.is_dir()]
        if options.list:
            print(f"{name:15} {recipe.scene}, seed {recipe.seed}: {' '.join(recipe.motions)}")
        elif missing and not options.only:
            print(f"{name}: left out: no {missing[0]}; give the folder of recordings by --data")
        elif not (options.out / name).exists():
            print(name, file=sys.stderr)
            with Stages() as stages:
                make_session(recipe, options.out / name, options.workers, stages)


def recorded(recipe: SessionRecipe) -> list[Path]:
    """Return the recordings that its agents use."""
    specs = (motion.partition("=")[2].partition(":") for motion in recipe.motions)
    return [Path(folder) for kind, _, folder in specs if kind in ("euroc", "tumvi")]


if __name__ == "__main__":
    sys.exit(main())
