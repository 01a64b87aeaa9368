import numpy as np
import pytest

from share.errors import DataError
from share.lab.calibrate.imu import ImuCharacteristics, characterise, find_rest
from share.lab.emulate.sensor.imu import measured_samples
from share.sensors.profile import load_profile
from share.types import ImuBatch

RATE_HZ = 200.0
IMU = load_profile("euroc").device.imu


def still(seconds: float, seed: int = 0) -> ImuBatch:
    """Samples of an ADIS16448 at rest."""
    n = int(seconds * RATE_HZ)
    stamps = np.arange(n, dtype=np.int64) * 5_000_000
    force = np.tile([0.1, 9.8, -0.3], (n, 1))
    gyro = measured_samples(np.zeros((n, 3)), IMU.gyro, (seed, 1))
    return ImuBatch(stamps, gyro, measured_samples(force, IMU.accel, (seed, 2)))


def handled(imu: ImuBatch, start_s: float, end_s: float) -> ImuBatch:
    """Samples of a device in a hand: slow rotation and sway, below 1 Hz."""
    t = imu.stamps_ns * 1e-9
    by = np.where((t >= start_s) & (t < end_s), 1.0, 0.0)[:, None]
    sway = np.stack([np.sin(2 * np.pi * (0.4 + 0.1 * k) * t + k) for k in range(3)], axis=1)
    return ImuBatch(imu.stamps_ns, imu.gyro + 0.1 * by * sway, imu.accel + 0.3 * by * sway)


@pytest.fixture(scope="module")
def whole() -> ImuCharacteristics:
    """Of ten minutes."""
    return characterise(still(600))


def seconds(part: slice) -> tuple[float, float]:
    return part.start / RATE_HZ, part.stop / RATE_HZ


def test_a_recording_at_rest_is_used_as_a_whole():
    for seed in range(3):
        assert seconds(find_rest(still(400, seed), RATE_HZ)) == (0, 400)


def test_the_longer_rest_before_or_after_a_movement_is_used():
    start, end = seconds(find_rest(handled(still(400), 250, 300), RATE_HZ))
    assert start == 0 and 240 <= end <= 250
    start, end = seconds(find_rest(handled(still(400), 0, 30), RATE_HZ))
    assert 30 <= start <= 36 and end == 400


def test_a_knock_ends_the_rest():
    imu = still(300)
    accel = imu.accel.copy()
    accel[40_000:40_010] += 3.0
    assert 190 <= seconds(find_rest(ImuBatch(imu.stamps_ns, imu.gyro, accel), RATE_HZ))[1] <= 200


def test_a_device_in_a_hand_is_refused():
    with pytest.raises(DataError, match=r"at rest for 0 s of 200 s.*do not touch it"):
        find_rest(handled(still(200), 0, 200), RATE_HZ)


def test_less_than_a_minute_is_refused():
    with pytest.raises(DataError, match="at rest for 50 s of 50 s, at least 60 s"):
        find_rest(still(50), RATE_HZ)


def test_rest_is_found_in_filtered_samples():
    imu = still(300)
    smooth = [np.apply_along_axis(np.convolve, 0, v, np.ones(6) / 6, "same") for v in (imu.gyro, imu.accel)]
    inner = ImuBatch(imu.stamps_ns, *smooth).take(slice(20, -20))
    assert find_rest(inner, RATE_HZ) == slice(0, len(inner))


def test_lost_samples_are_counted_and_do_not_change_the_noise(whole):
    """300 single samples and a gap of 2 s are lost."""
    imu = still(600)
    keep = np.ones(len(imu), bool)
    keep[np.random.default_rng(3).choice(len(imu), 300, replace=False)] = False
    keep[50_000:50_400] = False
    nature = characterise(imu.take(keep))
    assert nature.rate_hz == pytest.approx(RATE_HZ, rel=1e-4)
    assert nature.missing == np.count_nonzero(~keep[:-1]) and nature.unbridged_gaps == 1
    assert nature.gyro.combined("density").value == pytest.approx(
        whole.gyro.combined("density").value, rel=0.01
    )
    assert nature.gyro.curve.segment_lengths.sum() == pytest.approx(len(imu) - 400, abs=5)


def test_the_noise_of_the_profile_is_estimated(whole):
    assert whole.accel.combined("density").value == pytest.approx(IMU.accel.density, rel=0.03)
    assert whole.accel.combined("walk").value == pytest.approx(IMU.accel.walk, rel=0.25)
    assert whole.accel.mean == pytest.approx([0.1, 9.8, -0.3], abs=4 * IMU.accel.start_bias)


def test_too_few_or_too_slow_samples_are_refused():
    with pytest.raises(DataError, match="record an hour at rest"):
        characterise(still(0.2))
    slow = still(10)
    with pytest.raises(DataError, match="1 samples a second"):
        characterise(ImuBatch(slow.stamps_ns * 200, slow.gyro, slow.accel))
