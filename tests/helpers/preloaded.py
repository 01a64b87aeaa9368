"""Faults of the machine under a process of ours: a few lines of C that it is started with (LD_PRELOAD).

Each answers the environment that a process is to be started with, and is told what to do while it runs.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def built(name: str, folder: Path) -> Path:
    """The library of NAME.c. Skips where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler")
    library = folder / f"{name}.so"
    command = [compiler, "-shared", "-fPIC", "-O1", "-o", library, HERE / f"{name}.c", "-ldl"]
    subprocess.run(list(map(str, command)), check=True)
    return library


class _Told:
    """A file in which the process finds what to do, whenever it looks: the old word or the new."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def tell(self, what: str) -> None:
        new = self.path.with_suffix(".new")
        new.write_text(what)
        new.replace(self.path)


class BadDisk:
    """Whatever is written below `folder`: `fails` with an error's number, `hangs`, or `is_well`."""

    def __init__(self, place: Path) -> None:
        self.folder, self._told = (place / "disk").resolve(), _Told(place / "how")
        self.folder.mkdir(parents=True)
        self.is_well()
        self.env = {
            "LD_PRELOAD": str(built("bad_disk", place)),
            "BAD_DISK": str(self.folder),
            "BAD_DISK_HOW": str(self._told.path),
        }

    def fails(self, number: int) -> None:
        self._told.tell(str(number))

    def hangs(self) -> None:
        self._told.tell("hang")

    def is_well(self) -> None:
        self._told.tell("0")


class WallClock:
    """The wall clock, off by some seconds; no other clock is."""

    def __init__(self, place: Path) -> None:
        self._told = _Told(place / "off")
        self.set(0)
        self.env = {"LD_PRELOAD": str(built("wall_clock", place)), "WALL_CLOCK_OFF": str(self._told.path)}

    def set(self, off_s: int) -> None:
        self._told.tell(str(off_s))


def with_environment(env: dict[str, str]) -> pytest.MonkeyPatch:
    """What is started from now on has it too, until `undo`."""
    patch = pytest.MonkeyPatch()
    for name, value in env.items():
        patch.setenv(name, value)
    return patch


def environment(*faults: BadDisk | WallClock) -> dict[str, str]:
    """Return the environment of a process with all of these faults."""
    env = dict(os.environ)
    for fault in faults:
        before = [env["LD_PRELOAD"]] if "LD_PRELOAD" in env else []
        env |= fault.env | {"LD_PRELOAD": ":".join([*before, fault.env["LD_PRELOAD"]])}
    return env
