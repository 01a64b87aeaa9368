"""`share calibrate imu` on the IMU table of an EuRoC folder."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from share.files.yaml_file import read_yaml
from share.lab.emulate.sensor.imu import measured_samples
from share.recordings.calibration import imu_noise
from share.recordings.mcap.recorder import Recorder
from share.sensors.measurement import Measurement
from share.sensors.profile import load_profile

IMU = load_profile("euroc").device.imu


@pytest.fixture(scope="module")
def table(tmp_path_factory) -> Path:
    return written(tmp_path_factory.mktemp("rest") / "data.csv", 300)


def written(path: Path, seconds: int, louder: float = 1.0) -> Path:
    n = seconds * 200
    gyro = measured_samples(np.zeros((n, 3)), replace(IMU.gyro, density=IMU.gyro.density * louder), (1,))
    accel = measured_samples(np.tile([0, 9.81, 0], (n, 1)), IMU.accel, (2,))
    rows = np.concatenate([np.arange(n)[:, None] * 5_000_000, gyro, accel], axis=1)
    np.savetxt(path, rows, ["%d", *["%.8f"] * 6], delimiter=",", header="t,wx,wy,wz,ax,ay,az")
    return path


@pytest.mark.long
def test_files_and_table(share, table, tmp_path):
    done = share("calibrate", "imu", table, "--profile", "euroc", "--out", tmp_path / "mine")
    assert done.code == 0
    assert "300 s at rest of 300 s, 200.00 Hz; 0 samples lost" in done.out
    assert "gyroscope N" in done.out and "profile" in done.out
    found = imu_noise(read_yaml(tmp_path / "mine" / "kalibr_imu_chain.yaml").section("imu0"), "update_rate")
    assert found.gyro_density == pytest.approx(IMU.gyro.density, rel=0.05)
    assert found.accel_density == pytest.approx(IMU.accel.density, rel=0.05)
    assert found.accel_walk == pytest.approx(IMU.accel.walk, rel=0.4)
    assert found.rate_hz == pytest.approx(200)
    assert (tmp_path / "mine" / "imu-report.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.long
def test_chart_needs_no_formula_fonts(share, table, tmp_path, monkeypatch):
    """The frozen program has one font."""
    from matplotlib.mathtext import MathTextParser

    monkeypatch.setattr(MathTextParser, "parse", None)
    assert share("calibrate", "imu", table, "--out", tmp_path).code == 0
    assert (tmp_path / "imu-report.png").exists()


@pytest.mark.long
def test_quantities_not_measurable_in_five_minutes_are_named(share, table, tmp_path):
    done = share("calibrate", "imu", table, "--out", tmp_path, "--json")
    report = json.loads(done.out)
    assert not report["gyroscope"]["walk"]["significant"]
    assert "gyroscope K cannot be measured in 5 min; the file has an upper bound" in done.err
    text = (tmp_path / "kalibr_imu_chain.yaml").read_text()
    line = next(row for row in text.splitlines() if "gyroscope_random_walk" in row)
    assert "upper bound" in line and float(line.split()[1]) > IMU.gyro.walk
    assert report == json.loads((tmp_path / "imu-report.json").read_text())


@pytest.mark.slow
def test_inflated_noise_is_written_and_stated(share, table, tmp_path):
    share("calibrate", "imu", table, "--out", tmp_path / "one")
    share("calibrate", "imu", table, "--out", tmp_path / "two", "--inflate", "2")
    one, two = (
        imu_noise(read_yaml(tmp_path / name / "kalibr_imu_chain.yaml").section("imu0"), "update_rate")
        for name in ("one", "two")
    )
    assert two.gyro_density == pytest.approx(2 * one.gyro_density, rel=1e-3)
    assert two.accel_walk == pytest.approx(2 * one.accel_walk, rel=1e-3) and two.rate_hz == one.rate_hz
    assert "2 times what was measured" in (tmp_path / "two" / "kalibr_imu_chain.yaml").read_text()


@pytest.mark.slow
@pytest.mark.long
def test_serial_number_of_the_recording_is_written(share, tmp_path):
    with Recorder(tmp_path / "rest.mcap", load_profile("euroc").rig(), serial="0123") as recorder:
        for stamp, *values in np.loadtxt(written(tmp_path / "a.csv", 70), delimiter=",", skiprows=1):
            recorder.write(Measurement("imu", int(stamp), tuple(values)))
    assert share("calibrate", "imu", tmp_path / "rest.mcap", "--out", tmp_path / "mine").code == 0
    assert read_yaml(tmp_path / "mine" / "kalibr_imu_chain.yaml").section("imu0").get("serial") == "0123"


@pytest.mark.long
def test_noise_far_from_the_profile_gives_a_warning(share, tmp_path):
    loud = written(tmp_path / "loud.csv", 120, louder=3.0)
    done = share("calibrate", "imu", loud, "--profile", "euroc", "--out", tmp_path)
    assert done.code == 0
    times = re.search(r"gyroscope N is ([\d.]+) times the profile's 0\.00034 rad/s/sqrt", done.err)
    assert times and 2.8 < float(times[1]) < 3.1


def test_wrong_use_is_one_line(share, table, tmp_path):
    def refused(code: int, *arguments: object) -> str:
        done = share("calibrate", "imu", *arguments)
        assert done.code == code and done.err.count("\n") == 1
        return done.err

    short = tmp_path / "short.csv"
    short.write_text("".join(table.read_text().splitlines(True)[:5000]))
    assert "at least 60 s are needed" in refused(1, short, "--out", tmp_path / "a")
    assert not list((tmp_path / "a").glob("*"))
    assert "no such file" in refused(2, tmp_path / "no.mcap", "--out", tmp_path / "a")
    assert "profile 'd436' is not known" in refused(2, table, "--profile", "d436", "--out", tmp_path / "a")
    assert "--inflate" in refused(2, table, "--inflate", "0.5", "--out", tmp_path / "a")
    assert "not a folder" in refused(2, table, "--out", short)
