"""What is forgotten leaves the map file for good; what stays is a whole map."""

from __future__ import annotations

import os
import sqlite3
import stat
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.map_changes import ANN, BOB, keyframe, loop, run, small_map, solution

from share.config import Config
from share.errors import StoreError
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import (
    MapChange,
    RemoveKeyframes,
    SaveKeyframe,
    SaveLoop,
    SaveView,
    StoredMap,
    Wipe,
    map_poses,
)
from share.mapping.mapper import Mapper
from share.store import forgetting, map_store
from share.store.forgetting import Forgetting, ForgettingReport
from share.store.keyframe_archive import KeyframeArchive
from share.store.map_store import MapStore
from share.store.schema import PAGE_BYTES
from share.types import KeyframeImage
from share.vision.packed_view import PackedView

CAROL = "carol-0003"
DAY_S = 86_400
IMAGE_BYTES = 20_000


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "room.sqlite"


def marker(key: str, i: int) -> bytes:
    """Bytes that occur in the image of this keyframe only, all over it."""
    return f"<{key}:{i:03d}>".encode()


def pictured(change: MapChange) -> MapChange:
    """The keyframe with an image of `IMAGE_BYTES` that is full of its marker."""
    if not isinstance(change, SaveKeyframe):
        return change
    mark = marker(*change.keyframe_key)
    jpeg = np.frombuffer((mark * (IMAGE_BYTES // len(mark) + 1))[:IMAGE_BYTES], np.uint8)
    none = KeyframeImage.empty()
    image = replace(none, jpeg=jpeg)
    return replace(change, keyframe=replace(change.keyframe, image=image))


def three_agents(count: int = 20) -> list[MapChange]:
    """Ann, Bob and Carol in one map that Ann began; Bob and Carol both have loops with Ann, one is between
    them if `count` is above 12."""
    frames = [keyframe(key, i) for i in range(count) for key in (ANN, BOB, CAROL)]
    with_carol = [replace(loop(i, i), b=KeyframeKey(CAROL, i)) for i in range(1, count, 4)]  # ANN i - CAROL i
    between = [replace(loop(12, 12), a=KeyframeKey(BOB, 12), b=KeyframeKey(CAROL, 12))] if count > 12 else []
    loops = [*(loop(i, i) for i in range(0, count, 4)), *with_carol, *between]
    keys = [frame.keyframe_key for frame in frames]
    return [run(ANN), run(BOB), run(CAROL), *map(pictured, frames), *map(SaveLoop, loops), solution(keys)]


def described(keys: tuple[str, ...] = (ANN, BOB, CAROL), count: int = 20) -> list[MapChange]:
    """The views of these runs' keyframes."""
    return [
        SaveView(KeyframeKey(key, i), PackedView.pack(keyframe(key, i).keyframe.view))
        for key in keys
        for i in range(count)
    ]


def row_counts(path: Path, *tables: str) -> list[int]:
    with closing(sqlite3.connect(path)) as connection:
        return [connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0] for table in tables]


def damage_images(path: Path) -> None:
    """Overwrite the page that heads the table of images."""
    with closing(sqlite3.connect(path)) as connection:
        (page,) = connection.execute("SELECT rootpage FROM sqlite_schema WHERE name = 'image'").fetchone()
    with path.open("r+b") as file:
        file.seek((page - 1) * PAGE_BYTES)
        file.write(b"\xff" * PAGE_BYTES)


def written(path: Path, changes: list[MapChange]) -> None:
    """Write the map change by change, as an edge does."""
    with MapStore.open(path) as store:
        for change in changes:
            store.write([change])


def loaded(path: Path) -> StoredMap:
    kept = MapStore.read(path).load()
    assert kept.problems == ()
    return kept


def bytes_on_disk(path: Path) -> bytes:
    """All files of the map, its log included."""
    return b"".join(file.read_bytes() for file in sorted(path.parent.glob(f"{path.name}*")))


def forget(path: Path, *agents: str, before_s: float | None = None) -> ForgettingReport:
    with MapStore.open(path) as store:
        planned = Forgetting(store, agents or None, before_s)
        planned.carry_out()
    return planned.report


def test_no_byte_of_a_forgotten_agent_stays(path: Path) -> None:
    written(path, three_agents())
    before = bytes_on_disk(path)
    assert before.count(marker(ANN, 7)) > 100
    report = forget(path, "ann")
    after = bytes_on_disk(path)
    for i in range(20):
        assert marker(ANN, i)[:-1] not in after
        assert marker(BOB, i) in after and marker(CAROL, i) in after
    assert b"ann" not in after
    assert len(after) < 0.8 * len(before)
    assert report.deleted_agents == {"ann": 20}
    assert report.image_bytes == 20 * IMAGE_BYTES


def test_images_views_and_times_of_forgotten_keyframes_go_with_them(path: Path) -> None:
    written(path, [*three_agents(), *described()])
    tables = "keyframe", "arrival", "image", "view"
    assert row_counts(path, *tables) == [60, 60, 60, 60]
    descriptors = {key: keyframe(key, 7).keyframe.view.descriptors[:3].tobytes() for key in (ANN, BOB)}
    forget(path, "ann")
    assert row_counts(path, *tables) == [40, 40, 40, 40]
    left = bytes_on_disk(path)
    assert descriptors[ANN] not in left and descriptors[BOB] in left
    assert KeyframeArchive(path).jpeg(KeyframeKey(ANN, 7)) is None
    jpeg = KeyframeArchive(path).jpeg(KeyframeKey(BOB, 7))
    assert jpeg is not None and marker(BOB, 7) in jpeg.tobytes()


def test_where_the_images_are_damaged_the_copy_is_named(path: Path) -> None:
    """Opening does not read them, so the damage is found while they are deleted."""
    written(path, three_agents())
    damage_images(path)
    report = forget(path, "ann")
    assert report.copies == (f"{path}.damaged-1",)
    assert report.left_agents == {"bob": 20, "carol": 20}
    assert row_counts(path, "keyframe", "arrival") == [40, 40]
    assert b"ann" not in path.read_bytes()


def test_what_was_culled_by_an_edge_that_did_not_overwrite_is_gone_too(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As edges before schema 5 left it: in free pages."""
    written(path, three_agents())
    with MapStore.open(path) as store:
        assert store._db is not None
        store._db.execute("PRAGMA secure_delete = OFF")
        store.write([RemoveKeyframes(tuple(KeyframeKey(ANN, i) for i in range(5)))])
    assert marker(ANN, 3) in bytes_on_disk(path)
    forget(path, "ann")
    assert b"ann" not in bytes_on_disk(path)


def test_the_others_keep_their_loops_and_their_places(path: Path) -> None:
    written(path, three_agents())
    places = map_poses(loaded(path))
    report = forget(path, "ann")
    kept = loaded(path)
    assert {one.hello.name for one in kept.runs} == {"bob", "carol"}
    assert [(str(x.a), str(x.b)) for x in kept.loops] == [(f"{BOB}:12", f"{CAROL}:12")]
    now = map_poses(kept)
    assert {name for name, _ in now.values()} == {f"{BOB}/0"}
    assert now.keys() == {key for key in places if key.agent != ANN}
    for key, (_, T) in now.items():
        assert np.array_equal(T, places[key][1])
    assert report.left_maps == {f"{BOB}/0": 40} and report.earlier_maps == 1
    assert kept.next_ids == {BOB: 20, CAROL: 20}


def test_what_only_the_forgotten_agent_connected_becomes_two_maps(path: Path) -> None:
    written(path, three_agents(12))
    places = map_poses(loaded(path))
    report = forget(path, "ann")
    assert report.left_maps == {f"{BOB}/0": 12, f"{CAROL}/0": 12}
    for key, (_, T) in map_poses(loaded(path)).items():
        assert np.array_equal(T, places[key][1])


def test_the_rest_is_a_map_that_a_mapper_continues(path: Path) -> None:
    written(path, three_agents())
    forget(path, "ann")
    mapper = Mapper(Config())
    mapper.restore(loaded(path))
    assert mapper.atlas.map_sizes() == {f"{BOB}/0": 40}
    assert mapper.next_solve() is not None


def test_old_keyframes_are_forgotten_by_when_they_came(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = map_store.time.time()
    first, second = three_agents()[:33], three_agents()[33:]
    monkeypatch.setattr(map_store.time, "time", lambda: now_s - 40 * DAY_S)
    written(path, first)  # ten keyframes of each
    monkeypatch.setattr(map_store.time, "time", lambda: now_s)
    written(path, second)
    assert forget(path, before_s=now_s - 50 * DAY_S).deleted_keyframes == 0
    report = forget(path, before_s=now_s - 30 * DAY_S)
    assert report.deleted_agents == {"ann": 10, "bob": 10, "carol": 10}
    kept = loaded(path)
    assert {k.keyframe_key.id for k in kept.keyframes} == set(range(10, 20))
    assert {link.reference for link in kept.links.values()} == {-1}  # the tenth begins its segment now
    assert len({name for name, _ in map_poses(kept).values()}) == 1
    assert marker(BOB, 9) not in bytes_on_disk(path) and marker(BOB, 10) in bytes_on_disk(path)
    assert forget(path, before_s=now_s - 30 * DAY_S).deleted_keyframes == 0


def test_old_keyframes_of_one_agent_only(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = map_store.time.time()
    monkeypatch.setattr(map_store.time, "time", lambda: now_s - 40 * DAY_S)
    written(path, three_agents())
    monkeypatch.setattr(map_store.time, "time", lambda: now_s)
    assert forget(path, "bob", before_s=now_s - 30 * DAY_S).left_agents == {"ann": 20, "carol": 20}


def test_an_edge_that_removes_old_keyframes_overwrites_them(path: Path) -> None:
    with MapStore.open(path) as store:
        store.write(three_agents())
        store.write([RemoveKeyframes(tuple(KeyframeKey(ANN, i) for i in range(20))), Wipe()])
        assert path.with_name("room.sqlite-wal").stat().st_size == 0
        left = bytes_on_disk(path)
    for i in range(20):
        assert marker(ANN, i) not in left


def test_a_mapper_that_has_read_an_image_does_not_delay_the_wipe(path: Path) -> None:
    archive = KeyframeArchive(path)
    with MapStore.open(path) as store:
        store.write([*three_agents(), *described()])
        gone = KeyframeKey(ANN, 3)
        assert archive.jpeg(gone) is not None and archive.view(gone) is not None
        store.write([RemoveKeyframes((gone,)), Wipe()])
        assert path.with_name("room.sqlite-wal").stat().st_size == 0
        assert marker(*gone) not in bytes_on_disk(path)
        assert archive.jpeg(gone) is archive.view(gone) is None
        assert archive.has_jpeg(KeyframeKey(BOB, 3))


def test_a_reader_delays_the_wipe_and_does_not_prevent_it(path: Path) -> None:
    with MapStore.open(path) as store:
        store.write(three_agents())
        reader = sqlite3.connect(path, isolation_level=None)
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM keyframe").fetchone()
        store._writable_db().execute("PRAGMA busy_timeout = 50")
        store.write([RemoveKeyframes(tuple(KeyframeKey(ANN, i) for i in range(20))), Wipe()])
        assert marker(ANN, 3) in bytes_on_disk(path)
        reader.close()
        store.write([SaveLoop(loop(0, 0))])
        assert marker(ANN, 3) not in bytes_on_disk(path)


def test_nothing_is_deleted_where_the_file_cannot_be_rewritten(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(path, small_map())
    monkeypatch.setattr(forgetting.shutil, "disk_usage", lambda folder: SimpleNamespace(free=1000))
    with pytest.raises(StoreError, match="nothing was deleted: rewriting it takes"):
        forget(path, "ann")
    assert len(loaded(path).keyframes) == 40


def test_damaged_copies_are_named(path: Path) -> None:
    written(path, small_map())
    path.with_name("room.sqlite.damaged-1").write_bytes(b"old")
    assert forget(path, "ann").copies == (f"{path}.damaged-1",)


def test_forgetting_everybody_leaves_an_empty_map(path: Path) -> None:
    written(path, small_map())
    report = forget(path, "ann", "bob")
    assert report.left_keyframes == report.left_loops == 0
    kept = loaded(path)
    assert (kept.runs, kept.keyframes, kept.loops, kept.segments) == ((), (), (), ())


# ---------------------------------------------------------------- who may read the file


def mode(file: Path) -> int:
    return stat.S_IMODE(file.stat().st_mode)


def test_only_its_owner_may_read_a_map(path: Path) -> None:
    before = os.umask(0o022)
    try:
        with MapStore.open(path) as store:
            store.write(small_map())
            for file in path.parent.iterdir():
                assert mode(file) == 0o600, file
    finally:
        os.umask(before)


@pytest.mark.parametrize(
    ("before", "after"), [(0o644, 0o600), (0o666, 0o600), (0o640, 0o640), (0o660, 0o660)]
)
def test_a_map_that_all_may_read_is_mended_and_one_of_a_group_is_not(
    path: Path, before: int, after: int
) -> None:
    written(path, small_map())
    path.chmod(before)
    MapStore.open(path).close()
    assert mode(path) == after


def test_a_damaged_map_and_what_is_salvaged_are_private(path: Path) -> None:
    written(path, small_map())
    data = bytearray(path.read_bytes())
    data[:100] = bytes(100)
    path.write_bytes(data)
    path.chmod(0o644)
    with MapStore.open(path) as store:
        assert len(store.load().keyframes) == 40
    assert mode(path) == mode(path.with_name("room.sqlite.damaged-1")) == 0o600
