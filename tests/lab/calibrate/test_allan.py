import numpy as np
import pytest

from share.errors import DataError
from share.lab.calibrate.allan import allan_deviation


def test_white_noise_falls_with_the_square_root_of_time(rng):
    curve = allan_deviation(0.3 * np.sqrt(50) * rng.standard_normal((200_000, 3)), 50.0)
    short = curve.taus < 40
    assert np.abs(curve.deviation[short] * np.sqrt(curve.taus[short])[:, None] / 0.3 - 1).max() < 0.1


def test_a_random_walk_rises_with_it(rng):
    walk = np.cumsum(0.02 / np.sqrt(10) * rng.standard_normal((100_000, 3)), axis=0)
    curve = allan_deviation(walk, 10.0)
    middle = (curve.taus > 2) & (curve.taus < 100)
    ratio = curve.deviation[middle] / (0.02 * np.sqrt(curve.taus[middle] / 3))[:, None]
    assert np.abs(ratio - 1).max() < 0.15


def test_the_overlapping_estimate_is_the_definition():
    """Half the mean square of the difference of neighbouring averages, at every start."""
    samples = np.random.default_rng(1).standard_normal((400, 1))
    assert deviation(samples, 5) == pytest.approx(defined(samples[:, 0], 5))


def test_no_difference_spans_a_gap():
    """Two segments, one far above the other: the step between them does not count."""
    rng = np.random.default_rng(2)
    low, high = rng.standard_normal((300, 1)), 1000 + rng.standard_normal((500, 1))
    both = (296 - 5) * defined(low[:, 0], 5) ** 2 + (496 - 5) * defined(high[:, 0], 5) ** 2
    assert deviation([low, high], 5) == pytest.approx(np.sqrt(both / (296 - 5 + 496 - 5)))


def test_clusters_are_counted_within_segments():
    curve = allan_deviation([np.zeros((400, 1)), np.zeros((70, 1))], 1.0)
    counted = dict(zip(curve.sizes.tolist(), curve.clusters.tolist(), strict=True))
    m = min(size for size in counted if size > 30)
    assert counted[1] == 470 and counted[m] == 400 // m + 70 // m
    assert curve.sizes[-1] == 100 and counted[100] == 4


def test_a_constant_offset_cancels_and_a_linear_drift_does_not(rng):
    white = rng.standard_normal((10_000, 1))
    assert np.allclose(
        allan_deviation(white + 1e6, 1.0).deviation, allan_deviation(white, 1.0).deviation, rtol=1e-6
    )
    drift = allan_deviation(np.arange(10_000.0)[:, None] * 0.01, 1.0)
    assert np.allclose(drift.deviation[:, 0], 0.01 * drift.taus / np.sqrt(2))


def test_too_short_or_broken_records_are_refused():
    with pytest.raises(DataError, match="50 samples"):
        allan_deviation(np.zeros((50, 3)), 100.0)
    with pytest.raises(DataError, match="50 samples in a row"):
        allan_deviation([np.zeros((50, 3))] * 10, 100.0)
    with pytest.raises(DataError, match="not finite"):
        allan_deviation(np.full((500, 3), np.nan), 100.0)


def deviation(samples, m: int) -> float:
    curve = allan_deviation(samples, 1.0)
    return float(curve.deviation[np.flatnonzero(curve.sizes == m)[0], 0])


def defined(samples: np.ndarray, m: int) -> float:
    averages = np.convolve(samples, np.ones(m) / m, "valid")
    return float(np.sqrt(np.mean((averages[m:] - averages[:-m]) ** 2) / 2))
