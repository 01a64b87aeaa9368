"""ROS bags give what the recording gave that was written to them: any storage, split or not, ROS 1 and 2."""

from __future__ import annotations

import sqlite3
import struct

import numpy as np
import pytest
import yaml
from helpers.recordings import make_euroc
from helpers.ros_bags import TOPICS, messages, write_ros1, write_ros2, write_split
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores

from share.errors import DataError, ShareError, UsageError
from share.recordings.bags import ros1_bag
from share.recordings.calibration import kalibr_texts
from share.recordings.mcap import ros_messages as ros
from share.runtime.source import open_source
from share.sensors.measurement import CAM0, IMU

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
FORMS = {
    "mcap": lambda path, written: write_ros2(path / "walk", written, MCAP),
    "mcap-jazzy": lambda path, written: write_ros2(path / "walk", written, MCAP, Stores.ROS2_JAZZY),
    "sqlite": lambda path, written: write_ros2(path / "walk", written, SQLITE),
    "db3": lambda path, written: write_ros2(path / "walk", written, SQLITE) / "walk.db3",
    "split-mcap": lambda path, written: write_split(path / "walk", written, MCAP),
    "split-sqlite": lambda path, written: write_split(path / "walk", written, SQLITE),
    "ros1": lambda path, written: write_ros1(path / "walk.bag", written),
    "ros1-lz4": lambda path, written: write_ros1(path / "walk.bag", written, "LZ4"),
    "ros1-bz2": lambda path, written: write_ros1(path / "walk.bag", written, "BZ2"),
}


@pytest.fixture
def original(tmp_path):
    return open_source(str(make_euroc(tmp_path / "euroc", suffix=".png")))


@pytest.fixture
def calib(original, tmp_path):
    folder = tmp_path / "calib"
    folder.mkdir()
    for name, text in kalibr_texts(original.rig, "test").items():
        (folder / name).write_text(text)
    return str(folder)


def samples(source):
    return [
        (m.stream, m.stamp_ns, list(m.payload) if m.stream == IMU else m.payload.load().tolist())
        for m in sorted(source.measurements(), key=lambda m: (m.stamp_ns, m.stream))
    ]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("compressed", [False, True], ids=["raw", "compressed"])
def test_a_bag_gives_what_was_written(form, compressed, original, calib, tmp_path):
    bag = FORMS[form](tmp_path, messages(original, compressed))
    source = open_source(str(bag), calib)
    assert source.name == "walk" and source.rig.kind == "stereo+imu"
    assert samples(source) == samples(original)
    assert {name: len(stamps) for name, stamps in source.stamps().items()} == {
        name: len(stamps) for name, stamps in original.stamps().items()
    }
    part = open_source(str(bag), calib, slice(2, 4))
    assert len(part.stamps()[CAM0]) == 2
    assert [m.stamp_ns for m in part.measurements() if m.stream == CAM0] == [
        m.stamp_ns for m in original.measurements() if m.stream == CAM0
    ][2:4]


@pytest.mark.parametrize("form", FORMS)
def test_info_lists_a_bag_without_a_calibration(form, original, tmp_path, share):
    bag = FORMS[form](tmp_path, messages(original))
    done = share("dataset", "info", bag)
    assert done.code == 0, done.err
    assert f"  {TOPICS[CAM0]}  sensor_msgs/msg/Image  6 at 20 Hz\n" in done.out
    assert f"  {TOPICS[IMU]}  sensor_msgs/msg/Imu  71 at 200 Hz\n" in done.out
    assert "note: " in done.out and "--calib" in done.out
    described = yaml.safe_load(share("dataset", "info", bag, "--json").out)
    assert described["topics"][TOPICS[CAM0]]["count"] == 6


