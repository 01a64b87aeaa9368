"""Images and views in the map file: read one by one; a damaged one costs itself."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from helpers.map_changes import ANN, BOB, as_values, keyframe, run, small_map

from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import RemoveKeyframes, RemoveRun, SaveView, with_unknown_credentials
from share.protocol.peer import restored_runs
from share.store.keyframe_archive import KeyframeArchive
from share.store.map_store import MapStore
from share.store.schema import create
from share.vision.packed_view import PackedView

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
        first, second = (found and found.correction for found in (one.last_finding, other.last_finding))
        assert (first is None) == (second is None)
        if first is not None and second is not None:
            assert first.map_id == second.map_id
            assert np.allclose(first.T_map_odom, second.T_map_odom, atol=1e-12)


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
