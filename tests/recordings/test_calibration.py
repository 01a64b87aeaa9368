"""Calibration files: three forms give the same rig; errors name file and key."""

from pathlib import Path

import numpy as np
import pytest

from share.errors import ConfigError
from share.files.yaml_file import Section, read_yaml
from share.geometry import se3
from share.geometry.rig_check import rig_problem
from share.recordings.calibration import (
    CAMCHAIN,
    IMU_CHAIN,
    calibration_from_kalibr,
    kalibr_texts,
    read_calibration,
    read_camera_yaml,
    to_kalibr,
)

CAM = """
  camera_model: pinhole
  intrinsics: [460.0, 461.0, 320.0, 240.0]
  distortion_model: radtan
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1e-05]
  resolution: [640, 480]
"""
IMU = """%YAML:1.0
imu0:
  accelerometer_noise_density: 2.0000e-3
  accelerometer_random_walk: 3.0e-3
  gyroscope_noise_density: 1.7e-4
  gyroscope_random_walk: 1.9e-05
  update_rate: 200.0
  rostopic: /imu0
"""
T_CAM0_IMU = se3.exp(np.array([0.1, -0.2, 0.3, 0.01, 0.02, 0.03]))
T_CAM1_CAM0 = se3.exp(np.array([0.001, 0.002, 0.003, -0.05, 0.0, 0.0]))


def matrix(T: np.ndarray) -> str:
    return str(T.tolist())


def chain(extra0: str = "", extra1: str | None = None, head: str = "") -> str:
    text = f"{head}cam0:{CAM}{extra0}"
    return text if extra1 is None else f"{text}cam1:{CAM}{extra1}"


def write(folder: Path, camchain: str, imu: str | None = IMU) -> Path:
    (folder / CAMCHAIN).write_text(camchain)
    if imu:
        (folder / IMU_CHAIN).write_text(imu)
    return folder


EXTRINSICS = [
    ("T_cam_imu", T_CAM0_IMU, "T_cn_cnm1", T_CAM1_CAM0),
    ("T_imu_cam", se3.inverse(T_CAM0_IMU), "T_cn_cnm1", T_CAM1_CAM0),
    ("T_cam_imu", T_CAM0_IMU, "T_cam_imu", T_CAM1_CAM0 @ T_CAM0_IMU),
    ("T_imu_cam", se3.inverse(T_CAM0_IMU), "T_imu_cam", se3.inverse(T_CAM1_CAM0 @ T_CAM0_IMU)),
]


@pytest.mark.parametrize(("key0", "T0", "key1", "T1"), EXTRINSICS)
@pytest.mark.parametrize("head", ["", "%YAML:1.0\n", "%YAML:1.0 # of OpenCV\n---\n"])
def test_extrinsics_are_read_in_the_direction_of_their_key(tmp_path, key0, T0, key1, T1, head):
    text = chain(f"  {key0}: {matrix(T0)}\n  rostopic: /left/image\n", f"  {key1}: {matrix(T1)}\n", head)
    calibration = read_calibration(write(tmp_path, text))
    rig = calibration.rig
    assert rig.kind == "stereo+imu"
    np.testing.assert_allclose(rig.T_body_cam0, se3.inverse(T_CAM0_IMU), atol=1e-12)
    np.testing.assert_allclose(rig.T_cam1_cam0, T_CAM1_CAM0, atol=1e-12)
    assert rig.cam0.distortion == (-0.28, 0.07, 0.0002, 1e-05)
    assert rig.imu.accel_density == 2e-3
    assert calibration.topics == {"cam0": "/left/image", "imu": "/imu0"}


def test_a_fisheye_lens_survives_writing_and_reading(tmp_path):
    text = chain(f"  T_cam_imu: {matrix(T_CAM0_IMU)}\n").replace("radtan", "equidistant")
    rig = read_calibration(write(tmp_path, text)).rig
    assert (rig.cam0.model, rig.cam0.distortion) == ("equidistant", (-0.28, 0.07, 0.0002, 1e-05))
    texts = kalibr_texts(rig, "again")
    assert "distortion_model: equidistant" in texts[CAMCHAIN]
    for name, again in texts.items():
        (tmp_path / name).write_text(again)
    assert read_calibration(tmp_path).rig.cam0 == rig.cam0


def test_a_camchain_alone_has_no_imu_and_body_is_cam0(tmp_path):
    path = write(tmp_path, chain(f"  T_cam_imu: {matrix(T_CAM0_IMU)}\n"), None) / CAMCHAIN
    rig = read_calibration(path).rig
    assert rig.kind == "mono"
    np.testing.assert_array_equal(rig.T_body_cam0, np.eye(4))


