"""Objects of the room in the map file: kept, moved, removed, and taken over from a damaged file."""

from __future__ import annotations

import contextlib
import sqlite3

import numpy as np
import pytest
from helpers.room_bench import at

from share.mapping.map_changes import RemoveStoredObject, SaveObject
from share.store.map_store import MapStore
from share.store.rows import insert, object_row
from share.wire.room_messages import ObjectKind, RoomObject


def stored(object_id: int, x: float, map_id: str = "ann-1/0") -> SaveObject:
    return SaveObject(
        RoomObject(7, 3, object_id, ObjectKind.MARKER, "ann", map_id, at(x, 0.1, 0.7)), "bob-2/0"
    )


def read(path) -> dict[int, SaveObject]:
    with MapStore.open(path) as store:
        loaded, outline = store.load().objects, store.outline().objects
        assert [one.object.object_id for one in loaded] == [one.object.object_id for one in outline]
        return {one.object.object_id: one for one in loaded}


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "room.sqlite"
    with MapStore.open(file) as store:
        store.write([stored(1, 1.0), stored(2, 2.0)])
        store.write([stored(1, 5.5, "bob-2/0"), RemoveStoredObject(2), RemoveStoredObject(99)])
        store.write([stored(4, 1 / 3)])
    return file


def test_objects_are_read_back_as_they_were_last(path) -> None:
    objects = read(path)
    assert set(objects) == {1, 4}
    for object_id, x, map_id in ((1, 5.5, "bob-2/0"), (4, 1 / 3, "ann-1/0")):
        one = objects[object_id]
        np.testing.assert_array_equal(one.object.T_map_object, at(x, 0.1, 0.7))
        assert (one.object.kind, one.object.owner, one.object.map_id) == (ObjectKind.MARKER, "ann", map_id)
        assert one.home_map == "bob-2/0"


def test_a_damaged_file_keeps_its_objects(path) -> None:
    data = bytearray(path.read_bytes())
    for page in range(1, len(data) // 8192):  # some page that has nothing of them
        begin = page * 8192
        if b"object " not in data[begin : begin + 8192] and any(data[begin : begin + 8]):
            data[begin] ^= 0xFF
            break
    path.write_bytes(data)
    assert set(read(path)) == {1, 4}
    assert path.with_name("room.sqlite.damaged-1").exists()


def test_what_is_no_object_or_one_too_many_is_said(path) -> None:
    with MapStore.open(path) as store:
        store.write([stored(k, 1.0) for k in range(10, 72)])  # 64 with the two of before
        assert store.load().problems == store.outline().problems == ()
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        _, value = object_row(stored(7, 1.0))
        for name, text in (
            ("object 007", value),
            ("object 7x", value),
            ("object 8", "[]"),
            ("object 99", value),
        ):
            insert(connection, "about", (name, text))
    with MapStore.open(path) as store:
        for loaded in (store.load(), store.outline()):
            assert loaded.problems == (
                "3 objects of the room could not be read",
                "1 objects of the room are too many (64 at most) and stay in the file unused",
            )
            assert 7 not in {one.object.object_id for one in loaded.objects}
