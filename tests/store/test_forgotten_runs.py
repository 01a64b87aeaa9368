"""The map file knows removed runs by their tag, so that their deleted keyframes are not asked for again."""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path

import pytest
from helpers.hellos import hello_of
from helpers.map_changes import ANN, BOB, keyframe, run, small_map

from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import MapChange, RemoveKeyframes, RemoveRun, SaveRun, StoredMap
from share.protocol import admission
from share.protocol.admission import RunRegistry
from share.protocol.peer import restored_runs
from share.runtime.mapper_supervision import MapperRestarts
from share.store import changes
from share.store.map_store import MapStore
from share.store.rows import insert
from share.store.schema import PAGE_BYTES
from share.wire.messages import peer_id, public_tag

ANNS_TAG = public_tag(1)
FORGOTTEN = (RemoveKeyframes(tuple(KeyframeKey(ANN, i) for i in range(20))), RemoveRun(ANN))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A map in which ann was forgotten."""
    file = tmp_path / "room.sqlite"
    with MapStore.open(file) as store:
        store.write(small_map())
        store.write(FORGOTTEN)
    return file


def loaded(path: Path) -> StoredMap:
    """What both ways of reading the file agree on."""
    with MapStore.open(path) as store:
        kept, outline = store.load(), store.outline()
    assert list(kept.forgotten.items()) == list(outline.forgotten.items())
    return kept


def passing(k: int) -> list[MapChange]:
    """A run that comes with one keyframe, and is removed."""
    key = f"eve-{k:04x}"
    return [
        SaveRun(key, hello_of("eve", k)),
        keyframe(key, 0),
        RemoveKeyframes((KeyframeKey(key, 0),)),
        RemoveRun(key),
    ]


def test_a_removed_run_is_kept_by_its_tag(path: Path) -> None:
    kept = loaded(path)
    assert kept.forgotten == {ANNS_TAG: 20}
    assert [one.run_key for one in kept.runs] == [BOB]
    assert kept.problems == ()


def test_a_run_without_a_keyframe_leaves_nothing(path: Path) -> None:
    with MapStore.open(path) as store:
        store.write([run("carol-0003"), RemoveRun("carol-0003"), RemoveRun("carol-0003")])
    assert loaded(path).forgotten == {ANNS_TAG: 20}


def test_a_run_that_comes_back_goes_on_after_what_it_had(path: Path) -> None:
    with MapStore.open(path) as store:
        store.write([run(ANN), keyframe(ANN, 19), keyframe(ANN, 20, first=True)])
        store.write([run(ANN)])  # again: nothing happens
    kept = loaded(path)
    assert kept.forgotten == {}
    assert [k.keyframe.id for k in kept.keyframes if k.run_key == ANN] == [20]
    assert kept.next_ids == {ANN: 21, BOB: 20}
    with MapStore.open(path) as store:
        store.write([RemoveKeyframes((KeyframeKey(ANN, 20),)), RemoveRun(ANN)])
    assert loaded(path).forgotten == {ANNS_TAG: 21}


def test_a_run_whose_newest_keyframes_were_removed_goes_on_after_them(path: Path) -> None:
    with MapStore.open(path) as store:
        store.write([RemoveKeyframes(tuple(KeyframeKey(BOB, i) for i in range(12, 20)))])
    (bob,) = restored_runs(loaded(path), 0.05)
    assert bob.odometry_base is not None and bob.odometry_base.id == 11
    assert bob.next_keyframe == 20


def test_of_too_many_the_oldest_are_dropped(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(changes, "MAX_FORGOTTEN_RUNS", 4)
    with MapStore.open(path) as store:
        store.write([change for k in range(3, 8) for change in passing(k)])
        assert list(store.load().forgotten) == [public_tag(k) for k in range(4, 8)]
        store.write(passing(5))  # it came back: now it is the newest
        store.write(passing(8))
    assert list(loaded(path).forgotten) == [public_tag(k) for k in (6, 7, 5, 8)]


def test_the_edge_keeps_as_many_as_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admission, "MAX_FORGOTTEN_RUNS", 2)
    registry = RunRegistry({public_tag(k): k for k in (1, 2, 3)})
    assert [registry.forgotten(peer_id(k)) is not None for k in (1, 2, 3)] == [False, True, True]
    assert registry.forgotten_next_keyframes() == {public_tag(2): 2, public_tag(3): 3}


def test_a_damaged_file_keeps_them(path: Path) -> None:
    with MapStore.open(path) as store:
        store.write([change for k in range(30, 10, -1) for change in passing(k)])
    before = loaded(path)
    data = bytearray(path.read_bytes())
    with contextlib.closing(sqlite3.connect(path)) as connection:
        (page,) = connection.execute("SELECT rootpage FROM sqlite_schema WHERE name = 'poses'").fetchone()
    data[(page - 1) * PAGE_BYTES : page * PAGE_BYTES] = bytes(PAGE_BYTES)
    path.write_bytes(data)
    kept = loaded(path)
    assert path.with_name("room.sqlite.damaged-1").exists()
    assert len(kept.forgotten) == 21
    assert list(kept.forgotten.items()) == list(before.forgotten.items())


def test_it_is_said_where_they_are_lost_while_the_edge_runs(path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path)) as connection:
        (page,) = connection.execute("SELECT rootpage FROM sqlite_schema WHERE name = 'image'").fetchone()
    with path.open("r+b") as file:  # which the next keyframe meets
        file.seek((page - 1) * PAGE_BYTES)
        file.write(b"\xff" * PAGE_BYTES)
    with MapStore.open(path) as store:
        with contextlib.closing(sqlite3.connect(path)) as connection, connection:
            connection.execute(
                "UPDATE about SET value = '21' WHERE name GLOB 'forgotten *'"
            )  # but not its CRC
        store.write([keyframe(BOB, 20)])
        lost = "1 rows about the file, the credentials of runs and forgotten runs could not be read"
        assert lost in store.problems


def test_what_is_no_number_is_said(path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        for tag, value in (("00", "x"), ("01", "-1"), ("02", str(2**63)), ("03", None)):
            insert(connection, "about", (f"forgotten {tag}", value))
    kept = loaded(path)
    assert kept.forgotten == {ANNS_TAG: 20}
    assert kept.problems == (
        "4 forgotten runs could not be read: their agents may send what was deleted again",
    )


def test_a_map_that_takes_the_place_of_one_that_is_set_aside_knows_them(path: Path) -> None:
    with MapStore.open(path) as store:
        assert store.set_aside({"00": 7}).name == "room.sqlite.damaged-1"
        assert store.load().runs == ()
        assert store.load().forgotten == {ANNS_TAG: 20, "00": 7}
    assert loaded(path).forgotten == {ANNS_TAG: 20, "00": 7}


def test_the_session_that_sets_a_map_aside_knows_them(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(self: MapStore) -> StoredMap:
        monkeypatch.undo()
        raise IndexError("odd row")

    monkeypatch.setattr(MapStore, "outline", fails)
    with MapStore.open(path) as store:
        restarts = MapperRestarts(store, 0.1, print)
        assert restarts.load_map() == (None, [])
        assert restarts.forgotten == {ANNS_TAG: 20}


def test_a_removed_run_is_known_by_the_copy_of_its_row_where_the_row_is_damaged(tmp_path: Path) -> None:
    """As by a disk that fails while the edge runs: what was deleted could come back, and nothing said so."""
    path = tmp_path / "room.sqlite"
    with MapStore.open(path) as store:
        store.write(small_map())
    with MapStore.open(path) as store:
        with contextlib.closing(sqlite3.connect(path)) as connection, connection:
            connection.execute("UPDATE run SET hello = x'ff' || substr(hello, 2) WHERE key = ?", (ANN,))
        store.write(FORGOTTEN)
    assert loaded(path).forgotten == {ANNS_TAG: 20}


@pytest.mark.parametrize(("codec", "hello"), [(99, b"\x91\xc4\x00"), (8, b"\xff\xff")])
def test_a_run_that_cannot_be_read_is_removed_all_the_same(path: Path, codec: int, hello: bytes) -> None:
    """An error would hold up the writing of all that follows."""
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        for table in ("run", "run_copy"):
            insert(connection, table, ("eve-0004", 7, codec, hello))
    with MapStore.open(path) as store:
        store.write([RemoveRun("eve-0004")])
    kept = loaded(path)
    assert [one.run_key for one in kept.runs] == [BOB]
    assert kept.forgotten == {ANNS_TAG: 20}
    assert kept.problems == ()
