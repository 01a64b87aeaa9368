"""Estimates from simulated noise of known density, instability and walk."""

import numpy as np
import pytest
from scipy.signal import lfilter

from share.errors import DataError
from share.lab.calibrate.allan import allan_deviation, variance_covariance
from share.lab.calibrate.imu_noise import combine_axes, fit_noise

N, K = 3e-3, 4e-4  # white noise and walk cross at 13 s


def made(seed: int, seconds: float, rate_hz: float, axes: int = 12, n: float = N, k: float = K) -> np.ndarray:
    rng = np.random.default_rng(seed)
    white, steps = rng.standard_normal((2, int(seconds * rate_hz), axes))
    return n * np.sqrt(rate_hz) * white + np.cumsum(k / np.sqrt(rate_hz) * steps, axis=0)


def test_errors_of_the_estimates_are_consistent_with_their_sigmas():
    """24 axes of 20 min: normalised errors of unit rms, few beyond two."""
    axes = [
        a for seed in range(2) for a in fit_noise(allan_deviation(made(seed, 1200, 50), 50), model_error=0)
    ]
    assert (
        all(axis.density.significant for axis in axes)
        and np.mean([axis.walk.significant for axis in axes]) > 0.7
    )
    for k, truth in ((1, N), (3, K)):
        off = np.array([(axis.squares[k] - truth**2) / axis.errors[k] for axis in axes])
        assert 0.6 < np.sqrt(np.mean(off**2)) < 1.5
        assert np.mean(np.abs(off) < 2) >= 0.8


def test_combined_axes_are_more_precise():
    axes = fit_noise(allan_deviation(made(7, 1200, 20, axes=20), 20))
    assert combine_axes(axes, "walk").value == pytest.approx(K, rel=0.08)
    assert combine_axes(axes, "walk").sigma < 0.4 * np.mean([axis.walk.sigma for axis in axes])
    assert combine_axes(axes, "density").value == pytest.approx(N, rel=0.01)


def test_estimates_do_not_depend_on_the_rate():
    for rate_hz in (10.0, 100.0):
        axes = fit_noise(allan_deviation(made(3, 1200, rate_hz, axes=6), rate_hz))
        density, walk = combine_axes(axes, "density"), combine_axes(axes, "walk")
        assert abs(density.value - N) < 3 * density.sigma < 0.1 * N
        assert abs(walk.value - K) < 3 * walk.sigma < 0.5 * K


def test_white_noise_alone_gives_a_bound_of_the_walk():
    axes = fit_noise(allan_deviation(made(4, 600, 50, k=0), 50))
    assert sum(axis.walk.significant for axis in axes) <= 1
    assert all(axis.walk.bound < K for axis in axes)
    assert combine_axes(axes, "density").value == pytest.approx(N, rel=0.01)


def test_a_bound_is_above_the_truth_in_most_short_recordings():
    """One minute: too short to measure the walk."""
    axes = [a for seed in range(2) for a in fit_noise(allan_deviation(made(seed, 60, 50), 50))]
    assert np.mean([axis.walk.significant for axis in axes]) < 0.4
    assert np.mean([axis.walk.bound > K for axis in axes]) >= 0.85


def test_a_walk_alone_is_estimated():
    axes = fit_noise(allan_deviation(made(5, 600, 20, n=0), 20.0))
    assert combine_axes(axes, "walk").value == pytest.approx(K, rel=0.05)
    assert combine_axes(axes, "density").conservative < 1e-3


