"""`share dataset forget`: it asks, refuses while an edge runs, and says what it did."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from helpers.map_changes import small_map

from share.cli import dataset_forget
from share.cli.main import cli
from share.errors import ShareError
from share.store.map_store import MapStore


@pytest.fixture
def room(tmp_path: Path) -> Path:
    path = tmp_path / "room.sqlite"
    with MapStore.open(path) as store:
        store.write(small_map())
    return path


def forget(room: Path, *words: str, answer: str = "") -> Result:
    return CliRunner().invoke(cli, ["dataset", "forget", str(room), *words], input=answer)


def error(result: Result) -> tuple[int, str]:
    """Exit code and line of a refused command, as `share.cli.main.main` gives them."""
    if isinstance(result.exception, ShareError):
        return result.exception.exit_code, str(result.exception)
    return result.exit_code, result.output


def keyframe_count(room: Path) -> int:
    return len(MapStore.read(room).load().keyframes)


def test_it_says_what_is_deleted_and_what_stays(room: Path) -> None:
    result = forget(room, "--agent", "ann", "--yes")
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines() == [
        f"{room}: deleted 20 keyframes (ann 20; 0.0 MB of images) and 5 loops",
        "  stay: 20 keyframes (bob 20) and 0 loops",
        "  map bob-0002/0: 20 keyframes",
    ]
    assert forget(room, "--older-than", "30d").stdout.splitlines() == [
        f"{room}: nothing to delete; 20 keyframes stay",
        "  map bob-0002/0: 20 keyframes",
    ]


def test_json(room: Path) -> None:
    report = json.loads(forget(room, "--agent", "ann", "--yes", "--json").stdout)
    assert report["deleted_agents"] == {"ann": 20}
    assert report["left_maps"] == {"bob-0002/0": 20}
    assert report["copies"] == []


@pytest.mark.parametrize(("answer", "left"), [("y\n", 20), ("n\n", 40), ("\n", 40)])
def test_it_asks(room: Path, monkeypatch: pytest.MonkeyPatch, answer: str, left: int) -> None:
    monkeypatch.setattr(dataset_forget, "_can_ask", lambda: True)
    result = forget(room, "--agent", "ann", answer=answer)
    assert "delete 20 keyframes (ann 20; 0.0 MB of images) and 5 loops for good? [y/N]" in result.output
    assert keyframe_count(room) == left
    assert left == 20 or error(result) == (1, f"{room}: nothing was deleted")


def test_it_does_nothing_where_nobody_can_be_asked(room: Path) -> None:
    code, line = error(forget(room, "--agent", "ann"))
    assert code == 2
    assert line.endswith("and 5 loops for good? stdin is not a terminal; add --yes")
    assert keyframe_count(room) == 40


def test_a_running_edge_prevents_it(room: Path) -> None:
    with MapStore.open(room):
        code, line = error(forget(room, "--agent", "ann", "--yes"))
    assert (code, line) == (1, f"{room}: another edge uses this map; stop it, or give another file")
    assert keyframe_count(room) == 40


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "give --agent NAME or --older-than AGE"),
        (("--agent", "eve"), "has no agent 'eve'; its agents: ann, bob"),
        (("--older-than", "soon"), "'soon' is not an age such as 30d or 12h"),
    ],
)
def test_wrong_use_is_one_line(room: Path, words: tuple[str, ...], said: str) -> None:
    code, line = error(forget(room, *words, "--yes"))
    assert code == 2
    assert said in line
    assert keyframe_count(room) == 40
