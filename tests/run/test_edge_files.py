"""`share edge --map` as a user sees it where the file or the disk is not as it should be: one clear line."""

from __future__ import annotations

import resource
import time
from pathlib import Path

import pytest
from children import Child
from crowd import crowd
from map_changes import small_map

from share.io.map_store import MapStore
from share.io.map_store.rows import insert
from share.io.map_store.schema import SCHEMA


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


def test_a_flipped_byte(path, tmp_path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x40
    path.write_bytes(data)
    child = edge(tmp_path)
    child.wait_for("listening on")
    assert child.interrupt() == 0
    said = lines(child, path)
    assert (
        said[0] == "the file was damaged; it is kept as room.sqlite.damaged-1, what is whole was taken over"
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
    newer = f"was made by a newer SHARE (schema {SCHEMA + 1}, this one knows {SCHEMA})"
    assert child.said == f"share: {path}: {newer}; use that, or give another file\n"
    assert path.read_bytes() == before


def test_what_is_no_map(path, tmp_path):
    path.write_text("notes")
    child = edge(tmp_path)
    assert child.wait(20) == 2
    assert child.said == f"share: {path}: is not a map of SHARE, and was left as it is; give another file\n"
    assert path.read_text() == "notes"


def test_a_map_in_use(path, tmp_path):
    first = edge(tmp_path)
    first.wait_for("listening on")
    second = edge(tmp_path, "second")
    assert second.wait(20) == 1
    assert second.said == f"share: {path}: another edge uses this map; end it, or give another file\n"
    assert first.interrupt() == 0
    assert lines(first, path) == ["40 keyframes of 2 runs, 5 loops"]
    assert "Traceback" not in first.said


def test_a_disk_that_is_full_for_a_while(tmp_path):
    """Nobody is kept waiting; what came meanwhile is in the file once there is space again."""
    child = edge(tmp_path)
    address = child.wait_for(r"listening on (tcp://\S+?),")[1]
    limits = resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
    (ann,) = crowd(("ann",), address, frames=120)
    ann.start()
    child.wait_for("the map cannot be written")
    time.sleep(1.5)
    assert ann.machine.report()["open"] <= 2  # acknowledged all the same
    resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE, limits)
    child.wait_for("the map is kept again")
    ann.finish()
    ann.join(20)
    assert ann.error is None
    assert child.interrupt() == 0
    assert child.said.count("the map cannot be written") == 1
    with MapStore.open(tmp_path / "room.sqlite") as store:
        numbers = [k.at.id for k in store.load().keyframes]
    assert numbers == list(range(ann.machine.report()["keyframes"]))
    assert len(numbers) > 5
