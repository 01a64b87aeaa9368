"""Exported files hold the values of the map."""

import csv
import os

import numpy as np
import pytest
from helpers.hellos import hello_of
from helpers.map_changes import ANN, BOB, keyframe, loop, pose, run, small_map, solution

from share.colours import AGENT_COLOURS as COLOURS
from share.errors import UsageError
from share.geometry import se3
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SaveLoop, SaveRun, map_poses
from share.recordings.trajectory import read_tum
from share.store.export import export_map, file_names
from share.store.map_store import MapStore
from share.types import AgentKind


def nothing(done):
    pass


def kept_of(tmp_path, changes):
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write(changes)
        return store.load()


def read_ply(path):
    """Read a PLY file: points (N, 3) and colours (N, 3)."""
    head, _, data = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[2].split()[:2] == ["element", "vertex"]
    kinds = {"float": "<f4", "uchar": "u1"}
    properties = [line.split() for line in lines[3:]]
    assert all(word == "property" for word, *_ in properties)
    table = np.frombuffer(data, [(name, kinds[kind]) for _, kind, name in properties])
    assert len(table) == int(lines[2].split()[2])
    return tuple(
        np.stack([table[n] for n in names], 1) for names in (("x", "y", "z"), ("red", "green", "blue"))
    )


def test_one_map_is_exported(tmp_path):
    kept = kept_of(tmp_path, small_map())
    counted = []
    done = export_map(kept, tmp_path / "out", counted.append)
    assert sorted(os.listdir(tmp_path / "out")) == ["ann.tum", "bob.tum", "loops.csv", "points.ply"]
    stamps, T = read_tum(tmp_path / "out" / "bob.tum")
    assert stamps.tolist() == [10**9 + i * 10**8 for i in range(20)]
    assert np.allclose(T, [pose(7) @ pose(i) for i in range(20)], atol=1e-8)
    points, colours = read_ply(tmp_path / "out" / "points.ply")
    assert len(points) == done[f"{ANN}/0"].points == 40 * 43
    assert sum(counted) == 40
    third = keyframe(ANN, 1).keyframe.points  # ann 0, bob 0, ann 1
    expected = se3.transform(pose(7) @ pose(1) @ run(ANN).hello.rig.T_body_cam0, third.astype(float))
    assert np.allclose(points[86:129], expected, atol=1e-5)
    assert [tuple(c) for c in colours[[0, 43, 86]]] == [COLOURS[0], COLOURS[1], COLOURS[0]]
    rows = list(csv.DictReader((tmp_path / "out" / "loops.csv").read_text().splitlines()))
    assert [(r["a_run"], r["a"], r["b_run"], r["b"], r["inliers"]) for r in rows][1] == (
        ANN,
        "4",
        BOB,
        "4",
        "24",
    )
    assert float(rows[1]["z"]) == pytest.approx(loop(4, 4).T_a_b[2, 3], abs=1e-8)


def test_points_of_unknown_depth_are_left_out(tmp_path):
    kept = kept_of(tmp_path, small_map(1))
    hidden = np.array(kept.keyframes[0].keyframe.view.points)
    hidden[3:10, 2] = np.nan
    object.__setattr__(kept.keyframes[0].keyframe.view, "points", hidden)
    export_map(kept, tmp_path / "out", nothing)
    found, _ = read_ply(tmp_path / "out" / "points.ply")
    assert len(found) == 86 - 7
    assert np.isfinite(found).all()


def test_several_maps_have_folders_and_runs_of_one_name_files(tmp_path):
    again = SaveRun("ann-0003", hello_of("ann", 3, AgentKind.ROBOT))
    changes = [run(ANN), run(BOB), again]
    changes += [keyframe(key, i) for i in range(3) for key in (ANN, BOB, "ann-0003")]
    kept = kept_of(tmp_path, [*changes, solution([KeyframeKey(k, i) for k in (ANN, BOB) for i in range(3)])])
    done = export_map(kept, tmp_path / "out", nothing)
    assert set(done) == {f"{ANN}/0", "ann-0003/0"}
    assert sorted(os.listdir(tmp_path / "out" / "ann-0001.0")) == [
        "ann-0001.tum",
        "bob.tum",
        "loops.csv",
        "points.ply",
    ]
    assert sorted(os.listdir(tmp_path / "out" / "ann-0003.0")) == ["ann-0003.tum", "loops.csv", "points.ply"]
    alone = read_tum(tmp_path / "out" / "ann-0003.0" / "ann-0003.tum")
    assert np.allclose(alone.T, [pose(i) for i in range(3)], atol=1e-8)


def test_a_name_that_is_another_runs_key_gives_the_key(tmp_path):
    sly = SaveRun("ann-0001-0009", hello_of(ANN, 9))
    kept = kept_of(tmp_path, [run(ANN), sly])
    assert file_names(kept) == {ANN: "ann", "ann-0001-0009": "ann-0001-0009"}


def test_keyframes_after_the_solution_follow_their_references(tmp_path):
    kept = kept_of(tmp_path, [*small_map(), keyframe(ANN, 20), keyframe(ANN, 21)])
    name, T = map_poses(kept)[KeyframeKey(ANN, 21)]
    assert name == f"{ANN}/0"
    assert np.allclose(T, pose(7) @ pose(21), atol=1e-9)


def test_empty_maps_and_folders_in_use_are_refused(tmp_path):
    kept = kept_of(tmp_path, [run(ANN), SaveLoop(loop(1, 1))])
    with pytest.raises(UsageError, match="the map is empty"):
        export_map(kept, tmp_path / "out", nothing)
    with MapStore.open(tmp_path / "room.sqlite") as store:
        store.write([keyframe(ANN, 0)])
        kept = store.load()
    with pytest.raises(UsageError, match="exists and is not an empty folder"):
        export_map(kept, tmp_path, nothing)

    def breaks(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_map(kept, tmp_path / "out", breaks)
    assert sorted(os.listdir(tmp_path)) == ["room.sqlite", "room.sqlite.lock"]
