"""Exports are opened by others' readers, and hold the values of the scene."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.recordings import HEIGHT, WIDTH, make_euroc, picture

from share.errors import ShareError, UsageError
from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.recordings.exports.colmap import write_colmap
from share.recordings.exports.kitti import write_kitti
from share.recordings.exports.mcap_scene import write_mcap
from share.recordings.exports.names import plain_names
from share.recordings.exports.rerun_file import write_rerun
from share.recordings.exports.scene import Scene, SceneAgent, SceneView
from share.recordings.trajectory import Trajectory
from share.runtime.source import open_source

START_NS = 1_700_000_000_123_456_789
LENSES = {
    "PINHOLE": Camera(WIDTH, HEIGHT, 50.0, 51.0, 31.25, 23.5),
    "OPENCV": Camera(WIDTH, HEIGHT, 50.0, 51.0, 31.25, 23.5, (-0.1, 0.01, 1e-3, -2e-3)),
    "FULL_OPENCV": Camera(WIDTH, HEIGHT, 50.0, 51.0, 31.25, 23.5, (-0.1, 0.01, 1e-3, -2e-3, 0.002)),
    "OPENCV_FISHEYE": Camera(WIDTH, HEIGHT, 50.0, 51.0, 31.25, 23.5, (0.01, 2e-3, 0.0, 0.0), "equidistant"),
}


def nothing(done: int) -> None:
    pass


def jpeg_of(number: int) -> bytes:
    return cv2.imencode(".jpg", picture(number))[1].tobytes()


def rig(lens: str = "OPENCV") -> Rig:
    T_body_cam0 = se3.exp(np.array([0.1, -0.2, 0.3, 0.01, 0.02, 0.03]))
    cam = LENSES[lens]
    T_cam1_cam0 = se3.exp(np.array([0.0, 0.01, 0.0, -0.05, 0.0, 0.0]))
    return Rig(cam, T_body_cam0, cam, T_cam1_cam0, imu=ImuNoise(1e-4, 2e-3, 1e-5, 3e-3, 200.0))


def scene(lens: str = "OPENCV", agents: tuple[str, ...] = ("ann", "2 böb")) -> Scene:
    rng = np.random.default_rng(5)
    made, views = {}, []
    for k, name in enumerate(agents):
        stamps = START_NS + 100_000_000 * np.arange(6, dtype=np.int64) + k
        T = np.array([se3.exp(rng.normal(size=6) * 0.3) for _ in stamps])
        made[name] = SceneAgent(Trajectory(stamps, T), rig(lens))
        for i in (0, 2, 4):
            points = np.column_stack([rng.uniform(-1, 1, (8, 2)), rng.uniform(2, 5, 8)])
            views.append(
                SceneView(name, i, int(stamps[i]), T[i], points, lambda k=k, i=i: jpeg_of(10 * k + i))
            )
    return Scene("room", "map", made, views)


# ---------------------------------------------------------------- COLMAP


def colmap_model(folder: Path) -> tuple[dict, list, dict]:
    """Cameras, images and points, read by the words of COLMAP's format page."""

    def rows(name: str) -> list[list[str]]:
        return [line.split() for line in (folder / "sparse/0" / name).read_text().splitlines()]

    cameras = {row[0]: (row[1], [float(value) for value in row[2:]]) for row in rows("cameras.txt")}
    lines = rows("images.txt")
    images = [(*pair, None)[:2] for pair in zip(lines[::2], lines[1::2], strict=True)]
    points = {row[0]: [float(value) for value in row[1:4]] for row in rows("points3D.txt")}
    return cameras, images, points


