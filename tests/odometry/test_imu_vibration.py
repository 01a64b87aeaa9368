"""Noise that IMU samples show: white noise in full, vibration in part, motion not at all."""

import numpy as np
import pytest
from helpers import imu_simulation
from helpers.imu_simulation import Setup, run
from helpers.imu_world import NOISE, Path, imu_of

from share.geometry.camera import ImuNoise
from share.lab.emulate.sensor.imu import vibration_acceleration
from share.odometry.imu_predictor import ImuBuffer
from share.odometry.imu_propagation import noise_with_vibration
from share.types import ImuBatch

QUIET = ImuNoise(1e-9, 1e-9, 1e-9, 1e-9, 400.0)


def batch(t, gyro, accel):
    return ImuBatch(np.rint(t * 1e9).astype(np.int64), gyro, accel)


def shown(imu, window_s=0.2):
    """Mean densities (2,) over windows of so long, gyro and accelerometer."""
    edges = np.arange(imu.stamps_ns[0], imu.stamps_ns[-1], round(window_s * 1e9))
    parts = [
        imu.take(slice(*np.searchsorted(imu.stamps_ns, edges[k : k + 2]))) for k in range(len(edges) - 1)
    ]
    noises = [noise_with_vibration(QUIET, part) for part in parts]
    return np.mean([(n.gyro_density, n.accel_density) for n in noises], axis=0)


@pytest.mark.parametrize(("hz", "most"), [(100.0, 1.3), (200.0, 1.1), (400.0, 1.1), (1000.0, 1.1)])
def test_white_noise_shows_its_density(hz, most, rng):
    """With 15 samples, at 100 Hz, the noisiest axis shows more."""
    t = np.arange(0, 12, 1 / hz)
    gyro, accel = (rng.normal(0, density * np.sqrt(hz), (len(t), 3)) for density in (0.003, 0.2))
    ratios = shown(batch(t, gyro, accel)) / (0.003, 0.2)
    assert ratios.min() > 0.9
    assert ratios.max() < most


def test_an_accelerometer_slower_than_the_gyroscope_shows_most_of_its_noise(rng):
    """250 Hz at the stamps of 400 Hz, as of a D435i: what lies between two samples is no news."""
    t, own = np.arange(0, 12, 1 / 400), np.arange(-0.1, 12.1, 1 / 250)
    noise = rng.normal(0, 0.2 * np.sqrt(250), (len(own), 3))
    joined = np.stack([np.interp(t, own, column) for column in noise.T], axis=1)
    _, accel = shown(batch(t, np.zeros((len(t), 3)), joined))
    assert 0.6 * 0.2 < accel < 1.1 * 0.2


@pytest.mark.parametrize("hz", [200.0, 400.0])
def test_a_body_that_moves_shows_no_noise(hz):
    t = np.arange(0, 6, 1 / hz)
    for seed in range(8):
        imu, _, _ = imu_of(Path(seed, turn=3.0), t)
        gyro, accel = shown(imu)
        assert gyro < 0.2 * NOISE.gyro_density
        assert accel < 0.2 * NOISE.accel_density
        assert noise_with_vibration(NOISE, imu.take(slice(0, 60))) == NOISE


def test_the_bobbing_of_a_walk_is_motion():
    t = np.arange(0, 6, 1 / 400)
    bob = (5.0 * np.sin(2 * np.pi * 2 * t) + 1.0 * np.sin(2 * np.pi * 6 * t))[:, None] * np.ones(3)
    _, accel = shown(batch(t, np.zeros((len(t), 3)), bob))
    assert accel < 1e-3


@pytest.mark.long
def test_vibration_shows_more_than_it_adds_to_velocities():
    """Over 0.3 s, rms: an integral loses nearly all of a vibration that the samples follow. (Of one that is
    faster than half their rate, and looks slow, it does not; such samples look like a bias.)"""
    t, ratios = np.arange(0, 10, 1 / 400), []
    for seed in range(6):
        a, n = vibration_acceleration(t, 1.0, (seed, 3)), 120
        sums = np.cumsum((a[1:] + a[:-1]) / 2 / 400, axis=0)
        adds = np.sqrt(((sums[n:] - sums[:-n]) ** 2).mean() / 0.3)
        ratios.append(shown(batch(t, np.zeros_like(a), a))[1] / adds)
    assert min(ratios) > 1
    assert np.median(ratios) < 8


def test_too_few_samples_show_nothing(rng):
    for n in (0, 1, 2, 7):
        t = np.arange(n) / 400
        loud = batch(t, rng.normal(0, 1, (n, 3)), rng.normal(0, 1, (n, 3)))
        assert noise_with_vibration(NOISE, loud) == NOISE


def test_the_latest_samples_reach_one_beyond_the_image():
    t = np.arange(0, 1, 1 / 200)
    samples = ImuBuffer()
    samples.add(batch(t, np.zeros((len(t), 3)), np.zeros((len(t), 3))))
    latest = samples.latest(502_000_000)
    assert (latest.stamps_ns[0], latest.stamps_ns[-1]) == (305_000_000, 505_000_000)
    assert len(samples.latest(0)) <= 2


def test_vibration_noise_reduces_error_and_keeps_the_covariance_right(monkeypatch):
    """White shaking of 1 m/s^2 a sample, as of many small blows."""
    setup = Setup(seconds=3.0, white=1.0, phase=0.4)
    measured = run(1, setup)
    monkeypatch.setattr(imu_simulation, "noise_with_vibration", lambda noise, samples: noise)
    ignored = run(1, setup)
    off = [np.sqrt((r.pose_errors[20:, 3:6] ** 2).sum(axis=1).mean()) for r in (measured, ignored)]
    assert off[0] < 0.5 * off[1]
    assert measured.nees[20:, 1].mean() < 10
    assert ignored.nees[20:, 1].mean() > 50
