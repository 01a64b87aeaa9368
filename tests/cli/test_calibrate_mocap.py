"""`share calibrate mocap`, over a motion known in closed form with a tilted world, another clock and a body
that sits askew; and over a real one."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.field_sim import RATE_HZ, export
from helpers.mocap_sim import BODY, NOISE, START_NS, TILT, Motion, record_imu, record_mocap, stamps

from share.files.yaml_file import read_yaml
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.lab.mocap.files import read_mocap
from share.recordings.mcap.recorder import Recorder
from share.recordings.trajectory import Trajectory, format_tum
from share.sensors.measurement import IMU, Measurement

LATE_NS = 12_345_678
CHAIN = f"""imu0:
  accelerometer_noise_density: {NOISE.accel_density}
  accelerometer_random_walk: {NOISE.accel_walk}
  gyroscope_noise_density: {NOISE.gyro_density}
  gyroscope_random_walk: {NOISE.gyro_walk}
  update_rate: 200.0
"""


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return recorded(tmp_path_factory.mktemp("mocap"), Motion())


def recorded(folder: Path, motion: Motion, seconds: float = 14) -> Path:
    """imu.csv, mocap.tum (late), mocap.csv (the same) and track.tum, the device's own, in its own world."""
    imu, seen = record_imu(motion, seconds), record_mocap(motion, seconds, LATE_NS)
    rows = np.concatenate([imu.gyro, imu.accel], axis=1)
    lines = [
        f"{t},{','.join(map(repr, v))}\n" for t, v in zip(imu.stamps_ns.tolist(), rows.tolist(), strict=True)
    ]
    (folder / "imu.csv").write_text("".join(lines))
    (folder / "mocap.tum").write_text(format_tum(Trajectory(seen.stamps_ns, seen.T)))
    q = se3.quat_from_matrix(seen.T[:, :3, :3])[:, [3, 0, 1, 2]]
    table = np.concatenate([seen.T[:, :3, 3], q], axis=1).tolist()
    rows_of = zip(seen.stamps_ns.tolist(), table, strict=True)
    (folder / "mocap.csv").write_text("".join(f"{t},{','.join(map(repr, v))}\n" for t, v in rows_of))
    at = stamps(seconds, 20)
    own = se3.exp(np.array([0, 0, 1.0, 4, 5, 6])) @ motion.pose((at - START_NS) * 1e-9)
    (folder / "track.tum").write_text(format_tum(Trajectory(at, own)))
    (folder / "kalibr_imu_chain.yaml").write_text(CHAIN)
    return folder


def found(folder: Path, truth: str, *more: object) -> tuple[object, ...]:
    return ("calibrate", "mocap", folder / "imu.csv", "--truth", folder / truth, "--calib", folder, *more)


def error_of(T: np.ndarray) -> tuple[float, float]:
    """deg, m."""
    error = se3.log(se3.inverse(T) @ BODY)
    return float(np.degrees(np.linalg.norm(error[:3]))), float(np.linalg.norm(error[3:]))


def test_body_tilt_and_clock_are_estimated_and_the_track_agrees(share, room, tmp_path):
    done = share(*found(room, "mocap.tum", "--track", room / "track.tum", "--out", tmp_path))
    assert (done.code, done.err) == (0, "")
    made = read_yaml(tmp_path / "mocap.yaml")
    turned, shifted = error_of(made.pose("T_body_mocap"))
    assert turned < 0.05 and shifted < 0.0015
    assert made.number("timeshift_imu_mocap") == pytest.approx(LATE_NS * 1e-9, abs=2e-4)
    assert made.number("tilt_deg") == pytest.approx(np.degrees(np.linalg.norm(TILT)), abs=0.03)
    report = json.loads((tmp_path / "mocap-report.json").read_text())
    assert report["hand_eye"]["agrees"] and report["mounting_warning"] is None
    turned, shifted = error_of(np.array(report["hand_eye"]["T_body_mocap"]))
    assert turned < 0.2 and shifted < 0.003
    assert "body position" in done.out and "hand-eye" in done.out


def test_csv_and_tum_give_the_same_result(room):
    tum, csv = read_mocap(room / "mocap.tum"), read_mocap(room / "mocap.csv")
    assert np.array_equal(tum.stamps_ns, csv.stamps_ns) and np.allclose(tum.T, csv.T, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "order"), [("mocap.tum", [0, 1, 2, 3, 7, 4, 5, 6]), ("mocap.csv", [0, 1, 2, 3, 5, 6, 7, 4])]
)
def test_quaternion_in_wrong_order_is_refused(share, room, tmp_path, name, order):
    """It turns by the same angles, so the clocks are found; but about other axes."""
    between = "," if name.endswith(".csv") else " "
    rows = [line.split(between) for line in (room / name).read_text().splitlines()]
    (tmp_path / name).write_text("".join(between.join(row[k] for k in order) + "\n" for row in rows))
    done = share(*found(room, tmp_path / name, "--out", tmp_path / "out"))
    assert done.code == 1 and done.err.count("\n") == 1
    assert "the order of quaternions (TUM: qx qy qz qw; .csv: qw qx qy qz)" in done.err
    assert not list((tmp_path / "out").iterdir())


