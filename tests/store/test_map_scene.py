"""A map as scenes: keyframes with their pictures, in each map's frame."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers.map_changes import ANN, keyframe, pose, run, small_map

from share.errors import UsageError
from share.geometry import se3
from share.mapping.map_changes import SaveKeyframe
from share.runtime.scenes import map_scenes
from share.store.map_store import MapStore
from share.types import KeyframeImage


def with_picture(change):
    """The change; a keyframe with a picture of its rig's size, whose gray level is its number."""
    if not isinstance(change, SaveKeyframe):
        return change
    rig = run(change.run_key).hello.rig
    gray = np.full((rig.cam0.height, rig.cam0.width), change.keyframe.id, np.uint8)
    jpeg = np.frombuffer(cv2.imencode(".jpg", gray)[1].tobytes(), np.uint8)
    image = replace(change.keyframe.image, jpeg=jpeg)
    assert isinstance(image, KeyframeImage)
    return replace(change, keyframe=replace(change.keyframe, image=image))


def written(path, changes):
    with MapStore.open(path) as store:
        store.write(changes)
    return MapStore.read(path).load(), path


def test_a_map_is_a_scene(tmp_path):
    (scene,) = map_scenes(*written(tmp_path / "room.sqlite", [with_picture(c) for c in small_map()]))
    assert (scene.name, scene.frame, list(scene.agents)) == (f"{ANN}/0", "map", ["ann", "bob"])
    assert np.allclose(scene.agents["bob"].trajectory.T, [pose(7) @ pose(i) for i in range(20)])
    assert len(scene.views) == 40
    view = next(v for v in scene.views if (v.agent, v.number) == ("ann", 3))
    assert cv2.imdecode(np.frombuffer(view.jpeg(), np.uint8), 0)[5, 5] == pytest.approx(3, abs=1)
    T_map_cam0 = pose(7) @ pose(3) @ run(ANN).hello.rig.T_body_cam0
    points = keyframe(ANN, 3).keyframe.points.astype(float)
    assert np.allclose(scene.world_points(view), se3.transform(T_map_cam0, points), atol=1e-5)


def test_an_empty_map_is_refused(tmp_path):
    with pytest.raises(UsageError, match="the map is empty"):
        map_scenes(*written(tmp_path / "room.sqlite", []))


@pytest.mark.parametrize("kind", ["colmap", "kitti", "mcap"])
def test_the_command_exports_a_map(kind, tmp_path, share):
    written(tmp_path / "room.sqlite", [with_picture(c) for c in small_map()])
    out = tmp_path / ("out.mcap" if kind == "mcap" else "out")
    done = share("dataset", "export", tmp_path / "room.sqlite", "--format", kind, "--out", out)
    assert done.code == 0, done.err
    assert f"map {ANN}/0" in done.out or f"{ANN}/0, 40 poses of ann, bob; 40 keyframes" in done.out
    if kind == "colmap":
        assert len(list((out / "images").iterdir())) == 40
        assert len((out / "sparse/0/cameras.txt").read_text().splitlines()) == 2
    again = share("dataset", "export", tmp_path / "room.sqlite", "--format", kind, "--out", out)
    assert again.code == 2 and again.err.count("\n") == 1


def test_pictures_of_a_map_may_be_gone(tmp_path, share):
    """Of a map without any, the poses are left."""
    written(tmp_path / "room.sqlite", small_map())
    done = share(
        "dataset", "export", tmp_path / "room.sqlite", "--format", "mcap", "--out", tmp_path / "r.mcap"
    )
    assert done.code == 0, done.err
    done = share("dataset", "export", tmp_path / "room.sqlite", "--format", "colmap", "--out", tmp_path / "c")
    assert done.code == 2 and "has no pictures" in done.err