BAD = matrix(np.diag([1.0, 1.0, -1.0, 1.0]))
GOOD0 = f"  T_cam_imu: {matrix(T_CAM0_IMU)}\n"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (chain(), "cam0: no extrinsics to the IMU; add T_cam_imu"),
        (chain(GOOD0, ""), "cam1: no extrinsics to cam0; add T_cn_cnm1"),
        (chain(f"  T_cam_imu: {BAD}\n"), "cam0: T_cam_imu: is not a rigid transform"),
        (chain("  T_cam_imu: [[1, 0, 0], [0, 1, 0]]\n"), "T_cam_imu: expected a 4x4 matrix, found 6"),
        (chain(GOOD0).replace("radtan", "fov"), "'fov' is not supported; supported: radtan, .*equidistant"),
        (chain(GOOD0).replace("pinhole", "omni"), "camera_model 'omni' is not supported; supported: pinhole"),
        (chain(GOOD0).replace("461.0, ", ""), "cam0: intrinsics: expected 4 numbers, found 3"),
        (chain(GOOD0).replace("460.0", "-460.0"), "focal lengths -460.0, 461.0 must be positive"),
        (chain(GOOD0).replace("460.0", ".nan"), "not finite"),
        (chain(GOOD0).replace("460.0", "wide"), "intrinsics: expected numbers"),
        (chain(GOOD0).replace("  resolution: [640, 480]\n", ""), "key 'resolution' is missing"),
        (chain(GOOD0).replace("1e-05]", "1e-05"), "line .*: not valid YAML"),
        ("- 1\n- 2\n", "expected keys and values"),
        ("", "expected keys and values, found nothing"),
        ("cam0: 5\n", "cam0: expected keys and values"),
        ("cam2: {}\n", "key 'cam0' is missing"),
    ],
)
def test_an_invalid_calibration_is_refused_by_file_and_key(tmp_path, text, complaint):
    with pytest.raises(ConfigError, match=rf"(?s){CAMCHAIN}.*{complaint}"):
        read_calibration(write(tmp_path, text))


SHIFT0 = GOOD0 + "  timeshift_cam_imu: {}\n"
SHIFT1 = f"  T_cn_cnm1: {matrix(T_CAM1_CAM0)}\n" + "  timeshift_cam_imu: {}\n"


@pytest.mark.parametrize(
    ("camchain", "seconds"),
    [
        (chain(GOOD0), 0.0),
        (chain(SHIFT0.format(-0.0123)), -0.0123),
        (chain(SHIFT0.format("2e-3"), SHIFT1.format(0.0028)), 0.0024),
        (chain(GOOD0, SHIFT1.format(0.005)), 0.005),
    ],
)
def test_timeshift_is_the_cameras_mean(tmp_path, camchain, seconds):
    rig = read_calibration(write(tmp_path, camchain)).rig
    assert rig.timeshift_s == pytest.approx(seconds, abs=1e-15)
    assert rig.without_imu().timeshift_s == 0
    alone = read_calibration(tmp_path / CAMCHAIN).rig
    assert (alone.kind.endswith("imu"), alone.timeshift_s) == (False, 0.0)


@pytest.mark.parametrize(
    ("camchain", "complaint"),
    [
        (chain(SHIFT0.format(20)), "cam0: timeshift_cam_imu: 20 s is more than 1 s; give it in seconds"),
        (chain(SHIFT0.format(".nan")), "cam0: timeshift_cam_imu: has values that are not finite"),
        (chain(SHIFT0.format("late")), "cam0: timeshift_cam_imu: expected numbers, found .'late'."),
        (
            chain(SHIFT0.format(0.004), SHIFT1.format(0.0055)),
            "cam1: timeshift_cam_imu: 0.0055 s, but 0.004 s for cam0; .* must agree within 0.001 s",
        ),
    ],
)
def test_an_invalid_timeshift_is_refused(tmp_path, camchain, complaint):
    with pytest.raises(ConfigError, match=rf"{CAMCHAIN}: {complaint}") as error:
        read_calibration(write(tmp_path, camchain))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("seconds", [0.0, -0.02])
def test_a_rig_survives_writing_and_reading_as_kalibr_files(tmp_path, seconds):
    text = chain(SHIFT0.format(seconds), SHIFT1.format(seconds))
    rig = read_calibration(write(tmp_path, text)).rig
    written = Section(to_kalibr(rig), "written")
    for name in ("cam0", "cam1"):
        assert ("timeshift_cam_imu" in written.section(name)) == (seconds != 0)
    back = calibration_from_kalibr(written, written.section("imu0")).rig
    assert (back.cam0, back.cam1, back.imu, back.timeshift_s) == (rig.cam0, rig.cam1, rig.imu, seconds)
    np.testing.assert_allclose(back.T_body_cam0, rig.T_body_cam0, atol=1e-12)


