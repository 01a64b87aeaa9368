import sys
from pathlib import Path

import numpy as np
import pytest

from share.errors import ConfigError
from share.recordings.calibration import read_calibration
from share.sensors import profile as profiles
from share.sensors.profile import load_host_profile, load_profile, shipped_profiles

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def changed(tmp_path: Path):
    """Return a copy of d435i.yaml with one text replaced."""

    def write(old: str, new: str) -> str:
        text = (ROOT / "firmware_profiles" / "d435i.yaml").read_text()
        assert old in text
        (tmp_path / "mine.yaml").write_text(text.replace(old, new, 1))
        return str(tmp_path / "mine.yaml")

    return write


@pytest.mark.long
def test_every_shipped_profile_reads_in_every_mode():
    hosts = {"d435i-n100-headset", "d435i-turtlebot4", "laptop-edge"}
    assert set(shipped_profiles()) == {"d435i", "euroc", "tumvi"} | hosts
    for name in set(shipped_profiles()) - {"laptop-edge"}:
        for mode in load_profile(name).device.modes:
            for hz in mode.rates_hz:
                chosen = load_profile(name, f"{mode.width}x{mode.height}@{hz:g}")
                assert (chosen.rig().cam0.width, chosen.rate_hz) == (mode.width, hz)


def test_the_d435i_has_its_baseline_field_of_view_and_rates():
    p = load_profile("d435i")
    assert p.baseline_m == pytest.approx(0.05)
    assert (p.mode.width, p.mode.height, p.rate_hz) == (640, 480, 30)
    wide = load_profile("d435i", "848x480").rig().cam0
    assert 2 * np.rad2deg(np.arctan(424 / wide.fx)) == pytest.approx(90, abs=1)  # data sheet: 87 +- 3
    assert 2 * np.rad2deg(np.arctan(240 / wide.fy)) == pytest.approx(58.9, abs=1)  # 58 +- 1
    imu = p.device.imu
    assert not imu.joined and set(imu.gyro.rates_hz) == {200, 400} and {100, 250} < set(imu.accel.rates_hz)
    assert load_profile("d435i", gyro_hz=200, accel_hz=100).device.imu.gyro.rate_hz == 200


def test_the_d435i_agrees_with_the_example_calibration():
    rig, example = load_profile("d435i", "848x480").rig(), read_calibration(ROOT / "calib" / "d435i").rig
    assert rig.cam0 == example.cam0 and rig.cam1 == example.cam1
    assert np.allclose(rig.T_body_cam0, example.T_body_cam0)
    assert np.allclose(rig.T_cam1_cam0, example.T_cam1_cam0)


def test_the_tumvi_rig_is_that_of_its_calibration(shared_data: Path):
    real = read_calibration(shared_data / "motion" / "tumvi" / "calib").rig
    rig = load_profile("tumvi").rig()
    assert rig.cam0.model == rig.cam1.model == "equidistant"
    for mine, theirs in ((rig.cam0, real.cam0), (rig.cam1, real.cam1)):
        assert (mine.fx, mine.cy) == pytest.approx((theirs.fx, theirs.cy))
        assert mine.distortion == pytest.approx(theirs.distortion)
    assert np.allclose(rig.T_cam1_cam0, real.T_cam1_cam0) and np.allclose(rig.T_body_cam0, real.T_body_cam0)


def test_the_euroc_rig_is_that_of_its_calibration(shared_data: Path):
    real = read_calibration(shared_data / "motion" / "euroc" / "calib").rig
    rig = load_profile("euroc").rig()
    assert rig.cam0 == real.cam0 and rig.cam1 == real.cam1
    assert np.allclose(rig.T_body_cam0, real.T_body_cam0, atol=1e-9)
    assert np.allclose(rig.T_cam1_cam0, real.T_cam1_cam0, atol=1e-9)
    assert rig.imu.gyro_density == pytest.approx(2 * real.imu.gyro_density, rel=1e-3)
    assert rig.imu.accel_density == pytest.approx(2 * real.imu.accel_density, rel=1e-3)


