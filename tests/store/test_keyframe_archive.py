"""Images and views in the map file: read one by one; a damaged one costs itself."""

from __future__ import annotations

import sqlite3
import time
from contextlib import closing
from pathlib import Path

import msgspec
import numpy as np
import pytest
from helpers.map_changes import ANN, BOB, as_values, keyframe, run, small_map

from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import RemoveKeyframes, RemoveRun, SaveView, with_unknown_credentials
from share.protocol.peer import restored_runs
from share.store import rows
from share.store.keyframe_archive import KeyframeArchive
from share.store.map_store import MapStore
from share.store.rows import insert
from share.store.schema import SCHEMA, create
from share.types import U8
from share.vision.packed_view import PackedView
from share.wire import codec

KEY = KeyframeKey(ANN, 0)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "room.sqlite"


def some_view(i: int = 0) -> PackedView:
    return PackedView.pack(keyframe(ANN, i).keyframe.view)


def test_it_reads_what_a_running_edge_has_written(path: Path) -> None:
    with MapStore.open(path) as store:
        archive = KeyframeArchive(path)
        assert archive.jpeg(KEY) is None and not archive.has_jpeg(KEY)
        store.write([run(ANN), keyframe(ANN, 0), keyframe(ANN, 1)])
        jpeg = archive.jpeg(KEY)
        assert jpeg is not None and np.array_equal(jpeg, keyframe(ANN, 0).keyframe.image.jpeg)
        assert archive.has_jpeg(KEY) and archive.view(KEY) is None and not archive.has_view(KEY)
        store.write([SaveView(KEY, some_view())])
        view = archive.view(KEY)
        assert view is not None and view.to_bytes() == some_view().to_bytes() and archive.has_view(KEY)
        store.write([RemoveKeyframes((KEY,))])
        assert archive.jpeg(KEY) is archive.view(KEY) is None


def test_views_of_removed_keyframes_and_runs_leave_nothing(path: Path) -> None:
    with MapStore.open(path) as store:
        store.write([run(ANN), run(BOB), keyframe(ANN, 0), keyframe(BOB, 0), SaveView(KEY, some_view())])
        store.write([RemoveKeyframes((KEY,)), SaveView(KEY, some_view()), RemoveRun(BOB)])
    with closing(sqlite3.connect(path)) as connection:
        counts = [connection.execute(f"SELECT count(*) FROM {t}").fetchone() for t in ("image", "view")]
    assert counts == [(0,), (0,)]


def test_a_file_that_takes_the_place_of_the_first_is_read(path: Path) -> None:
    """As after a repair: what was saved later was not found."""
    with MapStore.open(path) as store:
        store.write(small_map())
        archive = KeyframeArchive(path)
        assert archive.has_jpeg(KEY) and not archive.has_jpeg(KeyframeKey(ANN, 40))
        store.set_aside({})
        store.write([run(ANN), keyframe(ANN, 40)])
        assert not archive.has_jpeg(KEY) and archive.has_jpeg(KeyframeKey(ANN, 40))


def test_a_missing_file_has_nothing(path: Path) -> None:
    assert KeyframeArchive(path).view(KEY) is None and not KeyframeArchive(path).has_jpeg(KEY)


def test_a_damaged_row_is_missing_and_the_rest_is_there(path: Path) -> None:
    with MapStore.open(path) as store:
        store.write([*small_map(), SaveView(KEY, some_view())])
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE image SET jpeg = x'00' WHERE run = ? AND id = 0", (ANN,))
        connection.execute("UPDATE view SET view = 'text' WHERE run = ? AND id = 0", (ANN,))
    with MapStore.open(path) as store:
        assert store.problems == () and len(store.load().keyframes) == 40
        archive = KeyframeArchive(path)
        assert archive.jpeg(KEY) is archive.view(KEY) is None
        assert archive.jpeg(KeyframeKey(ANN, 1)) is not None


def test_a_file_whose_images_are_damaged_is_repaired_by_the_next_write(path: Path) -> None:
    with MapStore.open(path) as store:
        store.write(small_map())
    with closing(sqlite3.connect(path)) as connection:
        (page,) = connection.execute("SELECT rootpage FROM sqlite_schema WHERE name = 'image'").fetchone()
    with path.open("r+b") as file:
        file.seek((page - 1) * 8192)
        file.write(b"\xff" * 8192)
    with MapStore.open(path) as store:
        assert len(store.load().keyframes) == 40
        store.write([keyframe(ANN, 20)])
        assert store.problems == (
            "the file was damaged; it is kept as room.sqlite.damaged-1, and its intact rows were taken over",
        )
        assert len(store.load().keyframes) == 41
    assert KeyframeArchive(path).has_jpeg(KeyframeKey(ANN, 20))


