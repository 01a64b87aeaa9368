"""Sequences x seeds for measuring trackers: one agent, all sensor effects.

Also the options of the tools that run over them, and the cache of a run's figures.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import share
from share.errors import UsageError
from share.files.writing import atomic_write
from share.lab.emulate.recipe import SessionRecipe
from share.recordings import tables
from share.recordings.trajectory import format_tum, make_trajectory

_D435I = "d435i:640x480@30"


@dataclass(frozen=True)
class Sequence:
    """motion: `walk:`, `robot:`, or `euroc:NAME`, `tumvi:NAME`, `tum:FILE` of a recording in the folder of
    recordings; `tum:` is a table of poses, with a simulated IMU. size: of the room, m; None: the scene's
    default. sensors: "" for the motion's usual ones."""

    name: str
    motion: str
    scene: str
    profile: str
    sensors: str = ""
    size: tuple[float, float, float] | None = None

    def recording(self, data: Path) -> Path | None:
        """Return its recording's folder or file in `data`, None for a simulated motion."""
        kind, _, name = self.motion.partition(":")
        if not name:
            return None
        return data / name if kind == "tum" else data / kind / name

    def recipe(self, seed: int, options: argparse.Namespace) -> SessionRecipe:
        """Return the recipe with `seed`; options: data, seconds and hz of `parser`."""
        kind, recording = self.motion.partition(":")[0], self.recording(options.data)
        if recording is not None and kind == "tum":
            recording = _as_tum(recording)
        motion = self.motion if recording is None else f"{kind}:{recording}"
        profile = self.profile
        if options.hz is not None and "@" in profile:
            profile = f"{profile.partition('@')[0]}@{options.hz}"
        sensors = {"": self.sensors} if self.sensors else {}
        return SessionRecipe(
            self.scene, (f"agent={motion}",), options.seconds, seed, self.size, sensors, {"": profile}
        )


def _as_tum(table: Path) -> Path:
    """Return a TUM file, in build/, of a table of poses: time (ns), position, quaternion with w first."""
    out = ROOT / "build" / "motions" / f"{table.stem}.tum"
    out.parent.mkdir(parents=True, exist_ok=True)
    stamps_ns, values = tables.read_table(table, 8)
    poses = make_trajectory(stamps_ns, values[:, :3], values[:, [4, 5, 6, 3]], table, None)
    atomic_write(out, format_tum(poses))
    return out


SEQUENCES = (
    Sequence("walk-warehouse", "walk:", "warehouse", _D435I),
    Sequence("walk-firestation", "walk:", "firestation", "d435i:848x480@30"),
    Sequence("robot-warehouse", "robot:", "warehouse", _D435I, sensors="stereo"),
    Sequence("euroc-V1_01", "euroc:V1_01_easy", "warehouse", "euroc"),
    Sequence("euroc-V1_02", "euroc:V1_02_medium", "firestation", "euroc"),
    Sequence("euroc-MH_03", "euroc:MH_03_medium", "warehouse", "euroc", size=(10.0, 9.5, 4.5)),
    Sequence("euroc-MH_01", "euroc:MH_01_easy", "warehouse", "euroc", size=(10.0, 9.5, 4.5)),
    Sequence("tumvi-room1", "tumvi:room1", "warehouse", _D435I),
    Sequence("tumvi-room2", "tumvi:room2", "firestation", _D435I),
    Sequence("tumvi-room3", "tumvi:room3", "warehouse", _D435I),
    Sequence("table_01", "tum:rpng_plane/table_01.csv", "warehouse", _D435I),
    Sequence("table_02", "tum:rpng_plane/table_02.csv", "firestation", _D435I),
)


ROOT = Path(__file__).resolve().parents[2]
_DATA = ROOT.parent / "shared" / "data" / "motion"


def parser(doc: str | None, out: str, seeds: tuple[int, ...]) -> argparse.ArgumentParser:
    """Return a parser. out: name of the folder in build/; seeds: the default."""
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawTextHelpFormatter)
    names = [sequence.name for sequence in SEQUENCES]
    made.add_argument("--only", action="append", choices=names, help="may be repeated")
    made.add_argument("--seeds", type=_seeds, default=seeds, metavar="N,N,…")
    made.add_argument("--seconds", type=float, default=60.0)
    made.add_argument("--hz", type=int, help="frame rate of the D435i, in place of 30")
    made.add_argument("--data", type=_folder, default=_DATA, help="recordings: euroc/NAME, tumvi/NAME, …")
    made.add_argument("--cache", type=Path, help="of sessions (default: the user's)")
    made.add_argument("--out", type=Path, default=ROOT / "build" / out)
    made.add_argument("--workers", type=int, default=2, help="processes that make sessions")
    made.add_argument("--again", action="store_true", help="repeat runs that exist")
    return made


def chosen_sequences(options: argparse.Namespace) -> list[Sequence]:
    """Return the chosen sequences with recordings; report the others. Raises UsageError without any."""
    found = list(_there(options))
    if not found:
        raise UsageError("none of the recordings exists; give their folder by --data")
    return found


def _there(options: argparse.Namespace) -> Iterator[Sequence]:
    for sequence in SEQUENCES:
        if options.only and sequence.name not in options.only:
            continue
        folder = sequence.recording(options.data)
        if folder is None or folder.exists():
            yield sequence
        else:
            print(f"left out: {sequence.name}, {folder} does not exist", file=sys.stderr)


def _folder(text: str) -> Path:
    return Path(text).resolve()


def _seeds(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a list of numbers such as 101,102") from None


_NOT_IN_A_RUN = (
    "cli",
    "headset",
    "lab",
    "mapping",
    "net",
    "robot",
    "store",
    "view",
    "wire",
)  # packages of share/


def code_version() -> str:
    """Return a digest of all code that a run uses."""
    digest = hashlib.sha256()
    package = Path(share.__file__).parent
    files = [p for p in package.rglob("*.py") if p.relative_to(package).parts[0] not in _NOT_IN_A_RUN]
    for path in sorted(files) + sorted(Path(__file__).parent.glob("vio_run.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def kept(file: Path, made_by: dict[str, Any]) -> dict[str, Any] | None:
    """Return the file's figures if they were made by the same code and session, else None."""
    row: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    return row if {key: row.get(key) for key in made_by} == made_by else None


def keep(file: Path, row: dict[str, Any]) -> None:
    atomic_write(file, json.dumps(row, indent=2) + "\n")
