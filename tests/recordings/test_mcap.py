"""MCAP recordings come back bit for bit, rosbags reads them, and recordings of others are read."""

import dataclasses
import os
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.live import CAMERA, RIG, frames, live
from helpers.recordings import HEIGHT, STEP_NS, WIDTH, depth_mm, make_euroc, make_tum, picture

from share.errors import ConfigError, DataError, UsageError
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.lab.calibrate.imu_table import read_imu
from share.recordings.calibration import kalibr_texts
from share.recordings.convert import to_euroc, to_mcap
from share.recordings.describe import describe_recording
from share.recordings.images import ArrayImage
from share.recordings.mcap import rig as ros_rig
from share.recordings.mcap import ros_messages as ros
from share.recordings.mcap.recorder import Recorder
from share.recordings.recording import FolderSource
from share.runtime.source import open_source
from share.sensors.measurement import Measurement


def assert_same(a, b):
    """Assert that two lists of frames are equal to the last bit."""
    assert [f.stamp_ns for f in a] == [f.stamp_ns for f in b]
    for f, g in zip(a, b, strict=True):
        assert f.gap_ns == g.gap_ns
        for name in ("image0", "image1", "depth"):
            x, y = getattr(f, name), getattr(g, name)
            assert (x is None) == (y is None)
            assert x is None or (x.dtype == y.dtype and np.array_equal(x, y))
        for name in ("stamps_ns", "gyro", "accel"):
            assert np.array_equal(getattr(f.imu, name), getattr(g.imu, name))


def assert_same_rig(a: Rig, b: Rig):
    assert (a.cam0, a.cam1, a.depth, a.imu, a.timeshift_s) == (b.cam0, b.cam1, b.depth, b.imu, b.timeshift_s)
    for name in ("T_body_cam0", "T_cam1_cam0", "T_depth_cam0"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None and y is None) or np.array_equal(x, y)


def with_timeshift(source: FolderSource, part: slice | None = None) -> FolderSource:
    """Return the recording with a timeshift of 20 ms."""
    rig = dataclasses.replace(source.rig, timeshift_s=0.02)
    return FolderSource(Path("walk"), rig, source.images, source.losses, source.imu, frames=part)


def nothing(done: int) -> None:
    pass


@pytest.fixture(params=["euroc", "tum"])
def folder(request, tmp_path):
    return (make_euroc if request.param == "euroc" else make_tum)(tmp_path / "walk")


def test_a_recording_comes_back_bit_for_bit(folder, tmp_path):
    source, out = open_source(str(folder)), tmp_path / "out" / "walk.mcap"
    to_mcap(source, out, None, nothing)
    back = open_source(str(out))
    assert back.name == "walk"
    assert_same(frames(source), frames(back))
    assert_same_rig(source.rig, back.rig)
    np.testing.assert_allclose(back.truth().T, source.truth().T, atol=1e-8)
    assert sorted(os.listdir(out.parent)) == ["walk.mcap", "walk.truth.tum"]
    assert describe_recording(back)["streams"] == describe_recording(source)["streams"]
    part = slice(2, 4)
    assert_same(frames(open_source(str(folder), frames=part)), frames(open_source(str(out), frames=part)))


@pytest.mark.long
@pytest.mark.parametrize("name", ["euroc_v1_01_keyframes", "redkitchen_0000_0499"])
def test_real_recordings_come_back_bit_for_bit(shared_data, tmp_path, name):
    part = slice(0, 40)
    source = open_source(str(shared_data / "real" / name), frames=part)
    to_mcap(source, tmp_path / "real.mcap", None, nothing)
    assert_same(frames(source), frames(open_source(str(tmp_path / "real.mcap"))))


def test_asl_folder_comes_back(tmp_path):
    source = open_source(str(make_euroc(tmp_path / "walk")))
    to_euroc(source, tmp_path / "copy", nothing)
    back = open_source(str(tmp_path / "copy"))
    assert_same(frames(source), frames(back))
    np.testing.assert_allclose(back.rig.T_cam1_cam0, source.rig.T_cam1_cam0, atol=1e-12)
    np.testing.assert_allclose(back.truth().T, source.truth().T, atol=1e-9)
    with pytest.raises(UsageError, match="cannot hold depth"):
        to_euroc(open_source(str(make_tum(tmp_path / "rgbd"))), tmp_path / "x", nothing)
    assert not (tmp_path / "x").exists()
    shifted = with_timeshift(source)
    with pytest.raises(UsageError, match="cannot hold the cameras' timeshift"):
        to_euroc(shifted, tmp_path / "x", nothing)
    assert not (tmp_path / "x").exists()


