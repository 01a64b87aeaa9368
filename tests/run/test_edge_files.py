"""`share edge --map` with a damaged file or a failing disk: one clear line."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.children import Child
from helpers.crowd import crowd
from helpers.map_changes import ANN, keyframe, small_map

from share.store import map_store
from share.store.map_store import MapStore
from share.store.rows import insert
from share.store.schema import SCHEMA


def edge(folder: Path, name: str = "edge", bind: str = "tcp://127.0.0.1:0") -> Child:
    return Child(folder / f"{name}.log", "edge", "--bind", bind, "--map", str(folder / "room.sqlite"))


@pytest.fixture
def path(tmp_path) -> Path:
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write(small_map())
    return tmp_path / "room.sqlite"


def lines(child: Child, path: Path) -> list[str]:
    """What was said of the file, without its name."""
    return [line.partition(f"{path}: ")[2] for line in child.said.splitlines() if str(path) in line]


@pytest.mark.long
def test_a_flipped_byte(path, tmp_path):
    data = bytearray(path.read_bytes())
    data[data.index(keyframe(ANN, 9).keyframe.view.descriptors.tobytes()[:40])] ^= 0x40
    path.write_bytes(data)
    child = edge(tmp_path)
    child.wait_for("listening on")
    assert child.interrupt() == 0
    said = lines(child, path)
    assert (
        said[0]
        == "the file was damaged; it is kept as room.sqlite.damaged-1, and its intact rows were taken over"
    )
    assert len(said) <= 4
    assert "39 keyframes of 2 runs" in said[-1]
    assert path.with_name("room.sqlite.damaged-1").read_bytes() == data
    assert "Traceback" not in child.said


def test_a_newer_schema(path, tmp_path):
    with MapStore.open(path) as store:
        store._db.execute("DELETE FROM about WHERE name = 'schema'")
        insert(store._db, "about", ("schema", str(SCHEMA + 1)))
    before = path.read_bytes()
    child = edge(tmp_path)
    assert child.wait(20) == 2
    newer = f"was made by a newer SHARE (schema {SCHEMA + 1}, this one reads {SCHEMA})"
    assert child.said == f"share: {path}: {newer}; use that SHARE, or give another file\n"
    assert path.read_bytes() == before


def test_a_file_that_is_no_map(path, tmp_path):
    path.write_text("notes")
    child = edge(tmp_path)
    assert child.wait(20) == 2
    assert child.said == f"share: {path}: is not a SHARE map and was left unchanged; give another file\n"
    assert path.read_text() == "notes"


@pytest.mark.long
def test_a_map_in_use(path, tmp_path):
    first = edge(tmp_path)
    first.wait_for("listening on")
    second = edge(tmp_path, "second")
    assert second.wait(20) == 1
    assert second.said == f"share: {path}: another edge uses this map; stop it, or give another file\n"
    assert first.interrupt() == 0
    assert lines(first, path) == ["40 keyframes of 2 runs, 5 loops"]
    assert "Traceback" not in first.said


@pytest.mark.long
def test_a_disk_that_is_full_for_a_while(tmp_path):
    """What is not in the file is not acknowledged; all of it is there once there is space again."""
    child = edge(tmp_path)
    address = child.wait_for(r"listening on (tcp://\S+?),")[1]
    limits = resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
    (ann,) = crowd(("ann",), address, frames=240)
    ann.start()
    child.wait_for("the map cannot be written")
    time.sleep(1.5)
    assert ann.machine.report()["pending"] > 0  # at most as many as its window allows
    assert "keyframes are not acknowledged" in child.said
    resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE, limits)
    child.wait_for("the map is saved again")
    time.sleep(2.0)  # its window lets it go on
    ann.finish()
    ann.join(20)
    assert ann.error is None
    assert child.interrupt() == 0
    assert child.said.count("the map cannot be written") == 1
    with MapStore.open(tmp_path / "room.sqlite") as store:
        numbers = [k.keyframe_key.id for k in store.load().keyframes]
    assert numbers == list(range(ann.machine.report()["keyframes"]))
    assert len(numbers) > 2


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A file system of 4 MB of its own, 3 of them taken by the file `ballast`."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)]
    if os.getuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("a file system can only be mounted by root")
    (disk / "ballast").write_bytes(bytes(3_000_000))
    yield disk
    subprocess.run(["umount", "--lazy", str(disk)], check=True)


def kept_ids(path: Path, to: Path) -> list[int]:
    """Return the ids in a map as it is on the disk now, read from a copy."""
    to.mkdir()
    for file in path.parent.glob("room.sqlite*"):
        shutil.copyfile(file, to / file.name)
    with MapStore.open(to / path.name) as store:
        return [k.keyframe_key.id for k in store.load().keyframes]


@pytest.mark.long
def test_a_full_disk_stops_acknowledgements(small_disk, tmp_path):
    """Killed while the disk is full, the edge has in its file exactly what it has acknowledged."""
    child = Child(
        tmp_path / "edge.log", "edge", "--bind", "tcp://127.0.0.1:0", "--map", str(small_disk / "room.sqlite")
    )
    address = child.wait_for(r"listening on (tcp://\S+?),")[1]
    (ann,) = crowd(("ann",), address, frames=500)
    ann.start()
    child.wait_for("the map cannot be written: No space left on device; keyframes are not acknowledged")
    time.sleep(2.0)
    acknowledged, waiting = (ann.machine.report()[name] for name in ("acknowledged", "pending"))
    assert waiting > 0  # at most as many as its window allows
    assert ann.machine.report()["acknowledged"] == acknowledged
    child.kill()
    assert kept_ids(small_disk / "room.sqlite", tmp_path / "full") == list(range(acknowledged))
    child = Child(tmp_path / "again.log", "edge", "--bind", address, "--map", str(small_disk / "room.sqlite"))
    child.wait_for("keyframes are not acknowledged")
    (small_disk / "ballast").unlink()
    child.wait_for("the map is saved again")
    deadline = time.monotonic() + 20
    while ann.machine.report()["pending"] > 1 and time.monotonic() < deadline:
        time.sleep(0.05)
    ann.finish()
    ann.join(20)
    assert ann.error is None
    assert child.interrupt() == 0
    ids = kept_ids(small_disk / "room.sqlite", tmp_path / "well")
    assert ids == list(range(ann.machine.report()["keyframes"]))
    assert ann.machine.report()["pending"] == 0


@pytest.mark.long
@pytest.mark.parametrize("how", ["removed", "replaced"])
def test_a_map_file_that_is_moved_away_meanwhile(tmp_path, how):
    child = edge(tmp_path)
    address = child.wait_for(r"listening on (tcp://\S+?),")[1]
    (ann,) = crowd(("ann",), address, frames=120)
    path = tmp_path / "room.sqlite"
    path.rename(tmp_path / "elsewhere")
    if how == "replaced":
        path.write_bytes(b"")
    ann.start()
    child.wait_for(f"room.sqlite was {how} while the edge ran; put it back, or restart the edge")
    time.sleep(0.5)
    assert ann.machine.report()["acknowledged"] == 0
    (tmp_path / "elsewhere").rename(path)
    child.wait_for("the map is saved again")
    ann.finish()
    ann.join(20)
    assert child.interrupt() == 0
    with MapStore.open(path) as store:
        numbers = [k.keyframe_key.id for k in store.load().keyframes]
    assert numbers == list(range(ann.machine.report()["keyframes"]))


# ---------------------------------------------------------------- how long it is kept


@pytest.mark.long
def test_keyframes_that_are_too_old_leave_the_file_when_the_edge_starts(tmp_path, monkeypatch):
    now_s = time.time()
    monkeypatch.setattr(map_store.time, "time", lambda: now_s - 31 * 86_400)
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write(small_map())
    mark = keyframe(ANN, 7).keyframe.image.jpeg.tobytes()
    assert mark in (tmp_path / "room.sqlite").read_bytes()
    (tmp_path / "edge.yaml").write_text("edge: {keep_days: 30}\n")
    where = "--map", str(tmp_path / "room.sqlite"), "--out", str(tmp_path / "out")
    child = Child(
        tmp_path / "edge.log",
        "edge",
        "--bind",
        "tcp://127.0.0.1:0",
        "--config",
        str(tmp_path / "edge.yaml"),
        *where,
    )
    child.wait_for("40 keyframes forgotten, 0 stay: older than 30 days")
    assert child.interrupt() == 0
    events = (tmp_path / "out" / "events.jsonl").read_text()
    assert events.count('"expired"') == 1
    for file in tmp_path.glob("room.sqlite*"):
        assert mark not in file.read_bytes()
    kept = MapStore.read(tmp_path / "room.sqlite").load()
    assert (kept.runs, kept.keyframes, kept.loops, kept.problems) == ((), (), (), ())