def test_flicker_noise_is_bias_instability():
    """First-order processes, two a decade, of equal variance: 1/f noise of B^2 / (2 pi)."""
    rng, n = np.random.default_rng(6), 100_000
    flicker = np.zeros((n, 4))
    for T in 10.0 ** np.arange(-0.5, 6, 0.5):
        a = np.exp(-1 / T)
        flicker += lfilter([1], [1, -a], rng.standard_normal((n, 4)), axis=0) * np.sqrt(1 - a * a)
    # a Lorentzian of variance 1 is 4 T / (1 + (2 pi f T)^2) one-sided; over ln T, ln(10) / 2 apart, they
    # add up to (1 / f) / (ln(10) / 2), and B^2 / (2 pi f) is two-sided, so B^2 = pi / (ln(10) / 2)
    expected = np.sqrt(np.pi / (np.log(10) / 2))
    found = combine_axes(fit_noise(allan_deviation(flicker, 1.0)), "instability")
    assert found.significant and found.value == pytest.approx(expected, rel=0.06)


def test_coarse_digits_give_quantisation_noise_and_no_white_noise():
    """A slow signal in digits: 3 Q^2 / tau^2 with Q = step sqrt(dt^2 / 12) where errors are independent."""
    rng, rate_hz, Q = np.random.default_rng(80), 50.0, 2e-3
    angle = Q * rng.standard_normal((60_001, 3))
    axes = fit_noise(allan_deviation(np.diff(angle, axis=0) * rate_hz + made(8, 1200, rate_hz, 3), rate_hz))
    assert [axis.quantisation.value for axis in axes] == pytest.approx([Q] * 3, rel=0.05)
    assert all(axis.quantisation.significant for axis in axes)
    assert combine_axes(axes, "density").value == pytest.approx(N, rel=0.03)


def test_a_filter_in_the_sensor_does_not_change_the_white_noise():
    smooth = lfilter(np.ones(4) / 4, [1], made(9, 600, 100, 6), axis=0)
    assert combine_axes(fit_noise(allan_deviation(smooth, 100.0)), "density").value == pytest.approx(
        N, rel=0.01
    )


def test_equivalent_degrees_of_freedom_are_those_of_nist():
    """SP 1065, table 5 (Howe, Allan and Barnes): white noise, from the closed form; a walk, likewise."""
    n, sizes = 4097, np.array([8, 64, 512])
    white = {m: (3 * (n - 1) / (2 * m) - 2 * (n - 2) / n) * 4 * m**2 / (4 * m**2 + 5) for m in sizes}
    walk = {m: (n - 2) / m * ((n - 1) ** 2 - 3 * m * (n - 1) + 4 * m**2) / (n - 3) ** 2 for m in sizes}
    spread = variance_covariance(sizes, np.array([n - 1]), 1.0)
    for k, (part, stated) in enumerate(((0, white), (2, walk))):
        own = (1 / sizes, sizes / 3)[k]
        freedom = 2 * own**2 / np.diag(spread[part, part])
        assert freedom == pytest.approx([stated[m] for m in sizes], rel=0.12)


def test_the_covariance_of_allan_variances_is_that_of_many_recordings():
    curve = allan_deviation(made(10, 1000, 1.0, axes=3000, n=1.0, k=0.05), 1.0)
    some = [10, 14, 22]
    seen = np.cov(curve.deviation[some] ** 2)
    spread = variance_covariance(curve.sizes[some], curve.segment_lengths, 1.0)
    parts = np.array([1.0, 0.0, 0.05**2])
    assert np.einsum("a,b,abij->ij", parts, parts, spread) == pytest.approx(seen, rel=0.15)


def test_a_gap_matters_for_long_averages_only():
    """Two halves determine short averages as well as the whole does, long ones less well."""
    sizes = np.array([8, 400])
    whole, halves = (
        variance_covariance(sizes, np.array(lengths), 1.0)[0, 0] for lengths in ([4000], [2000, 2000])
    )
    assert halves[0, 0] == pytest.approx(whole[0, 0], rel=0.02)
    assert halves[1, 1] > 1.1 * whole[1, 1]


def test_a_dead_axis_and_a_few_samples_are_refused():
    with pytest.raises(DataError, match="does the sensor work"):
        fit_noise(allan_deviation(np.zeros((10_000, 1)), 100.0))
    with pytest.raises(DataError, match="too short"):
        fit_noise(allan_deviation(np.random.default_rng(0).standard_normal((100, 1)), 100.0))