def test_the_serial_number_is_written_in_every_section(tmp_path):
    """Not at the top, where Kalibr takes a key for a camera. Quoted: YAML reads 0123 as 83."""
    rig = read_calibration(write(tmp_path, chain(SHIFT0.format(0), SHIFT1.format(0)))).rig
    assert read_calibration(tmp_path).serials == ()
    for name, text in kalibr_texts(rig, "ours", "0123").items():
        (tmp_path / name).write_text(text)
    assert read_calibration(tmp_path).serials == ("0123",)
    assert set(read_yaml(tmp_path / CAMCHAIN).data) == {"cam0", "cam1"}
    chain_of_another = (tmp_path / IMU_CHAIN).read_text().replace("'0123'", "'0456'")
    (tmp_path / IMU_CHAIN).write_text(chain_of_another)
    assert read_calibration(tmp_path).serials == ("0123", "0456")
    (tmp_path / IMU_CHAIN).write_text(chain_of_another.replace("'0456'", "0456"))
    with pytest.raises(ConfigError, match=f"{IMU_CHAIN}: imu0: serial: put it in quotes"):
        read_calibration(tmp_path)
    (tmp_path / IMU_CHAIN).write_text(chain_of_another.replace("'0456'", "'a b'"))
    with pytest.raises(ConfigError, match=f"{IMU_CHAIN}: imu0: serial: 'a b' is not a serial number"):
        read_calibration(tmp_path)
    (tmp_path / IMU_CHAIN).write_text(chain_of_another.replace("'0456'", ""))
    assert read_calibration(tmp_path).serials == ("0123",)


DEPTH = """depth:
  intrinsics: [385.0, 385.0, 320.0, 240.0]
  resolution: [640, 480]
  T_depth_cam0: [[1, 0, 0, 0.015], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  depth_scale: 5000
  rostopic: /depth/image
"""


def test_what_a_rig_lacks_is_kept_from_its_original_calibration(tmp_path):
    """Also without the IMU chain: the rig then has no IMU."""
    T = matrix(se3.inverse(T_CAM0_IMU))
    reported = f"  T_imu_cam: {T}\n  timeshift_cam_imu: 0.004\n  rostopic: /left/image\n"
    path = write(tmp_path, chain(reported) + DEPTH, None) / CAMCHAIN
    given = read_calibration(path)
    assert given.rig.imu is None and given.rig.timeshift_s == 0
    written = to_kalibr(given.rig, given)
    np.testing.assert_allclose(written["cam0"]["T_cam_imu"], T_CAM0_IMU, atol=1e-12)
    assert written["cam0"]["timeshift_cam_imu"] == 0.004
    assert written["cam0"]["rostopic"] == "/left/image"
    assert (written["depth"]["depth_scale"], written["depth"]["rostopic"]) == (5000, "/depth/image")
    assert "imu0" not in written


def test_imu_chain_and_missing_files(tmp_path):
    with pytest.raises(ConfigError, match=f"{IMU_CHAIN}: imu0: key 'update_rate' is missing"):
        read_calibration(write(tmp_path, chain(GOOD0), IMU.replace("update_rate", "rate")))
    with pytest.raises(ConfigError, match="gyroscope_random_walk: 0 must be positive"):
        read_calibration(write(tmp_path, chain(GOOD0), IMU.replace("1.9e-05", "0")))
    (tmp_path / CAMCHAIN).unlink()
    with pytest.raises(ConfigError, match=f"has no {CAMCHAIN}"):
        read_calibration(tmp_path)


def test_camera_yaml_registered_and_not(tmp_path):
    path = tmp_path / "camera.yaml"
    head = "resolution: [640, 480]\nintrinsics: [525, 525, 320, 240]\ndepth_scale: 5000\n"
    path.write_text(head + "distortion_model: radtan\ndistortion_coefficients: [0.1, 0, 0, 0]\n")
    registered = read_calibration(path)
    assert registered.depth_scale == 5000
    assert registered.rig.depth.distortion == ()
    assert registered.rig.depth.fx == 525
    np.testing.assert_array_equal(registered.rig.T_depth_cam0, np.eye(4))
    path.write_text(head + "depth_intrinsics: [585, 585, 320, 240]\n")
    with pytest.raises(ConfigError, match="key 'T_depth_cam0' is missing"):
        read_calibration(path)
    path.write_text(head.replace("5000", "0"))
    with pytest.raises(ConfigError, match="depth_scale: 0 must be positive"):
        read_calibration(path)


def test_the_example_calibration_loads():
    """calib/ holds a whole example, and it stays loadable."""
    rig = read_calibration(Path(__file__).parents[2] / "calib" / "d435i").rig
    assert rig.kind == "stereo+imu"
    assert rig.baseline == pytest.approx(0.05, abs=1e-3)
    assert rig.imu.rate_hz == 200


def test_real_calibrations(shared_data):
    euroc = read_calibration(shared_data / "motion" / "euroc" / "calib").rig
    assert euroc.kind == "stereo+imu"
    assert euroc.baseline == pytest.approx(0.110078, abs=1e-6)
    tumvi = read_calibration(shared_data / "motion" / "tumvi" / "calib").rig
    assert (tumvi.kind, tumvi.cam0.model, tumvi.cam1.model) == ("stereo+imu", "equidistant", "equidistant")
    assert tumvi.cam0.distortion[:2] == pytest.approx((0.003482, 0.000715), abs=1e-6)
    assert rig_problem(tumvi) is None
    kitchen = read_camera_yaml(shared_data / "real" / "redkitchen_0000_0499" / "camera.yaml").rig
    assert (kitchen.cam0.fx, kitchen.depth.fx) == (525.0, 585.0)
    assert kitchen.T_depth_cam0[0, 3] == 0.025
