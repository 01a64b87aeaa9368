"""Bootstrap intervals of means over runs."""

import math

import numpy as np
import pytest

from share.lab.evaluate import statistics
from share.lab.evaluate.statistics import Interval


def each(count: int) -> list[str]:
    """A session a run."""
    return [f"room{k}" for k in range(count)]


def same(found: Interval, wanted: tuple[float, ...]) -> bool:
    return np.array_equal(found, wanted, equal_nan=True)


def test_one_session_has_no_interval(rng):
    assert same(statistics.bootstrap_mean([3.0], ["a"], rng), (3.0, math.nan, math.nan))
    assert same(statistics.bootstrap_mean([3.0, 5.0], ["a", "a"], rng), (4.0, math.nan, math.nan))
    assert same(statistics.bootstrap_ratio([3.0, 6.0], [1.0, 2.0], ["a", "b"], rng), (3.0, 3.0, 3.0))


def test_pairs_with_a_missing_value_are_left_out(rng):
    assert statistics.bootstrap_mean([1.0, math.nan, 3.0], each(3), rng).value == 2.0
    found = statistics.bootstrap_ratio([1.0, math.nan, 100.0], [2.0, 5.0, math.nan], each(3), rng)
    assert same(found, (0.5, math.nan, math.nan))
    assert all(math.isnan(value) for value in statistics.bootstrap_mean([math.nan], ["a"], rng))
    assert all(math.isnan(value) for value in statistics.bootstrap_mean([], [], rng))
    assert all(math.isnan(value) for value in statistics.bootstrap_ratio([1.0], [0.0], ["a"], rng))


@pytest.mark.long
def test_the_interval_covers_the_mean_at_its_level():
    """With 20 normal values; percentiles of so few are known to be a little narrow."""
    inside = 0
    for seed in range(400):
        rng = np.random.default_rng(seed)
        _, low, high = statistics.bootstrap_mean(rng.normal(5.0, 2.0, 20), each(20), rng)
        inside += low <= 5.0 <= high
    assert 0.89 < inside / 400 < 0.96


@pytest.mark.long
def test_the_interval_covers_the_mean_over_rooms_with_several_runs_each():
    """Rooms differ by 2, runs in one of them by 0.3: three seeds tell hardly more than one."""
    inside = 0
    for seed in range(400):
        rng = np.random.default_rng(seed)
        rooms = np.repeat(rng.normal(5.0, 2.0, 20), 3)
        names = np.repeat(each(20), 3).tolist()
        _, low, high = statistics.bootstrap_mean(rooms + rng.normal(0.0, 0.3, 60), names, rng)
        inside += low <= 5.0 <= high
    assert 0.89 < inside / 400 < 0.96


def test_values_of_a_pair_are_resampled_together():
    """Sessions that differ much, a policy that takes 0.8 of each: the ratio is sure, the mean is not."""
    rng = np.random.default_rng(1)
    base = rng.uniform(1.0, 20.0, 12)
    ratio = statistics.bootstrap_ratio(0.8 * base, base, each(12), rng)
    assert ratio.low == pytest.approx(0.8)
    assert ratio.high == pytest.approx(0.8)
    mean = statistics.bootstrap_mean(0.8 * base, each(12), rng)
    assert mean.high - mean.low > 2.0