def test_camera_info_and_tf_static_are_the_calibration(original, tmp_path):
    """Without an IMU, whose noise no message states."""
    from share.recordings.mcap.rig import to_camera_info, to_tf

    written = [(topic, at, m) for topic, at, m in messages(original) if topic != TOPICS[IMU]]
    start = written[0][1]
    for stream, camera in original.rig.cameras.items():
        info = to_camera_info(camera, ros.make_header(start, stream))
        written.insert(0, (TOPICS[stream].rpartition("/")[0] + "/camera_info", start, info))
    written.insert(0, (ros.TF_STATIC, start, to_tf(original.rig, start)))
    for form in ("sqlite", "ros1"):
        (tmp_path / form).mkdir()
        rig = open_source(str(FORMS[form](tmp_path / form, written))).rig
        assert rig.kind == "stereo"
        assert rig.cam0.distortion == pytest.approx((*original.rig.cam0.distortion, 0.0))  # k3 of plumb_bob
        assert np.allclose(rig.T_cam1_cam0, original.rig.T_cam1_cam0)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"compression_format": "zstd"}, r"is compressed \(zstd\); convert it"),
        ({"storage_identifier": "leveldb"}, "storage 'leveldb' is not read; known: mcap, sqlite3"),
        ({"relative_file_paths": ["../../etc/passwd"]}, "is not a file name below"),
        ({"relative_file_paths": ["gone.db3"]}, r"gone.db3 is missing; copy the bag again"),
        ({"relative_file_paths": []}, "expected 1 to 1000 names"),
        ({"relative_file_paths": "walk.db3"}, "expected 1 to 1000 names"),
        ({"storage_identifier": 3}, "storage_identifier"),
    ],
)
def test_a_bag_that_cannot_be_read_says_why(change, what, original, tmp_path):
    bag = write_ros2(tmp_path / "walk", messages(original), SQLITE)
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"] |= change
    (bag / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    with pytest.raises(ShareError, match=what):
        open_source(str(bag))


def test_a_folder_with_other_metadata_is_no_bag(tmp_path):
    (tmp_path / "metadata.yaml").write_text("title: holiday\n")
    with pytest.raises(UsageError, match="not a recording that SHARE reads"):
        open_source(str(tmp_path))


def test_foxy_names_its_files_with_their_folder(original, calib, tmp_path):
    bag = write_ros2(tmp_path / "walk", messages(original), SQLITE)
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["relative_file_paths"] = ["walk/walk.db3"]
    (bag / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    assert len(samples(open_source(str(bag), calib))) == len(samples(original))


def test_a_damaged_message_costs_itself(original, calib, tmp_path):
    bag = FORMS["db3"](tmp_path, messages(original))
    with sqlite3.connect(bag) as file:
        file.execute("UPDATE messages SET data = x'00010000' WHERE id = 20")
        file.execute("UPDATE messages SET data = 'text' WHERE id = 21")
    file.close()
    source = open_source(str(bag), calib)
    assert len(list(source.measurements())) == len(list(original.measurements())) - 2
    assert sum(source.losses.counts.values()) == 2


@pytest.mark.parametrize("cut", [0.001, 0.3, 0.6, 0.999])
def test_a_cut_ros1_bag_is_an_error_of_data(cut, original, calib, tmp_path):
    bag = FORMS["ros1"](tmp_path, messages(original))
    data = bag.read_bytes()
    bag.write_bytes(data[: int(cut * len(data))])
    with pytest.raises(DataError, match=r"is not a ROS 1 bag, or damaged: .*rosbag reindex"):
        list(open_source(str(bag), calib).measurements())


def test_flipped_bytes_of_a_ros1_bag_end_in_data_or_its_error(original, calib, tmp_path, rng, soon):
    bag = FORMS["ros1-lz4"](tmp_path, messages(original))
    data = np.frombuffer(bag.read_bytes(), np.uint8)
    for _ in range(150):
        changed = data.copy()
        where = rng.integers(0, len(data), 4)
        changed[where] = rng.integers(0, 256, 4)
        bag.write_bytes(changed.tobytes())
        try:
            for m in open_source(str(bag), calib).measurements():
                if m.stream != IMU:
                    m.payload.load()
        except ShareError:
            pass


def test_a_chunk_that_unpacks_to_too_much_is_refused(original, calib, tmp_path, monkeypatch, soon):
    bag = FORMS["ros1-bz2"](tmp_path, messages(original))
    monkeypatch.setattr("share.recordings.bags.ros1_bag.MAX_CHUNK_BYTES", 1000)
    with pytest.raises(DataError, match=r"a chunk has more than 0\.001 MB"):
        list(open_source(str(bag), calib).measurements())


def test_many_chunks_that_are_tiny_until_unpacked_are_refused(tmp_path, monkeypatch):
    """Ten of 4 MB in a file of some kB; a megabyte of them would take half an hour to unpack."""
    image = np.zeros((2000, 2000), np.uint8)
    written = [(TOPICS[CAM0], k, ros.encode_raw(ros.make_header(k, CAM0), image)) for k in range(1, 11)]
    bag = write_ros1(tmp_path / "walk.bag", written, "BZ2", chunk_bytes=1000)
    assert bag.stat().st_size < 50_000
    unpack, unpacked = ros1_bag._unpack, []
    monkeypatch.setattr(ros1_bag, "_unpack", lambda *a: unpacked.append(1) or unpack(*a))
    file = ros1_bag.Ros1Bag(bag)
    assert len(list(file.messages([TOPICS[CAM0]]))) == len(unpacked) == 10  # 4 GB are for any file
    unpacked.clear()
    monkeypatch.setattr(ros1_bag, "_SMALL_BYTES", 20_000_000)
    line = r"walk\.bag: its chunks unpack to more than 20 MB, .*; .* rosbag decompress$"
    with pytest.raises(DataError, match=line):
        list(file.messages([TOPICS[CAM0]]))
    assert len(unpacked) == 5


def overlapping(original, path):
    """A bag whose chunks overlap in time: every fifth message, then those that follow these, and so on."""
    written = messages(original)
    shuffled = [one for first in range(5) for one in written[first::5]]
    return write_ros1(path / "walk.bag", shuffled, "BZ2", chunk_bytes=5_000)


def test_chunks_that_overlap_in_time_are_unpacked_once_each(original, calib, tmp_path, monkeypatch):
    """rosbags alone unpacks one for each message: 0.4 s each where a chunk has 120 MB of zeros."""
    source = open_source(str(overlapping(original, tmp_path)), calib)
    unpack, unpacked = ros1_bag._unpack, []

    def counting(make, data):
        unpacked.append(data)
        return unpack(make, data)

    monkeypatch.setattr(ros1_bag, "_unpack", counting)
    images = [m for m in source.measurements() if m.stream != IMU]
    assert len(images) == 12 and len(unpacked) == len(set(unpacked)) > 5
    monkeypatch.undo()
    assert samples(source) == samples(original)


def test_chunks_that_overlap_too_much_are_refused(original, calib, tmp_path, monkeypatch):
    source = open_source(str(overlapping(original, tmp_path)), calib)
    monkeypatch.setattr(ros1_bag, "MAX_HELD_BYTES", 10_000)
    with pytest.raises(DataError, match=r"walk\.bag: .*too many of its chunks overlap in time"):
        list(source.measurements())


def test_a_length_beyond_the_file_costs_no_memory(original, calib, tmp_path, soon):
    bag = FORMS["ros1"](tmp_path, messages(original))
    data = bytearray(bag.read_bytes())
    data[13:17] = struct.pack("<I", 2**32 - 1)  # of the first header
    bag.write_bytes(bytes(data))
    with pytest.raises(DataError, match="is not a ROS 1 bag, or damaged"):
        open_source(str(bag), calib)


@pytest.mark.parametrize("form", ["split-mcap", "sqlite", "ros1"])
def test_the_imu_of_a_bag_is_read_for_its_noise(form, original, tmp_path):
    """As `share calibrate imu` does."""
    from share.lab.calibrate.imu_table import read_imu

    stamps, values = original.imu
    table = read_imu(str(FORMS[form](tmp_path, messages(original))))
    assert np.array_equal(table.imu.stamps_ns, stamps)
    assert np.array_equal(np.hstack([table.imu.gyro, table.imu.accel]), values)