@pytest.mark.parametrize("has_poses", [True, False])
def test_the_outline_continues_all_runs_as_the_whole_map_does(path: Path, has_poses: bool) -> None:
    changes = small_map()
    with MapStore.open(path) as store:
        store.write(changes if has_poses else changes[:-1])
        store.write([keyframe(ANN, 20), keyframe(ANN, 21), keyframe(BOB, 20, first=True)])
    with MapStore.open(path) as store:
        outline, whole = store.outline(), store.load()
        assert len(outline.keyframes) < len(whole.keyframes) or not has_poses
        before, after = (restored_runs(with_unknown_credentials(one), 0.03) for one in (whole, outline))
    assert [(one.key, one.next_keyframe, one.credential) for one in before] == [
        (one.key, one.next_keyframe, one.credential) for one in after
    ]
    for one, other in zip(before, after, strict=True):
        first, second = (
            found and found.correction for found in (one.last_correction_event, other.last_correction_event)
        )
        assert (first is None) == (second is None)
        if first is not None and second is not None:
            assert first.map_id == second.map_id
            assert np.allclose(first.T_map_odom, second.T_map_odom, atol=1e-12)


def write_schema_3(path: Path, count: int) -> None:
    """A map of Ann's keyframes whose messages have the JPEGs."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA page_size = 8192")
        create(connection, 3)
        for table in ("run", "run_copy"):
            insert(connection, table, rows.run_row(run(ANN), 0))
        insert(connection, "stretch", (ANN, 0))
        for i in range(count):
            one = keyframe(ANN, i)
            message = msgspec.msgpack.encode([bytes(frame) for frame in codec.encode(one.keyframe)])
            insert(connection, "keyframe", (*rows.keyframe_row(one, 0, i)[:-1], message))


def jpeg_bytes(found: U8 | None) -> bytes:
    assert found is not None
    return found.tobytes()


@pytest.mark.parametrize("is_damaged", [False, True])
def test_images_of_schema_3_move_to_their_table(path: Path, is_damaged: bool) -> None:
    write_schema_3(path, 4)
    sent = [keyframe(ANN, i).keyframe.image.jpeg.tobytes() for i in range(4)]
    before = path.read_bytes()
    found = MapStore.read(path).load().keyframes
    assert [(k.keyframe.image.jpeg.tobytes(), k.arrived_s) for k in found] == [(jpeg, None) for jpeg in sent]
    assert path.read_bytes() == before
    if is_damaged:
        path.write_bytes(bytes(100) + before[100:])
    opened_s = int(time.time())
    with MapStore.open(path) as store:
        assert store.schema == SCHEMA
        found = store.load().keyframes
    assert len(store.problems) == 2 * is_damaged
    assert [len(k.keyframe.image.jpeg) for k in found] == [0] * 4
    assert [len(k.keyframe.image.uv) for k in found] == [3] * 4
    assert all(k.arrived_s is not None and 0 <= k.arrived_s - opened_s < 60 for k in found)
    assert [jpeg_bytes(KeyframeArchive(path).jpeg(KeyframeKey(ANN, i))) for i in range(4)] == sent
    assert sent[2] not in b"".join(rows.keyframe_row(k, 0, 0)[-1] for k in found)
    assert path.read_bytes().count(sent[2]) == 1
    with MapStore.open(path) as store:
        assert len(store.load().keyframes) == 4 and store.problems == ()


def test_a_map_of_schema_3_is_read_as_it_is_and_converted_by_an_edge(path: Path) -> None:
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA page_size = 8192")
        create(connection, 3)
    before = path.read_bytes()
    assert as_values(MapStore.read(path).load()) == as_values(type(MapStore.read(path).load())())
    assert path.read_bytes() == before
    with MapStore.open(path) as store:
        store.write([run(ANN), keyframe(ANN, 0), SaveView(KEY, some_view())])
    with MapStore.open(path) as store:
        assert store.problems == () and len(store.load().keyframes) == 1
    assert KeyframeArchive(path).has_view(KEY)