@pytest.mark.parametrize("lens", LENSES)
def test_colmap_features_are_the_projections_of_their_points(lens, tmp_path):
    """By OpenCV's lens models, with pixel centres at halves."""
    write_colmap(scene(lens), tmp_path, nothing)
    cameras, images, points = colmap_model(tmp_path)
    assert len(images) == 6 and len(points) > 20
    seen = 0
    for pose, features in images:
        model, (width, height, fx, fy, cx, cy, *d) = cameras[pose[8]]
        assert (model, width, height) == (lens, WIDTH, HEIGHT)
        assert cv2.imread(str(tmp_path / "images" / pose[9])).shape == (HEIGHT, WIDTH, 3)
        w, x, y, z, *t = map(float, pose[1:8])
        T = se3.from_quat(np.array(t), np.array([x, y, z, w]))
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        for u, v, number in zip(features[::3], features[1::3], features[2::3], strict=True):
            X = se3.transform(T, np.array([points[number]]))
            if lens == "OPENCV_FISHEYE":
                px = cv2.fisheye.distortPoints((X[:, :2] / X[:, 2:])[None], K, np.array(d))[0, 0]
            else:
                px = cv2.projectPoints(X, np.zeros(3), np.zeros(3), K, np.array(d or [0.0] * 4))[0][0, 0]
            assert px == pytest.approx([float(u), float(v)], abs=2e-3)
            seen += 1
    assert seen == len(points)


@pytest.mark.parametrize("lens", LENSES)
def test_pycolmap_opens_the_model(lens, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    write_colmap(scene(lens), tmp_path, nothing)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse/0"))
    assert model.num_reg_images() == 6 and len(model.cameras) == 2
    errors = [
        np.linalg.norm(image.project_point(model.points3D[p.point3D_id].xyz) - p.xy)
        for image in model.images.values()
        for p in image.points2D
    ]
    assert len(errors) == len(model.points3D) > 20
    assert max(errors) < 2e-3


def test_colmap_needs_pictures(tmp_path):
    bare = scene()
    views = [SceneView(v.agent, v.number, v.stamp_ns, v.T_world_body, v.points, bytes) for v in bare.views]
    with pytest.raises(UsageError, match="room: has no pictures, which a COLMAP model consists of"):
        write_colmap(Scene("room", "map", bare.agents, views), tmp_path, nothing)


# ---------------------------------------------------------------- KITTI


def test_kitti_poses_are_of_cam0_in_the_first_one(tmp_path):
    """Read by evo, which is not ours."""
    file_interface = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")
    made = scene()
    write_kitti(made, tmp_path, nothing)
    first = made.agents["ann"].trajectory.T[0] @ rig().T_body_cam0
    for name, file in (("ann", "ann"), ("2 böb", "_2_b_b")):
        read = file_interface.read_kitti_poses_file(str(tmp_path / f"{file}.txt"))
        expected = se3.inverse(first) @ made.agents[name].trajectory.T @ rig().T_body_cam0
        assert np.allclose(read.poses_se3, expected, atol=1e-8)
    assert np.allclose(np.loadtxt(tmp_path / "ann.txt")[0].reshape(3, 4), np.eye(4)[:3])
    assert np.loadtxt(tmp_path / "ann.times.txt").tolist() == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.5])


# ---------------------------------------------------------------- MCAP


