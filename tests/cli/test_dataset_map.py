"""`share dataset info` and `export` of a map."""

import json
import os

import pytest
from helpers.map_changes import keyframe, small_map
from test_dataset import bad, good, share

from share.store.map_store import MapStore


@pytest.fixture
def room(tmp_path):
    path = tmp_path / "room.sqlite"
    with MapStore.open(path) as store:
        store.write(small_map())
    return path


@pytest.mark.long
def test_info(room):
    text = good("info", room)
    assert text.startswith("room.sqlite: map, schema 5, 0.4 MB\n")
    assert "  bob        ar         20 keyframes, 0 removed\n" in text
    assert "  map ann-0001/0: 40 keyframes\n" in text
    assert "  5 loops, 40 keyframes in the latest solution\n" in text
    data = json.loads(good("info", room, "--json"))
    assert (data["agents"]["ann"]["next_keyframe"], data["agents"]["ann"]["segments"]) == (20, 1)
    assert data["damage"] == []
    assert "is a map; --calib and --frames" in bad(2, "info", room, "--frames", "0:3")


@pytest.mark.long
def test_damage_of_a_map_is_reported_and_the_file_unchanged(room, tmp_path):
    frames = bytearray(room.read_bytes())
    at = frames.index(keyframe("ann-0001", 9).keyframe.view.descriptors.tobytes()[:40])
    frames[at] ^= 8
    room.write_bytes(frames)
    text = good("info", room)
    assert "  damage: 1 keyframes could not be read\n" in text
    done = share("export", room, "--out", tmp_path / "out")
    assert done.returncode == 0
    assert "1 keyframes could not be read" in done.stderr
    assert room.read_bytes() == bytes(frames)
    assert sorted(os.listdir(tmp_path)) == ["out", "room.sqlite", "room.sqlite.lock"]


@pytest.mark.long
def test_export_works_while_an_edge_writes(room, tmp_path):
    with MapStore.open(room) as store:
        store.write([keyframe("ann-0001", 20)])
        said = good("export", room, "--out", tmp_path / "out")
        store.write([keyframe("ann-0001", 21)])
    assert said == (f"{tmp_path}/out: map ann-0001/0, 41 keyframes of ann, bob; 1763 points, 5 loops\n")
    assert len((tmp_path / "out" / "ann.tum").read_text().splitlines()) == 21
    data = json.loads(good("export", room, "--out", tmp_path / "two", "--json"))
    assert data["ann-0001/0"]["keyframes"] == 42


@pytest.mark.long
def test_wrong_use(room, tmp_path):
    assert "no such file" in bad(2, "export", tmp_path / "no", "--out", tmp_path / "out")
    assert "is not an empty folder" in bad(2, "export", room, "--out", tmp_path)
    (tmp_path / "text").write_text("no map at all")
    assert "is not a SHARE map" in bad(2, "export", tmp_path / "text", "--out", tmp_path / "out")
    (tmp_path / "empty").write_text("")
    assert "contains no map" in bad(2, "export", tmp_path / "empty", "--out", tmp_path / "out")
    assert "below a file" in bad(2, "export", room, "--out", room / "out")
    assert "Example:  share dataset export " in good("export", "--help")
