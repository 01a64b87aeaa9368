"""IMU samples are read from all kinds of recordings, with cameras or without."""

from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import make_euroc, make_tum

from share.errors import DataError, UsageError
from share.lab.calibrate.imu_table import read_imu, rising_mask
from share.recordings.convert import to_mcap
from share.recordings.mcap import ros_messages as ros
from share.recordings.mcap.recorder import Recorder
from share.runtime.source import open_source
from share.sensors.measurement import IMU, Measurement
from share.sensors.profile import load_profile
from share.sensors.stamps import WRAP_NS


def recorded(path: Path, stamps: list[int], values: np.ndarray, log: list[int] | None = None) -> Path:
    """Write an MCAP with the IMU alone."""
    with Recorder(path, load_profile("d435i").rig()) as recorder:
        for stamp, sample, at in zip(stamps, values, log or stamps, strict=True):
            recorder.write(Measurement(IMU, stamp, sample), at)
    return path


def test_a_recording_without_cameras_comes_back_bit_for_bit(tmp_path):
    values, stamps = (
        np.random.default_rng(0).normal(size=(500, 6)),
        [10**15 + 5_000_000 * k for k in range(500)],
    )
    seen = []
    table = read_imu(str(recorded(tmp_path / "rest.mcap", stamps, values)), lambda *said: seen.append(said))
    assert table.name == "rest" and table.dropped == 0 and seen[-1] == (500, 500)
    assert np.array_equal(table.imu.stamps_ns, stamps)
    assert np.array_equal(np.concatenate([table.imu.gyro, table.imu.accel], axis=1), values)


def test_all_forms_of_a_recording_give_the_same_imu_samples(tmp_path, monkeypatch):
    """The folder, its table, and an MCAP made of it; no image is decoded."""
    folder = make_euroc(tmp_path / "walk")
    to_mcap(open_source(str(folder)), tmp_path / "walk.mcap", None, lambda done: None)
    monkeypatch.setattr("cv2.imdecode", None)
    monkeypatch.setattr("cv2.imread", None)
    forms = (folder, folder / "mav0", folder / "mav0" / "imu0" / "data.csv", tmp_path / "walk.mcap")
    tables = [read_imu(str(form)).imu for form in forms]
    assert len(tables[0]) == 71
    for other in tables[1:]:
        assert np.array_equal(other.stamps_ns, tables[0].stamps_ns)
        assert np.array_equal(other.gyro, tables[0].gyro) and np.array_equal(other.accel, tables[0].accel)


@pytest.mark.parametrize("frame", ["", "imu", "camera_imu_optical_frame"])
def test_imu_messages_are_parsed_as_rosbags_writes_them(frame):
    """Doubles are aligned to eight bytes, whatever the length of the frame's name."""
    numbers = iter(np.random.default_rng(1).normal(size=10))
    vector, other = (
        ros.make_message("geometry_msgs/msg/Vector3", **{k: next(numbers) for k in "xyz"}) for _ in "ab"
    )
    q = ros.make_message("geometry_msgs/msg/Quaternion", **{k: next(numbers) for k in "xyzw"})
    covariances = [np.full(9, float(k)) for k in range(3)]
    message = ros.make_message(
        ros.IMU_MSG,
        header=ros.make_header(12_000_000_345, frame),
        orientation=q,
        orientation_covariance=covariances[0],
        angular_velocity=vector,
        angular_velocity_covariance=covariances[1],
        linear_acceleration=other,
        linear_acceleration_covariance=covariances[2],
    )
    data = ros.encode(message)
    assert ros.header_stamps([data] * 2).tolist() == [12_000_000_345] * 2
    values = [getattr(v, k) for v in (vector, other) for k in "xyz"]
    assert ros.parse_imu_batch([data] * 2).tolist() == [values, values]
    assert (ros.is_imu_message(data), ros.is_imu_message(data[:-8])) == (True, False)


def test_a_wrapping_counter_is_unwrapped(tmp_path):
    steps = np.arange(400, dtype=np.int64) * 5_000_000
    raw = ((WRAP_NS - 10**9 + steps) % WRAP_NS).tolist()
    path = recorded(tmp_path / "wrap.mcap", raw, np.ones((400, 6)), (10**18 + steps).tolist())
    table = read_imu(str(path))
    assert table.dropped == 0 and np.array_equal(np.diff(table.imu.stamps_ns), np.diff(steps))


def test_samples_out_of_order_are_dropped_and_counted(tmp_path):
    stamps = [0, 10, 20, 20, 15, 30]
    path = recorded(tmp_path / "a.mcap", stamps, np.arange(36.0).reshape(6, 6), list(range(6)))
    table = read_imu(str(path))
    assert table.imu.stamps_ns.tolist() == [0, 10, 20, 30] and table.dropped == 2
    assert table.imu.gyro[-1].tolist() == [30.0, 31.0, 32.0]


def test_a_source_without_imu_is_refused(tmp_path):
    make_tum(tmp_path / "tum")
    with pytest.raises(UsageError, match="not an IMU recording that SHARE reads"):
        read_imu(str(tmp_path / "tum"))
    with pytest.raises(UsageError, match="no such file"):
        read_imu(str(tmp_path / "nothing"))
    to_mcap(open_source(str(tmp_path / "tum")), tmp_path / "tum.mcap", None, lambda done: None)
    with pytest.raises(DataError, match="has no IMU samples; its topics: /"):
        read_imu(str(tmp_path / "tum.mcap"))


def test_few_non_finite_samples_are_dropped_and_many_refused(tmp_path):
    values = np.ones((5, 6))
    values[3, 2] = np.nan
    table = read_imu(str(recorded(tmp_path / "a.mcap", list(range(5)), values)))
    assert (len(table.imu), table.dropped) == (4, 1)
    values[2, 2] = np.nan
    with pytest.raises(DataError, match=r"sample 3 is not finite \(2 of 5 IMU samples are damaged: too many"):
        read_imu(str(recorded(tmp_path / "b.mcap", list(range(5)), values)))


def test_a_stamp_counts_if_it_is_later_than_all_before() -> None:
    largest = 2**63 - 1
    stamps = np.array([-5, -7, 3, 3, largest, 4])
    assert rising_mask(stamps).tolist() == [True, False, True, False, True, False]
    assert rising_mask(np.array([largest])).tolist() == [True]
    assert len(rising_mask(stamps[:0])) == 0