def test_a_part_of_a_recording_with_a_timeshift(tmp_path):
    """IMU samples are selected by the IMU's clock, in a folder as in MCAP."""
    source = open_source(str(make_euroc(tmp_path / "walk")))
    shifted = with_timeshift(source)
    to_mcap(shifted, tmp_path / "walk.mcap", None, nothing)
    whole = frames(shifted)
    part = frames(open_source(str(tmp_path / "walk.mcap"), frames=slice(2, 4)))
    assert_same(part, whole[2:4])
    assert_same(frames(with_timeshift(source, slice(2, 4))), part)
    assert part[-1].imu.stamps_ns[-1] == part[-1].stamp_ns + 20_000_000


def test_rosbags_reads_it_as_ros_2(folder, tmp_path):
    from rosbags.highlevel import AnyReader

    source, out = open_source(str(folder)), tmp_path / "walk.mcap"
    to_mcap(source, out, None, nothing)
    with AnyReader([out]) as reader:
        kinds = {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}
        seen = [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages()]
    n = source.images_count
    assert kinds["/cam0/image_raw/compressed"] == ("sensor_msgs/msg/CompressedImage", n)
    assert kinds["/cam0/camera_info"] == ("sensor_msgs/msg/CameraInfo", n)
    infos = [message.header for topic, message in seen if topic == "/cam0/camera_info"]
    assert infos == [message.header for topic, message in seen if topic == "/cam0/image_raw/compressed"]
    assert kinds["/tf_static"] == ("tf2_msgs/msg/TFMessage", 1)
    if source.rig.imu:
        first = next(m for topic, m in seen if topic == "/imu0")
        sample = next(m for m in source.measurements() if m.stream == "imu")
        assert ros.stamp_of(first) == sample.stamp_ns
        assert first.linear_acceleration.z == sample.payload[5]
    else:
        assert kinds["/depth/image_raw/compressedDepth"] == ("sensor_msgs/msg/CompressedImage", n)
        depth = next(m for topic, m in seen if topic.startswith("/depth/image"))
        assert depth.format == "16UC1; compressedDepth png"
        image = cv2.imdecode(depth.data[12:], cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(image, depth_mm(0))


@pytest.mark.parametrize(("scale", "encoding"), [(1000.0, "16UC1"), (5000.0, "32FC1")])
def test_raw_arrays_are_exact_in_either_depth_encoding(tmp_path, scale, encoding):
    path = tmp_path / "live.mcap"
    with Recorder(path, RIG) as recorder:
        for m in live(4, scale):
            recorder.write(m)
    source = open_source(str(path))
    out = frames(source)
    assert_same_rig(source.rig, RIG)
    for i, f in enumerate(out):
        np.testing.assert_array_equal(f.image0, picture(i))
        np.testing.assert_array_equal(f.depth, depth_mm(i) / np.float32(scale))
    assert len(out) == 4
    messages = source.file.messages(["/depth/image_raw"])
    assert ros.decode(next(messages)[2], ros.IMAGE, "depth").encoding == encoding


def test_jpeg_is_close_and_small(tmp_path):
    for name, quality in (("raw", None), ("jpeg", 80)):
        with Recorder(tmp_path / f"{name}.mcap", RIG, jpeg=quality) as recorder:
            for m in live(3):
                recorder.write(m)
    image = frames(open_source(str(tmp_path / "jpeg.mcap")))[0].image0
    assert 0 < np.abs(image.astype(int) - picture(0)).mean() < 4


def test_the_timeshift_is_recorded():
    shifted = dataclasses.replace(RIG, timeshift_s=-0.0123456789)
    assert_same_rig(ros_rig.rig_from_json(ros_rig.rig_to_json(shifted), "x"), shifted)
    with pytest.raises(DataError, match="timeshift_s: 2 is not within 1 s"):
        ros_rig.rig_from_json(ros_rig.rig_to_json(RIG)[:-1] + ', "timeshift_s": 2}', "x")


def test_the_rig_record_names_only_lens_models_other_than_radtan():
    """Earlier releases, which know no lens models, still read recordings with radtan lenses."""
    assert "model" not in ros_rig.rig_to_json(RIG)
    fisheye = dataclasses.replace(
        RIG, cam0=dataclasses.replace(CAMERA, distortion=(0.01,) * 4, model="equidistant")
    )
    assert_same_rig(ros_rig.rig_from_json(ros_rig.rig_to_json(fisheye), "x"), fisheye)


def test_the_rig_survives_as_ros_messages():
    """CameraInfo and /tf_static give the same rig as our own record, but for rounding."""
    tree = ros_rig.FrameTree([ros_rig.to_tf(RIG, 0)], "here")
    np.testing.assert_allclose(tree.find("body", "cam0"), RIG.T_body_cam0, atol=1e-12)
    np.testing.assert_allclose(tree.find("depth", "cam0"), RIG.T_depth_cam0, atol=1e-12)
    assert tree.find("cam0", "moon") is None
    info = ros_rig.to_camera_info(CAMERA, ros.make_header(0, "cam0"))
    back = ros_rig.from_camera_info(info, "x")
    assert (back.fx, back.fy, back.cx, back.cy) == (50.0, 51.0, 31.5, 23.5)
    assert back.distortion == (*CAMERA.distortion, 0.0)
    fisheye = dataclasses.replace(CAMERA, distortion=(0.01, 0.002, -0.003, 4e-4), model="equidistant")
    assert (
        ros_rig.from_camera_info(ros_rig.to_camera_info(fisheye, ros.make_header(0, "cam0")), "x") == fisheye
    )
    info.d = np.array([0.1] * 8)
    with pytest.raises(ConfigError, match="not supported"):
        ros_rig.from_camera_info(info, "x")


# ---------------------------------------------------------------- others' recordings


def raw_image(encoding: str, pixels: np.ndarray, padding: int = 0):
    rows = pixels.reshape(len(pixels), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    return {
        "height": HEIGHT,
        "width": WIDTH,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": rows.shape[1],
        "data": rows.reshape(-1),
    }


def write_foreign(path: Path, topics: dict, tf=None, info=CAMERA) -> Path:
    """Write a file as a ROS 2 recorder does. topics: name -> list of (type, fields)."""
    from mcap.writer import Writer

    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start("ros2", "someone else")
        schemas, extra = {}, {}
        if tf is not None:
            extra["/tf_static"] = [tf]
        for name in topics if info else ():
            frame = name.split("/")[2]
            message = ros_rig.to_camera_info(info, ros.make_header(10**9, frame))
            extra[name.rpartition("/")[0] + "/camera_info"] = [message]
        for name, messages in {**extra, **topics}.items():
            kind = messages[0].__msgtype__
            if kind not in schemas:
                schemas[kind] = writer.register_schema(kind, "ros2msg", ros.message_definition(kind))
            channel = writer.register_channel(name, "cdr", schemas[kind])
            for i, message in enumerate(messages):
                when = 10**9 + i * STEP_NS
                writer.add_message(channel, when + 3_000_000, ros.encode(message), when)
        writer.finish()
    return path


def image_messages(count: int, frame: str, make):
    return [
        ros.make_message(ros.IMAGE, header=ros.make_header(10**9 + i * STEP_NS, frame), **make(i))
        for i in range(count)
    ]


TF = ros_rig.to_tf(Rig(CAMERA, np.eye(4), CAMERA, se3.exp(np.array([0, 0, 0, -0.05, 0, 0.0]))), 0)
for _transform in TF.transforms:
    _transform.child_frame_id = {"cam0": "infra1", "cam1": "infra2"}[_transform.child_frame_id]
    _transform.header.frame_id = _transform.header.frame_id.replace("cam0", "infra1")


@pytest.mark.parametrize(
    ("encoding", "channels", "code", "padding"),
    [
        ("mono8", 1, None, 16),
        ("bgr8", 3, cv2.COLOR_BGR2GRAY, 0),
        ("rgb8", 3, cv2.COLOR_RGB2GRAY, 8),
        ("bgra8", 4, cv2.COLOR_BGRA2GRAY, 0),
    ],
)
def test_a_foreign_stereo_recording(tmp_path, encoding, channels, code, padding):
    topics = {
        f"/camera/{eye}/image_rect_raw": image_messages(
            3, eye, lambda i, k=k: raw_image(encoding, picture(i + k, channels), padding)
        )
        for k, eye in ((0, "infra1"), (50, "infra2"))
    }
    source = open_source(str(write_foreign(tmp_path / "d435.mcap", topics, TF)))
    assert source.rig.kind == "stereo"
    np.testing.assert_allclose(source.rig.T_cam1_cam0[:3, 3], [-0.05, 0, 0], atol=1e-12)
    out = frames(source)
    assert [f.stamp_ns for f in out] == [10**9 + i * STEP_NS for i in range(3)]
    for i, f in enumerate(out):
        expected = picture(i, channels) if code is None else cv2.cvtColor(picture(i, channels), code)
        np.testing.assert_array_equal(f.image0, expected)


def test_foreign_depth_and_calib_by_topic(tmp_path):
    topics = {
        "/robot/eye/image": image_messages(3, "eye", lambda i: raw_image("mono8", picture(i))),
        "/robot/tof/image": image_messages(3, "tof", lambda i: raw_image("16UC1", depth_mm(i))),
    }
    path = write_foreign(tmp_path / "robot.mcap", topics)
    with pytest.raises(ConfigError, match=r"cannot tell which topic is cam0.*/robot/eye/image.*rostopic"):
        open_source(str(path))
    cam = f"resolution: [{WIDTH}, {HEIGHT}], intrinsics: [50, 50, 32, 24]"
    T = "T_depth_cam0: [[1, 0, 0, 0.02], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    chain = tmp_path / "chain.yaml"
    chain.write_text(
        f"cam0: {{{cam}, rostopic: /robot/eye/image}}\ndepth: {{{cam}, {T}, rostopic: /robot/tof/image}}\n"
    )
    out = frames(open_source(str(path), calib=str(chain)))
    assert len(out) == 3
    np.testing.assert_array_equal(out[1].depth, depth_mm(1) / np.float32(1000))
    chain.write_text(chain.read_text().replace("/eye", "/nose"))
    with pytest.raises(ConfigError, match="has no topic /robot/nose/image"):
        open_source(str(path), calib=str(chain))


def test_foreign_recordings_without_calibration_are_refused(tmp_path):
    eyes = {
        f"/camera/{eye}/image": image_messages(2, eye, lambda i: raw_image("mono8", picture(i)))
        for eye in ("infra1", "infra2")
    }
    with pytest.raises(ConfigError, match="tf_static lacks"):
        open_source(str(write_foreign(tmp_path / "a.mcap", eyes)))
    with pytest.raises(ConfigError, match="contains no calibration; give one with --calib"):
        open_source(str(write_foreign(tmp_path / "b.mcap", eyes, TF, info=None)))
    odd = {"/camera/infra1/image": image_messages(2, "infra1", lambda i: raw_image("yuv422", picture(i)))}
    with pytest.raises(DataError, match="encoding 'yuv422' is not supported; supported: mono8"):
        frames(open_source(str(write_foreign(tmp_path / "c.mcap", odd, TF))))
    short = {
        "/camera/infra1/image": image_messages(
            2, "infra1", lambda i: {**raw_image("mono8", picture(i)), "data": np.zeros(9, np.uint8)}
        )
    }
    with pytest.raises(DataError, match="cut short: 9 of"):
        frames(open_source(str(write_foreign(tmp_path / "d.mcap", short, TF))))


def test_memory_does_not_grow_with_the_file(tmp_path):
    """Reading 40 MB of raw images holds few of them at a time."""
    import tracemalloc

    big = Camera(752, 480, 400.0, 400.0, 376.0, 240.0)
    noise = np.random.default_rng(0).integers(0, 256, (480, 752), np.uint8)
    with Recorder(tmp_path / "big.mcap", Rig(big, np.eye(4))) as recorder:
        for i in range(110):
            recorder.write(Measurement("cam0", i * STEP_NS, ArrayImage(noise)))
    assert (tmp_path / "big.mcap").stat().st_size > 35e6
    source = open_source(str(tmp_path / "big.mcap"))
    tracemalloc.start()
    began = time.process_time()
    assert sum(1 for _ in source.measurements()) == 110
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8e6
    assert time.process_time() - began < 5


def test_the_serial_number_is_recorded_and_compared_with_the_calibration(tmp_path):
    path, again = tmp_path / "a.mcap", tmp_path / "again.mcap"
    with Recorder(path, RIG, serial="0123") as recorder:
        for measurement in live(3):
            recorder.write(measurement)
    to_mcap(open_source(str(path)), again, None, nothing)
    for name, said in (("own", "0123"), ("other", "0456")):
        (tmp_path / name).mkdir()
        for file, text in kalibr_texts(RIG, name, said).items():
            (tmp_path / name / file).write_text(text)
    for recording in (path, again):
        assert describe_recording(open_source(str(recording)))["serial"] == "0123"
        assert open_source(str(recording), str(tmp_path / "own")).notes == ()
        (note,) = open_source(str(recording), str(tmp_path / "other")).notes
        assert note.startswith("the calibration is of device 0456, this is 0123")
        assert read_imu(str(recording)).serial == "0123"