def messages_of(path: Path) -> dict[str, list]:
    """Messages by topic, by rosbags, which is not ours."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    out: dict[str, list] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, at_ns, data in reader.messages():
            out.setdefault(connection.topic, []).append((at_ns, reader.deserialize(data, connection.msgtype)))
    return out


def pose_of(position, q) -> np.ndarray:
    return se3.from_quat(np.array([position.x, position.y, position.z]), np.array([q.x, q.y, q.z, q.w]))


def test_mcap_has_the_room_moving(tmp_path):
    made = scene()
    write_mcap([made], tmp_path / "room.mcap", nothing)
    read = messages_of(tmp_path / "room.mcap")
    images = {
        f"/{name}/cam0/{topic}"
        for name in ("ann", "_2_b_b")
        for topic in ("camera_info", "image_raw/compressed")
    }
    assert read.keys() == {"/tf", "/tf_static", "/points", "/ann/pose", "/_2_b_b/pose"} | images
    for (at_ns, stamped), stamp_ns, T in zip(
        read["/ann/pose"],
        made.agents["ann"].trajectory.stamps_ns,
        made.agents["ann"].trajectory.T,
        strict=True,
    ):
        assert at_ns == stamp_ns == stamped.header.stamp.sec * 10**9 + stamped.header.stamp.nanosec
        assert stamped.header.frame_id == "map"
        assert np.allclose(pose_of(stamped.pose.position, stamped.pose.orientation), T, atol=1e-9)
    tf = [t for _, m in read["/tf"] for t in m.transforms]
    assert {(t.header.frame_id, t.child_frame_id) for t in tf} == {
        ("map", "ann/body"),
        ("map", "_2_b_b/body"),
    }
    static = {t.child_frame_id: t for _, m in read["/tf_static"] for t in m.transforms}
    assert {n: t.header.frame_id for n, t in static.items()} == {
        f"{a}/{child}": f"{a}/{parent}"
        for a in ("ann", "_2_b_b")
        for child, parent in (("cam0", "body"), ("cam1", "cam0"))
    }
    mount = static["ann/cam0"].transform
    assert np.allclose(pose_of(mount.translation, mount.rotation), rig().T_body_cam0, atol=1e-9)


def test_each_image_of_an_mcap_has_its_camera_info(tmp_path):
    write_mcap([scene()], tmp_path / "room.mcap", nothing)
    read = messages_of(tmp_path / "room.mcap")
    images, infos = read["/ann/cam0/image_raw/compressed"], read["/ann/cam0/camera_info"]
    assert len(images) == 3
    assert [i.header for _, i in infos] == [i.header for _, i in images]
    assert images[0][1].header.frame_id == "ann/cam0"
    assert cv2.imdecode(images[1][1].data, cv2.IMREAD_GRAYSCALE).shape == (HEIGHT, WIDTH)


def test_the_point_cloud_has_the_points_of_all_views(tmp_path):
    made = scene()
    write_mcap([made], tmp_path / "room.mcap", nothing)
    ((_, cloud),) = messages_of(tmp_path / "room.mcap")["/points"]
    assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("rgb", 12, 7),
    ]
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (1, 48, 16, 48 * 16)
    xyz = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 4)[:, :3]
    assert np.allclose(xyz, np.concatenate([made.world_points(view) for view in made.views]), atol=1e-5)
    assert len(np.unique(np.frombuffer(cloud.data.tobytes(), "<u4").reshape(-1, 4)[:, 3])) == 2


def test_mcap_ros2_decodes_all(tmp_path):
    decoder = pytest.importorskip("mcap_ros2.reader", reason="mcap-ros2-support is not installed")
    write_mcap([scene()], tmp_path / "room.mcap", nothing)
    kinds = [type(m.ros_msg).__name__ for m in decoder.read_ros2_messages(str(tmp_path / "room.mcap"))]
    assert {k: kinds.count(k) for k in set(kinds)} == {
        "TFMessage": 13, "PoseStamped": 12, "PointCloud2": 1, "CompressedImage": 6, "CameraInfo": 6,
    }  # fmt: skip


def test_several_maps_have_frames_of_their_own(tmp_path):
    one, two = scene(agents=("ann",)), scene(agents=("bob",))
    two = Scene("bob-2/0", "map", two.agents, two.views)
    write_mcap([one, two], tmp_path / "rooms.mcap", nothing)
    read = messages_of(tmp_path / "rooms.mcap")
    assert {t.header.frame_id for _, m in read["/tf"] for t in m.transforms} == {"room", "bob_2_0"}
    assert {"/room/points", "/bob_2_0/points"} <= read.keys()


# ---------------------------------------------------------------- Rerun


def test_rerun_is_an_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ShareError, match="rerun-sdk is not installed"):
        write_rerun([scene()], tmp_path / "room.rrd", nothing)
    assert list(tmp_path.iterdir()) == []


def test_rerun_reads_its_file(tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    write_rerun([scene()], tmp_path / "room.rrd", nothing)
    assert [path.name for path in tmp_path.iterdir()] == ["room.rrd"]
    command = [shutil.which("rerun", path=str(Path(sys.executable).parent)) or "rerun"]
    printed = subprocess.run(
        [*command, "rrd", "print", tmp_path / "room.rrd"],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    ).stdout
    for entity in (
        "/room/ann/body",
        "/room/_2_b_b/path",
        "/room/ann/body/cam0/image/picture",
        "/room/ann/points/4",
    ):
        assert entity in printed


# ---------------------------------------------------------------- names, and the command


def test_plain_names_are_distinct_and_allowed():
    names = plain_names(["ann", "a b", "a_b", "a-b", "2nd", "ä/0", ""])
    assert list(names.values()) == ["ann", "a_b", "a_b_2", "a_b_3", "_2nd", "__0", "_"]


@pytest.mark.long
def test_a_recording_is_tracked_and_exported(plain_session, tmp_path, share):
    """All streams are there, and the poses of `share track`."""
    from share.recordings.trajectory import read_tum

    out = tmp_path / "ar1.mcap"
    done = share("dataset", "export", plain_session / "ar1", "--format", "mcap", "--out", out)
    assert done.code == 0, done.err
    assert share("track", plain_session / "ar1", "--out", tmp_path / "t.tum").code == 0
    read, tracked = messages_of(out), read_tum(tmp_path / "t.tum")
    counts = {topic: len(found) for topic, found in read.items()}
    recorded = {
        name: len(stamps) for name, stamps in open_source(str(plain_session / "ar1")).stamps().items()
    }
    assert counts["/ar1/pose"] == counts["/tf"] == len(tracked.stamps_ns)
    for cam in ("cam0", "cam1"):
        (images,) = (n for topic, n in counts.items() if topic.startswith(f"/ar1/{cam}/image_raw"))
        assert images == counts[f"/ar1/{cam}/camera_info"] == recorded[cam]
    assert counts["/ar1/imu0"] == recorded["imu"] and counts["/points"] == 1
    p = [m.pose.position for _, m in read["/ar1/pose"]]
    assert np.allclose([(v.x, v.y, v.z) for v in p], tracked.T[:, :3, 3], atol=1e-8)
    again = open_source(str(out))  # and it is a recording itself
    assert again.rig.kind == "stereo+imu" and len(again.stamps()["cam1"]) == recorded["cam1"]


@pytest.mark.parametrize(("kind", "suffix"), [("mcap", ".mcap"), ("rrd", ".rrd")])
def test_files_need_their_suffix(kind, suffix, tmp_path, share):
    (tmp_path / "odom.tum").write_text("1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n")
    done = share("dataset", "export", tmp_path, "--format", kind, "--out", tmp_path / "x")
    assert done.code == 2 and f"give a name that ends in {suffix}" in done.err


def test_a_run_is_exported(tmp_path, share):
    for name, last in (("ann", 1), ("bob", 2)):
        (tmp_path / "run" / name).mkdir(parents=True)
        lines = "".join(f"{100 + i}.5 {i * last} 0 0 0 0 0 1\n" for i in range(3))
        (tmp_path / "run" / name / "map.tum").write_text(lines)
    (tmp_path / "run" / "edge").mkdir()
    assert (
        share("dataset", "export", tmp_path / "run", "--format", "kitti", "--out", tmp_path / "k").code == 0
    )
    assert np.loadtxt(tmp_path / "k" / "bob.txt")[2].tolist() == [1, 0, 0, 4, 0, 1, 0, 0, 0, 0, 1, 0]
    assert (
        share("dataset", "export", tmp_path / "run", "--format", "mcap", "--out", tmp_path / "r.mcap").code
        == 0
    )
    assert messages_of(tmp_path / "r.mcap").keys() == {"/tf", "/ann/pose", "/bob/pose"}
    done = share("dataset", "export", tmp_path / "run", "--format", "colmap", "--out", tmp_path / "c")
    assert done.code == 2 and "has no pictures" in done.err
    assert not (tmp_path / "c").exists()


def test_tum_is_of_maps(tmp_path, share):
    bag = make_euroc(tmp_path / "euroc")
    done = share("dataset", "export", bag, "--out", tmp_path / "o")
    assert done.code == 2 and done.err.count("\n") == 1
