"""Map files that edges of earlier releases wrote."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from helpers.recorded_traffic import VERSIONS, map_file

from share.errors import StoreError
from share.protocol.peer import restored_runs
from share.store import rows, schema
from share.store.map_store import MapStore
from share.wire.codec import WIRE_VERSION

KEYFRAMES, SCHEMAS = {4: 16, 6: 14}, {4: 3, 6: 5}  # of each recorded map

pytestmark = pytest.mark.parametrize("old", [version for version in VERSIONS if version < WIRE_VERSION])


def test_a_map_of_an_older_release_is_opened_and_continued(old: int, tmp_path: Path) -> None:
    store = MapStore.open(map_file(old, tmp_path))
    try:
        kept = store.load()
        assert store.writable
        assert kept.problems == ()
        assert {run.hello.name for run in kept.runs} == {"ann", "rob"}
        ends = {found.run_key: found.keyframe.id + 1 for found in kept.keyframes}
        assert len(kept.keyframes) == sum(ends.values()) == KEYFRAMES[old]
        assert {run.key: run.next_keyframe for run in restored_runs(kept, 0.03)} == ends
    finally:
        store.close()


def test_a_map_of_an_older_schema_is_converted(old: int, tmp_path: Path) -> None:
    path = map_file(old, tmp_path)
    assert MapStore.read(path).schema == SCHEMAS[old]
    if SCHEMAS[old] == schema.SCHEMA:
        return  # nothing to convert
    assert {found.arrived_s for found in MapStore.read(path).load().keyframes} == {None}
    opened_s = int(time.time())
    with MapStore.open(path) as store:
        assert store.schema == schema.SCHEMA
        assert store.load().problems == ()
        assert len(store.load().keyframes) == KEYFRAMES[old]
    converted = MapStore.read(path)
    assert converted.load().problems == ()
    times = {found.arrived_s for found in converted.load().keyframes}
    assert all(arrived_s is not None and 0 <= arrived_s - opened_s < 60 for arrived_s in times)


def test_reading_an_older_schema_leaves_the_file_as_it_is(old: int, tmp_path: Path) -> None:
    path = map_file(old, tmp_path)
    before = path.read_bytes()
    assert len(MapStore.read(path).load().keyframes) == KEYFRAMES[old]
    assert path.read_bytes() == before


def test_a_damaged_map_of_an_older_schema_is_salvaged(old: int, tmp_path: Path) -> None:
    path = map_file(old, tmp_path)
    data = bytearray(path.read_bytes())
    data[:100] = bytes(100)  # its header
    path.write_bytes(data)
    with MapStore.open(path) as store:
        assert store.schema == schema.SCHEMA
        assert len(store.load().keyframes) == KEYFRAMES[old]


def test_an_unreadable_map_is_refused_in_one_line(
    old: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = map_file(old, tmp_path)
    before = path.read_bytes()
    monkeypatch.setattr(rows, "_READABLE_VERSIONS", (WIRE_VERSION,))
    with pytest.raises(
        StoreError, match=f"wire version {old}, this SHARE reads {WIRE_VERSION}: use the SHARE"
    ) as raised:
        MapStore.open(path)
    assert "\n" not in str(raised.value)
    assert path.read_bytes() == before
