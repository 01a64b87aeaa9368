"""A recorded motion between its nodes, and the folders it is read from."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from share.errors import DataError, ShareError, UsageError
from share.geometry import se3
from share.lab.emulate.motion.recorded import (
    EUROC_OPTIONS,
    TUMVI_OPTIONS,
    RecordedMotion,
    RecordedPath,
    open_recorded_motion,
)
from share.lab.emulate.types import GRAVITY
from share.recordings import tables

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def euroc(shared_data: Path) -> RecordedMotion:
    return open_recorded_motion(shared_data / "motion/euroc/V1_02_medium", EUROC_OPTIONS, 10.0, 12.0)


def rates_of(path: RecordedPath, stamps: np.ndarray, step_ns: int) -> np.ndarray:
    before, after = path.poses(stamps - step_ns), path.poses(stamps + step_ns)
    turned = se3.so3_log(before[:, :3, :3].swapaxes(1, 2) @ after[:, :3, :3])
    return turned / (2e-9 * step_ns)


def test_the_real_imu_is_untouched(euroc: RecordedMotion, shared_data: Path) -> None:
    stamps, values = tables.read_table(shared_data / "motion/euroc/V1_02_medium/imu0.csv", 7)
    recorded = euroc.path.recorded
    at = np.searchsorted(stamps, recorded.stamps_ns)
    np.testing.assert_array_equal(stamps[at], recorded.stamps_ns)
    np.testing.assert_array_equal(values[at], np.concatenate([recorded.gyro, recorded.accel], axis=1))
    assert len(recorded) == pytest.approx(12 * 200, abs=2)


def test_the_path_agrees_with_its_imu(euroc: RecordedMotion) -> None:
    """Its derivatives are the readings, also across nodes; what is left is the closing error."""
    path = euroc.path
    stamps = np.arange(path.start_ns + 50_000_000, path.end_ns - 50_000_000, 7_000_003)
    rate, force = path.inertial(stamps)
    step = 1_000_000
    v = (path.velocity(stamps + step) - path.velocity(stamps - step)) / (2e-9 * step)
    R = path.poses(stamps)[:, :3, :3]
    felt = np.einsum("nji,nj->ni", R, v + (0, 0, GRAVITY))  # noqa: RUF005 - an array, not a tuple
    assert np.sqrt(((rates_of(path, stamps, step) - rate) ** 2).sum(1).mean()) < 0.02
    assert np.sqrt(((felt - force) ** 2).sum(1).mean()) < 0.4  # the rotors shake by 1 m/s^2 and more
    assert np.abs((felt - force).mean(0)).max() < 0.01


def test_path_and_velocity_are_continuous(euroc: RecordedMotion) -> None:
    path = euroc.path
    nodes = path.fit.stamps_ns
    nodes = nodes[(nodes > path.start_ns) & (nodes < path.end_ns)]
    before, after = path.poses(nodes - 1), path.poses(nodes)
    step = se3.log(se3.inverse(before) @ after)
    assert np.abs(step).max() < 1e-7  # 1 ns of 3 rad/s or m/s
    assert np.abs(path.velocity(nodes) - path.velocity(nodes - 1)).max() < 1e-6
    at = path.T_world_fit @ path.fit.T_world_body[np.isin(path.fit.stamps_ns, nodes)]
    np.testing.assert_allclose(after, at, atol=1e-12)
    stamps = np.arange(path.start_ns + 2_000_000, path.end_ns - 2_000_000, 11_000_003)
    moved = (path.poses(stamps + 10**6) - path.poses(stamps - 10**6))[:, :3, 3] / 2e-3
    assert np.abs(moved - path.velocity(stamps)).max() < 0.01


def test_the_fit_is_near_the_mocap_and_in_units_of_noise(euroc: RecordedMotion) -> None:
    left = euroc.path.fit.residuals
    assert left.position_mm < 4
    assert left.imu_sigmas.max() < 2.5
    assert abs(euroc.path.fit.offset_ns) < 100_000
    assert "mm" in euroc.notes[0]
    np.testing.assert_allclose(euroc.T_body_cam0[:3, 3], (-0.0216401, -0.0646770, 0.0098107), atol=1e-6)


def test_a_transformed_path_has_the_same_motion(euroc: RecordedMotion) -> None:
    path = euroc.path
    T = se3.exp(np.array([0, 0, 1.2, 3.0, -2.0, 0.5]))
    moved = path.transformed(T)
    stamps = np.arange(moved.start_ns, moved.end_ns, 500_000_000)
    np.testing.assert_allclose(moved.poses(stamps), T @ path.poses(stamps), atol=1e-12)
    np.testing.assert_array_equal(moved.inertial(stamps), path.inertial(stamps))
    with pytest.raises(ValueError, match="span"):
        moved.poses(np.array([path.start_ns - 1]))
    with pytest.raises(ValueError, match="vertical"):
        path.transformed(se3.exp(np.array([0.1, 0, 0, 0, 0, 0])))


def test_gaps_of_the_mocap_are_gaps_of_the_path(shared_data: Path) -> None:
    path = open_recorded_motion(shared_data / "motion/tumvi/room2", TUMVI_OPTIONS, 30.0, 14.0).path
    seconds = (path.gaps - path.start_ns) * 1e-9
    np.testing.assert_allclose(seconds, [(3.41, 5.44), (12.11, 14.0)], atol=0.1)
    inside = np.arange(path.gaps[0, 0], path.gaps[0, 1], 20_000_000)
    assert np.isfinite(path.poses(inside)).all()
    speed = np.linalg.norm(path.velocity(inside), axis=1)
    assert speed.max() < 3


def test_an_asl_folder_gives_the_same(euroc: RecordedMotion, shared_data: Path, tmp_path: Path) -> None:
    plain, root = shared_data / "motion/euroc/V1_02_medium", tmp_path / "V1_02/mav0"
    (root / "cam0").mkdir(parents=True)
    for name, file in (("imu0", "imu0.csv"), ("state_groundtruth_estimate0", "groundtruth.csv")):
        (root / name).mkdir()
        shutil.copy(plain / file, root / name / "data.csv")
    T = euroc.T_body_cam0
    (root / "cam0/sensor.yaml").write_text(f"T_BS:\n  rows: 4\n  cols: 4\n  data: {T.ravel().tolist()}\n")
    n = euroc.noise
    (root / "imu0/sensor.yaml").write_text(
        f"T_BS: {np.eye(4).tolist()}\nrate_hz: 200\n"
        f"gyroscope_noise_density: {n.gyro_density}\naccelerometer_noise_density: {n.accel_density}\n"
        f"gyroscope_random_walk: {n.gyro_walk}\naccelerometer_random_walk: {n.accel_walk}\n"
    )
    same = open_recorded_motion(tmp_path / "V1_02", EUROC_OPTIONS, 10.0, 12.0)
    np.testing.assert_array_equal(same.path.fit.T_world_body, euroc.path.fit.T_world_body)
    np.testing.assert_allclose(same.T_body_cam0, T, atol=1e-12)
    assert same.noise == n


@pytest.mark.slow
def test_tumvis_own_folder_is_read_as_raw_mocap(shared_data: Path, tmp_path: Path) -> None:
    plain, root = shared_data / "motion/tumvi/room1", tmp_path / "dataset-room1"
    for name, file in (("imu0", "imu0.csv"), ("mocap0", "groundtruth.csv"), ("cam0", "cam_timestamps.txt")):
        (root / "mav0" / name).mkdir(parents=True)
        shutil.copy(plain / file, root / "mav0" / name / "data.csv")
    (root / "dso").mkdir()
    shutil.copy(plain.parent / "calib/kalibr_imucam_chain.yaml", root / "dso/camchain.yaml")
    (root / "dso/imu_config.yaml").write_text(
        "accelerometer_noise_density: 0.0028\naccelerometer_random_walk: 0.00086\n"
        "gyroscope_noise_density: 0.00016\ngyroscope_random_walk: 2.2e-05\nupdate_rate: 200.0\n"
    )
    own = open_recorded_motion(root, EUROC_OPTIONS, 5.0, 8.0)
    same = open_recorded_motion(plain, TUMVI_OPTIONS, 5.0, 8.0)
    np.testing.assert_array_equal(own.path.fit.T_world_body, same.path.fit.T_world_body)
    np.testing.assert_array_equal(own.T_body_cam0, same.T_body_cam0)
    assert own.noise == same.noise
    assert own.path.fit.residuals.position_mm < 1


@pytest.mark.parametrize(("start", "seconds"), [(200.0, None), (-1.0, 5.0), (10.0, 0.1)])
def test_a_span_outside_the_recording_is_refused(
    shared_data: Path, start: float, seconds: float | None
) -> None:
    with pytest.raises(UsageError, match=r"of 83\.. s of IMU and truth"):
        open_recorded_motion(shared_data / "motion/euroc/V1_02_medium", EUROC_OPTIONS, start, seconds)


@pytest.mark.slow
def test_a_span_beyond_the_end_is_cut(shared_data: Path) -> None:
    path = open_recorded_motion(shared_data / "motion/euroc/V1_02_medium", EUROC_OPTIONS, 78.0, 60.0).path
    assert (path.end_ns - path.start_ns) * 1e-9 == pytest.approx(5.5, abs=0.1)


def broken(folder: Path, how: str) -> None:
    truth = folder / "groundtruth.csv"
    lines = truth.read_text().splitlines()
    if how == "order":
        lines[100], lines[101] = lines[101], lines[100]
    elif how == "nan":
        lines[100] = lines[100].replace(lines[100].split(",")[2], "nan")
    elif how == "zero":
        fields = lines[100].split(",")
        lines[100] = ",".join([*fields[:4], "0", "0", "0", "0", *fields[8:]])
    elif how == "apart":
        lines = [lines[0]] + [
            f"{int(line.split(',')[0]) + 10**13},{line.split(',', 1)[1]}" for line in lines[1:]
        ]
    elif how == "gone":
        truth.unlink()
        return
    elif how == "no calibration":
        shutil.rmtree(folder.parent / "calib")
    truth.write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("order", "line 102: .*sort"),
        ("nan", "line 101: 'nan' is not finite"),
        ("zero", "pose 100: quaternion norm is 0"),
        ("apart", "do not overlap"),
        ("gone", "no recorded motion is here"),
        ("no calibration", "no such file"),
    ],
)
def test_a_damaged_folder_is_refused(shared_data: Path, tmp_path: Path, how: str, says: str) -> None:
    folder = tmp_path / "V1_02"
    shutil.copytree(shared_data / "motion/euroc/V1_02_medium", folder)
    shutil.copytree(shared_data / "motion/euroc/calib", tmp_path / "calib")
    broken(folder, how)
    with pytest.raises(ShareError, match=says) as caught:
        open_recorded_motion(folder, EUROC_OPTIONS, 0.0, 10.0)
    assert "\n" not in str(caught.value)
    assert not isinstance(caught.value, DataError) or str(folder) in str(caught.value)