def test_body_of_a_vicon_export_with_another_clock_is_estimated(share, room, tmp_path):
    """Its clock counts frames from nought; another body is in the file."""
    mine, other = (record_mocap(Motion(seed), 14, LATE_NS, hz=RATE_HZ).T for seed in (1, 4))
    export(tmp_path / "vicon.csv", {"Hat": other, "Mine": mine}, quaternions=True)
    reported = found(room, tmp_path / "vicon.csv", "--within", "1e10", "--out", tmp_path / "out")
    refused = share(*reported)
    assert refused.code == 2 and "give --body BODY); it has Hat, Mine" in refused.err
    assert share(*reported, "--body", "Mine").code == 0
    turned, shifted = error_of(read_yaml(tmp_path / "out" / "mocap.yaml").pose("T_body_mocap"))
    assert turned < 0.05 and shifted < 0.0015


def test_recording_without_images_suffices(share, room, tmp_path):
    """As `share capture --imu-only` makes it: it carries the noise."""
    rig = Rig(Camera(64, 48, 40.0, 40.0, 31.5, 23.5), np.eye(4), imu=NOISE)
    imu = record_imu(Motion(), 14)
    with Recorder(tmp_path / "imu.mcap", rig) as recorder:
        for stamp, *values in zip(imu.stamps_ns.tolist(), *imu.gyro.T, *imu.accel.T, strict=True):
            recorder.write(Measurement(IMU, stamp, values))
    done = share(
        "calibrate", "mocap", tmp_path / "imu.mcap", "--truth", room / "mocap.tum", "--out", tmp_path
    )
    assert (done.code, done.err) == (0, "")
    turned, shifted = error_of(read_yaml(tmp_path / "mocap.yaml").pose("T_body_mocap"))
    assert turned < 0.05 and shifted < 0.0015


def test_track_of_another_motion_gives_a_warning(share, room, tmp_path):
    """A recording of the same time, with the device turned a quarter about its z."""
    other = tmp_path / "other.tum"
    T = Motion().pose((stamps(14, 20) - START_NS) * 1e-9) @ se3.exp(np.array([0, 0, 1.57, 0, 0, 0]))
    other.write_text(format_tum(Trajectory(stamps(14, 20), T)))
    done = share(*found(room, "mocap.tum", "--track", other, "--out", tmp_path))
    assert done.code == 0 and "contradicts the fit" in done.err


def test_rotation_about_one_axis_is_refused(share, tmp_path):
    recorded(tmp_path, Motion(5, planar=True), 12)
    done = share(*found(tmp_path, "mocap.tum", "--out", tmp_path / "out"))
    assert done.code == 1 and "turn it about two axes" in done.err and done.err.count("\n") == 1
    assert not list((tmp_path / "out").iterdir())


def test_wrong_use_is_one_line(share, room, tmp_path):
    def refused(code: int, *arguments: object) -> str:
        done = share("calibrate", "mocap", *arguments, "--out", tmp_path)
        assert done.code == code and done.err.count("\n") == 1
        return done.err

    imu, truth = room / "imu.csv", room / "mocap.tum"
    assert "give --calib DIR" in refused(2, imu, "--truth", truth)
    assert "no such motion capture file" in refused(2, imu, "--truth", room / "no.tum", "--calib", room)
    assert "--track" in refused(2, imu, "--truth", truth, "--calib", room, "--track", room / "no.tum")
    assert "kalibr_imu_chain.yaml" in refused(2, imu, "--truth", truth, "--calib", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "turned", "mm"), [("V1_01_easy", 0.28, 5), ("V1_02_medium", 1.41, 5)])
def test_real_recordings(share, shared_data, tmp_path, name, turned, mm):
    """As docs/understand/mocap-fit.md has them."""
    motion = shared_data / "motion" / "euroc"
    calib, folder = motion / "calib", motion / name
    truth = folder / "groundtruth.csv"
    settings = ("--calib", calib, "--one-clock", "--sigma-mm", "1.5", "--out", tmp_path)
    assert share("calibrate", "mocap", folder / "imu0.csv", "--truth", truth, *settings).code == 0
    T = read_yaml(tmp_path / "mocap.yaml").pose("T_body_mocap")
    assert np.degrees(se3.rotation_angle(T[:3, :3])) == pytest.approx(turned, abs=0.05)
    assert np.linalg.norm(T[:3, 3]) * 1e3 == pytest.approx(mm, abs=1)
