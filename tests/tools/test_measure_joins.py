"""The table of tools/experiments/measure_joins.py."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from share.errors import ConfigError

TOOLS = Path(__file__).resolve().parents[2] / "tools" / "experiments"


@pytest.fixture(scope="module")
def tool():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(TOOLS)
        yield importlib.import_module("measure_joins")


def test_row_holds_join_times_and_wrong_joins(tool):
    runs = [
        tool.JoinRun(0, {"a b": tool.JoiningPair(5.0, 9.0, None, 0.0, "right")}, 1.0, 2),
        tool.JoinRun(1, {"a b": tool.JoiningPair(5.0, 20.0, 4.0, 16.0, "right")}, 3.0, 2),
        tool.JoinRun(3, {"a b": tool.JoiningPair(None, None, 6.0, 10.0, "wrong")}, 99.0, 2),
        tool.JoinRun(4, {"a b": tool.JoiningPair()}),
    ]
    head, _, row = (line.strip("| ").split(" | ") for line in tool.table("room", runs).splitlines())
    assert dict(zip(head, row, strict=True)) == {
        "scene, seeds": "room, 0 to 4 (4)",
        "pairs with common view": "2 of 4",
        "of them joined": "2, after 9.5 s (most 15.0)",
        "within 10 s": "1",
        "ever wrong": "2",
        "in all": "26 s",
        "wrong at the end": "1",
        "joint ATE": "3.0 cm (most 99.0)",
    }


def test_settings_are_applied_and_unknown_ones_refused(tool):
    assert tool.configured(["merge.join_places=7"]).merge.join_places == 7
    with pytest.raises(ConfigError, match="join_place"):
        tool.configured(["merge.join_place=7"])


def test_missing_keyframe_sets_are_reported(tool, tmp_path, capsys):
    words = ["--scene", "empty-hall", "--motion", "walk:", "--seeds", "7:9", "--cache", str(tmp_path)]
    assert tool.main([*words, "--json", str(tmp_path / "out.json")]) == 2
    assert "there are no sets; make them with make_keyframe_sets.py" in capsys.readouterr().err
    assert not (tmp_path / "out.json").exists()
