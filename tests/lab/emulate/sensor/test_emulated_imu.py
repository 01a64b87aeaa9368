from dataclasses import replace

import numpy as np
import pytest

from share.lab.calibrate.allan import allan_deviation
from share.lab.calibrate.imu_noise import combine_axes, fit_noise
from share.lab.emulate.sensor.imu import ImuStreams, bias_series, measured_samples
from share.sensors.profile import load_profile
from share.sensors.profile_types import InertialFacts

D435I = load_profile("d435i", gyro_hz=200).device.imu
EUROC = load_profile("euroc").device.imu
SENSORS = {
    "BMI055 gyro": D435I.gyro,
    "BMI055 accel": D435I.accel,
    "ADIS gyro": EUROC.gyro,
    "ADIS accel": EUROC.accel,
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "rate_hz"),
    [
        *(pytest.param(name, one.rate_hz, marks=pytest.mark.slow) for name, one in SENSORS.items()),
        ("ADIS gyro", 50.0),
    ],
)
def test_allan_deviation_of_rest_is_that_of_the_profile(name: str, rate_hz: float):
    """1 h at rest, eight times three axes: root mean square within 5 % of sigma^2 = N^2 / tau + K^2 tau / 3,
    from single samples up to 70 s; the walk outweighs white noise from 2 s (ADIS accel) to 42 s (BMI055
    gyro) on. One axis of one hour scatters by 13 % there: 50 spans of 70 s do not tell more."""
    sensor = replace(SENSORS[name], step=0.0, rate_hz=rate_hz, rates_hz=(rate_hz,))
    rest = np.zeros((int(3600 * sensor.rate_hz), 3))
    curves = [allan_deviation(measured_samples(rest, sensor, (seed,)), sensor.rate_hz) for seed in range(8)]
    taus = curves[0].taus
    seen = np.sqrt(np.mean([curve.deviation**2 for curve in curves], axis=(0, 2)))
    stated = np.sqrt(sensor.density**2 / taus + sensor.walk**2 * taus / 3)
    assert np.abs(seen / stated - 1)[taus < 70].max() < 0.05
    axes = [axis for curve in curves for axis in fit_noise(curve)]
    assert combine_axes(axes, "density").value == pytest.approx(sensor.density, rel=0.01)
    assert combine_axes(axes, "walk").value == pytest.approx(sensor.walk, rel=0.1)


@pytest.mark.long
def test_digits_add_what_theory_says_to_a_coarse_accelerometer():
    """A 12-bit digit is of the noise's size: step^2 / 12 comes on top."""
    sensor = D435I.accel
    hour = int(3600 * sensor.rate_hz)
    found = fit_noise(allan_deviation(measured_samples(np.zeros((hour, 3)), sensor, (0,)), sensor.rate_hz))
    expected = np.sqrt(sensor.density**2 + sensor.step**2 / 12 / sensor.rate_hz)
    assert np.abs([axis.density.value / expected - 1 for axis in found]).max() < 0.01


def test_bias_starts_within_the_data_sheet_and_wanders():
    starts = np.array([bias_series(D435I.gyro, 1, (seed,))[0] for seed in range(400)])
    assert np.abs(starts).max() <= np.sqrt(3) * D435I.gyro.start_bias
    assert abs(starts.std() / D435I.gyro.start_bias - 1) < 0.05
    ends = np.array([np.ptp(bias_series(D435I.gyro, 2000, (seed,))[[0, -1]], axis=0) for seed in range(200)])
    assert abs(np.sqrt((ends**2).mean()) / (D435I.gyro.walk * np.sqrt(10)) - 1) < 0.1


def test_bias_instability_is_stationary_with_its_sigma_and_correlation():
    sensor = InertialFacts(10, (10,), 10, 0, 0, 0, 0, instability=0.01, instability_s=5.0)
    bias = np.concatenate([bias_series(sensor, 20_000, (seed,)) for seed in range(5)], axis=1)
    assert abs(bias.std() / 0.01 - 1) < 0.05
    assert abs(bias[:10].std() / 0.01 - 1) < 0.4
    lag = (bias[50:] * bias[:-50]).mean() / bias.var()
    assert abs(lag - np.exp(-1)) < 0.05
    assert sensor.kalibr_walk == pytest.approx(0.01 * np.sqrt(2 / 5))


def test_readings_saturate_and_come_in_digits():
    spin = np.linspace(-30, 30, 3000)[:, None] * np.ones(3)
    out = measured_samples(spin, D435I.gyro, (0,), noise=False, bias=False)
    assert np.abs(out).max() == pytest.approx(np.deg2rad(1000), rel=1e-4)
    assert np.allclose(out / D435I.gyro.step, np.rint(out / D435I.gyro.step), atol=1e-6)
    inside = np.abs(spin) < 17
    assert np.abs(out - spin)[inside].max() <= D435I.gyro.step / 2 * 1.0001
    assert np.array_equal(measured_samples(spin, D435I.gyro, (0,), False, False, False), spin)


def test_a_shorter_series_is_the_head_of_a_longer_one():
    sensor = replace(D435I.gyro, instability=1e-4)
    whole = measured_samples(np.zeros((5000, 3)), sensor, (9,))
    assert np.array_equal(measured_samples(np.zeros((700, 3)), sensor, (9,)), whole[:700])
    assert not np.allclose(measured_samples(np.zeros((700, 3)), sensor, (8,)), whole[:700])


def test_joined_stream_interpolates_acceleration_at_the_gyroscope_stamps_even_over_a_wrap():
    wrap = 2**32 * 1000
    gyro_ns = (wrap - 10**9 + 10**6 + np.arange(400, dtype=np.int64) * 5_000_000) % wrap
    accel_true = wrap - 10**9 + np.arange(500, dtype=np.int64) * 4_000_000
    accel = np.stack([np.sin((accel_true - wrap) * 1e-9 + k) for k in range(3)], axis=1)
    gyro = np.arange(1200.0).reshape(400, 3)
    batch = ImuStreams(gyro_ns, gyro, accel_true % wrap, accel, wrap).to_batch()
    at = wrap - 10**9 + 10**6 + np.arange(len(batch)) * 5_000_000
    assert len(batch) == 400 and np.array_equal(batch.stamps_ns, at % wrap)
    assert np.array_equal(batch.gyro, gyro[: len(batch)])
    truth = np.stack([np.sin((at - wrap) * 1e-9 + k) for k in range(3)], axis=1)
    assert np.abs(batch.accel - truth).max() < 3e-6


def test_joined_stream_ends_where_acceleration_is_no_longer_known():
    gyro_ns, accel_ns = np.arange(0, 1000, 10), np.arange(35, 905, 20)
    batch = ImuStreams(gyro_ns, np.zeros((100, 3)), accel_ns, np.zeros((len(accel_ns), 3))).to_batch()
    assert batch.stamps_ns[0] == 40 and batch.stamps_ns[-1] == 890
    assert len(ImuStreams(gyro_ns[:0], np.zeros((0, 3)), accel_ns, np.zeros((44, 3))).to_batch()) == 0
