"""A map file of somebody else: what its maps are called neither leads out of a folder nor to a terminal."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from pathlib import Path

import msgspec
import numpy as np
import pytest
from helpers.map_changes import ANN, BOB, small_map

from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SavePoses
from share.recordings.exports.names import distinct_file_names
from share.store import rows
from share.store.map_store import MapStore


def called(path: Path, first: str, second: str) -> Path:
    """Write a map of two maps of these names, as no SHARE writes it: its row's CRC is right."""
    with MapStore.open(path) as store:
        store.write(small_map(4))
    keys = [(key, i, name) for key, name in ((ANN, first), (BOB, second)) for i in range(4)]
    row = msgspec.msgpack.encode(keys), np.tile(np.eye(4), (8, 1, 1)).tobytes()
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute("DELETE FROM poses")
        rows.insert(db, "poses", row)
    return path


@pytest.mark.parametrize("kind", [None, "kitti"])
@pytest.mark.parametrize("names", [("..", "good"), (".", "a"), ("a/0", "a.0"), ("/", "//"), ("A", "a")])
def test_each_map_has_a_folder_of_its_own_inside(tmp_path, share, kind, names):
    path = called(tmp_path / "foreign.sqlite", *names)
    (tmp_path / "parent").mkdir()
    (tmp_path / "parent" / "loops.csv").write_text("mine")
    out = tmp_path / "parent" / "out"
    done = share("dataset", "export", path, "--out", out, *(("--format", kind) if kind else ()))
    assert done.code == 0, done.err
    assert sorted(os.listdir(out.parent)) == ["loops.csv", "out"]
    assert (tmp_path / "parent" / "loops.csv").read_text() == "mine"
    folders = sorted(out.iterdir())
    assert len(folders) == 2 and all(folder.is_dir() and list(folder.iterdir()) for folder in folders)
    assert len({folder.name.casefold() for folder in folders}) == 2


@pytest.mark.parametrize("name", ["\x1b[31mred\x07", "\u202egood", "x" * 300, ""])
def test_a_name_that_the_wire_would_refuse_costs_the_solution_alone(tmp_path, share, name):
    path = called(tmp_path / "foreign.sqlite", name, name)
    with MapStore.open(path) as store:
        for kept in (store.load(), store.outline()):
            assert kept.problems[0].startswith("1 solutions could not be read")
            assert kept.poses is None and {one.run_key for one in kept.keyframes} == {ANN, BOB}
    done = share("dataset", "export", path, "--out", tmp_path / "out")
    assert done.code == 0 and "solutions could not be read" in done.err
    assert (done.out + done.err).replace("\n", "").isprintable()
    assert sorted(os.listdir(tmp_path / "out")) == [f"{ANN}.0", f"{BOB}.0"]


def test_a_run_whose_key_is_a_path_is_not_read(tmp_path):
    path = called(tmp_path / "foreign.sqlite", "a", "b")
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        for table in ("run", "run_copy"):
            columns = ", ".join(rows.COLUMNS[table])
            (number, *row) = db.execute(f"SELECT number, {columns} FROM {table} ORDER BY number").fetchone()
            db.execute(f"DELETE FROM {table} WHERE number = ?", (number,))
            rows.insert(db, table, ("../../ann-0001", *row[1:]), number)
    with MapStore.read(path) as store:
        kept = store.load()
    assert [run.run_key for run in kept.runs] == [BOB]
    assert "1 agent runs could not be read" in kept.problems


def test_names_that_no_map_may_have_are_not_written() -> None:
    with pytest.raises(ValueError, match="map_id: 1 to 96 printable characters"):
        SavePoses((KeyframeKey(ANN, 0),), np.eye(4)[None], ("a\nb",))


def test_file_names_are_distinct_and_stay_in_their_folder() -> None:
    names = [
        "",
        "_",
        ".",
        "..",
        "/",
        "../x",
        "a/0",
        "a.0",
        "A.0",
        "é",
        "e\u0301",
        "\U00020000" * 90,
        "x" * 300,
    ]
    made = list(distinct_file_names(names).values())
    assert len({name.casefold() for name in made}) == len(names)
    for name in made:
        assert name and not name.startswith(".") and "/" not in name and len(name.encode()) < 220
    assert distinct_file_names(["ann-0001/0"]) == {"ann-0001/0": "ann-0001.0"}
