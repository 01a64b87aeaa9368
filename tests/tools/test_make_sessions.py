"""The sessions of the evaluation and of the error model."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from share.lab.emulate.motion.spec import parse_motion

TOOLS = Path(__file__).resolve().parents[2] / "tools" / "experiments"


@pytest.fixture
def tools(monkeypatch):
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module


def test_session_names_and_motions_are_valid(tools, tmp_path):
    found = tools("make_sessions").recipes(tmp_path)
    assert len(found) == 13
    assert len({(recipe.scene, recipe.motions, recipe.seed) for recipe in found.values()}) == 13
    assert {len(recipe.motions) for recipe in found.values()} == {1, 2, 3}
    for recipe in found.values():
        for motion in recipe.motions:
            name, spec = parse_motion(motion)
            path = getattr(spec, "path", None)
            assert (name is not None) == (path is not None)
            assert path is None or Path(path).parent.parent == tmp_path


def test_sessions_are_listed_and_unknown_names_refused():
    def reported(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(TOOLS / "make_sessions.py"), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    done = reported("--list", "--only", "tumvi-rooms")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("tumvi-rooms     warehouse, seed 63: ann=tumvi:")
    done = reported("--only", "paper-9", "--out", "x")
    assert done.returncode == 2
    assert "--only paper-9: known are warehouse-1, " in done.stderr


def test_rooms_of_the_error_model_differ_and_are_repeatable(tools):
    recipe = tools("make_error_rooms").recipe
    rooms = [recipe(number, 30.0, "stereo") for number in range(30)]
    assert len({room.digest for room in rooms}) == 30
    assert [room.digest for room in rooms] == [recipe(number, 30.0, "stereo").digest for number in range(30)]
    assert {len(room.motions) for room in rooms} == {2}
    assert {room.scene for room in rooms} == {"warehouse", "firestation", "whitewall"}