def test_the_rgbd_rig_has_depth_registered_to_the_left_camera():
    rig = load_profile("d435i").rig(depth=True)
    assert rig.kind == "rgbd+imu" and rig.cam1 is None
    assert rig.depth == rig.cam0 and np.array_equal(rig.T_depth_cam0, np.eye(4))
    with pytest.raises(ConfigError, match="profile 'euroc': the device has no depth"):
        load_profile("euroc").rig(depth=True)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ("d455",),
            "profile 'd455' is not known; known: d435i-n100-headset, d435i-turtlebot4, d435i, euroc,",
        ),
        (("no/such.yaml",), "no/such.yaml: no such profile file"),
        (("d435i", "640x400"), "mode '640x400' is not known; known: 640x480@30/15/60/90, 848x480@"),
        (("d435i", "640x480@25"), "mode '640x480@25' is not known"),
        (("d435i", None, 300.0), "gyro: rate_hz: 300 is not one of 200, 400"),
    ],
)
def test_unknown_profiles_modes_and_rates_are_refused_with_the_known_ones(arguments: tuple, says: str):
    with pytest.raises(ConfigError) as refused:
        load_profile(*arguments)
    assert says in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("emitter:", "emiter:", "mine.yaml: device: unknown key 'emiter'; did you mean 'emitter'?"),
        ('emitter: "off"', "emitter: off", "device: emitter: expected a word"),
        ('emitter: "off"', "emitter: dim", "device: emitter: 'dim' is not one of off, on"),
        ("full_well_e: 16000", "full_well_e: -1", "emulation: camera: full_well_e: -1.0 must be positive"),
        ("rate_hz: 400", "rate_hz: 300", "device: imu: gyro: rate_hz: 300 is not one of"),
        (
            "range_m: [0.28, 10.0]",
            "range_m: [10.0, 0.28]",
            "device: depth: range_m: 10, 0.28: expected 0 < near < far",
        ),
        ("width: 640", "width: 0", "device: modes[0]: resolution: 0x480 is not positive"),
        ("default_mode: 640x480@30", "default_mode: 9x9", "mine.yaml: mode '9x9' is not known"),
        (
            "cpu_governor: performance",
            "cpu_governor: perfomance",
            "host: cpu_governor: 'perfomance' is not one of performance, powersave",
        ),
        ("usbfs_mb: 128", "usbfs_mb: -5", "host: usbfs_mb: -5 must lie in 0 .. 2047"),
        ("usbfs_mb: 128", "realtime_priority: 10", "host: unknown key 'realtime_priority'"),
        ('"5.17.0.10"]', '"latest"]', "device: firmware: 'latest' is not dotted numbers such as 5.16.0.1"),
        (
            'firmware_oldest: "5.12.0.0"',
            "firmware_oldest: v5",
            "device: firmware: 'v5' is not dotted numbers",
        ),
        (
            "rate_hz: 400\n",
            "rate_hz: 400\n      rate_hz: 200\n",
            "line 47: not valid YAML: duplicate key 'rate_hz'",
        ),
        (
            "rates_hz: [30, 15, 60, 90]",
            "rates_hz: [0, 30]",
            "modes[0]: rates_hz: [0, 30]: each must be above 0",
        ),
        (
            "rates_hz: [30, 15, 60, 90]",
            "rates_hz: []",
            "device: modes[0]: rates_hz: []: each must be above 0",
        ),
        (
            "rates_hz: [200, 400]",
            "rates_hz: [-1, 400]",
            "device: imu: gyro: rates_hz: [-1, 400]: each must be",
        ),
        ("[[1, 0, 0, -0.00552]", "[[2, 0, 0, -0.00552]", "device: T_imu_cam0: is not a rigid transform"),
    ],
)
def test_an_invalid_profile_is_refused_by_its_key(changed, old: str, new: str, says: str):
    with pytest.raises(ConfigError) as refused:
        load_profile(changed(old, new))
    assert says in str(refused.value) and "\n" not in str(refused.value)


def test_a_users_profile_is_read(changed):
    assert (
        load_profile(changed("model: Bosch BMI055", "model: Bosch BMI085")).device.imu.model == "Bosch BMI085"
    )


def test_the_profile_folder_is_found_in_a_frozen_bundle(monkeypatch, tmp_path: Path):
    monkeypatch.setattr(profiles, "__file__", str(tmp_path / "lib" / "share" / "io" / "profile.py"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "nowhere"))
    with pytest.raises(ConfigError, match="firmware_profiles is missing from this installation"):
        shipped_profiles()
    (tmp_path / "bundle" / "firmware_profiles").mkdir(parents=True)
    (tmp_path / "bundle" / "firmware_profiles" / "x.yaml").write_text("name: x")
    monkeypatch.setattr(sys, "_MEIPASS", str(tmp_path / "bundle"), raising=False)
    assert set(shipped_profiles()) == {"x"}


def test_a_device_given_by_name_is_the_shipped_one():
    headset, bare = load_host_profile("d435i-n100-headset"), load_profile("d435i")
    assert headset.role == "ar" and load_host_profile("d435i-turtlebot4").role == "robot"
    assert headset.sensor is not None and headset.sensor.device.firmware == bare.device.firmware
    assert headset.sensor.emulation == bare.emulation


@pytest.mark.parametrize("name", ["laptop-edge", "d435i-n100-headset", "../d435i"])
def test_an_unknown_device_name_is_refused(name: str, tmp_path: Path):
    mine = tmp_path / "mine.yaml"
    host = "{cpu_governor: performance, usb_autosuspend: false, usbfs_mb: 0}"
    mine.write_text(f"name: mine\ndevice: {name}\nhost: {host}\n")
    with pytest.raises(
        ConfigError, match=f"^{mine}: device: '{name}' is not a shipped profile with a device"
    ):
        load_host_profile(mine)


def test_an_edge_has_no_device_and_is_refused_where_one_is_needed():
    assert load_host_profile("laptop-edge").sensor is None
    with pytest.raises(ConfigError, match="profile 'laptop-edge' has no device"):
        load_profile("laptop-edge")
