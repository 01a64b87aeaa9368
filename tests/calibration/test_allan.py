import numpy as np
import pytest

from share.errors import DataError
from share.metrics.allan import allan_deviation, fit


def test_white_noise_falls_with_the_square_root_of_time(rng):
    curve = allan_deviation(0.3 * np.sqrt(50) * rng.standard_normal((200_000, 3)), 50.0)
    short = curve.taus < 40
    assert np.abs(curve.deviation[short] * np.sqrt(curve.taus[short])[:, None] / 0.3 - 1).max() < 0.1
    found = fit(curve)
    assert np.abs(found.density / 0.3 - 1).max() < 0.01
    assert (found.walk < 0.003).all()


def test_a_random_walk_rises_with_it(rng):
    walk = np.cumsum(0.02 / np.sqrt(10) * rng.standard_normal((100_000, 3)), axis=0)
    curve = allan_deviation(walk, 10.0)
    middle = (curve.taus > 2) & (curve.taus < 100)
    ratio = curve.deviation[middle] / (0.02 * np.sqrt(curve.taus[middle] / 3))[:, None]
    assert np.abs(ratio - 1).max() < 0.15
    assert np.abs(fit(curve).walk / 0.02 - 1).max() < 0.05


def test_the_overlapping_estimate_is_the_definition():
    """Half the mean square of the difference of neighbouring averages, at every start."""
    samples = np.random.default_rng(1).standard_normal((400, 1))
    curve = allan_deviation(samples, 1.0)
    m = 5
    averages = np.convolve(samples[:, 0], np.ones(m) / m, "valid")
    expected = np.sqrt(np.mean((averages[m:] - averages[:-m]) ** 2) / 2)
    assert curve.deviation[np.flatnonzero(curve.taus == m)[0], 0] == pytest.approx(expected)


def test_a_constant_does_not_matter_and_a_linear_drift_does(rng):
    white = rng.standard_normal((10_000, 1))
    assert np.allclose(
        allan_deviation(white + 1e6, 1.0).deviation, allan_deviation(white, 1.0).deviation, rtol=1e-6
    )
    drift = allan_deviation(np.arange(10_000.0)[:, None] * 0.01, 1.0)
    assert np.allclose(drift.deviation[:, 0], 0.01 * drift.taus / np.sqrt(2))


def test_bias_instability_is_the_floor_of_the_curve(rng):
    """Flicker noise as a sum of first-order processes, one a decade, has a flat curve."""
    n, out = 200_000, np.zeros(200_000)
    from scipy.signal import lfilter

    for T in 10.0 ** np.arange(0, 5, 0.5):
        a = np.exp(-1 / T)
        out += lfilter([1], [1, -a], rng.standard_normal(n)) * np.sqrt(1 - a * a)
    curve = allan_deviation(out[:, None], 1.0)
    middle = curve.deviation[(curve.taus > 20) & (curve.taus < 2000), 0]
    assert middle.max() / middle.min() < 1.5
    assert fit(curve).floor[0] * 0.664 == pytest.approx(curve.deviation.min(), rel=1e-3)


def test_too_short_or_broken_records_are_refused():
    with pytest.raises(DataError, match="50 samples"):
        allan_deviation(np.zeros((50, 3)), 100.0)
    with pytest.raises(DataError, match="not finite"):
        allan_deviation(np.full((500, 3), np.nan), 100.0)
