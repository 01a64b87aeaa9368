"""How sure a mean over runs is."""

import math

import numpy as np
import pytest

from share.metrics import bootstrap


def test_one_run_is_as_sure_as_it_looks(rng):
    assert bootstrap.mean([3.0], rng) == (3.0, 3.0, 3.0)
    assert bootstrap.ratio([3.0, 6.0], [1.0, 2.0], rng) == (3.0, 3.0, 3.0)


def test_what_was_not_measured_is_left_out_with_its_pair(rng):
    assert bootstrap.mean([1.0, math.nan, 3.0], rng).value == 2.0
    assert bootstrap.ratio([1.0, math.nan, 100.0], [2.0, 5.0, math.nan], rng) == (0.5, 0.5, 0.5)
    assert all(math.isnan(value) for value in bootstrap.mean([math.nan], rng))
    assert all(math.isnan(value) for value in bootstrap.ratio([1.0], [0.0], rng))


def test_it_covers_the_mean_as_often_as_it_says():
    """Of 20 normal values; percentiles of so few are known to be a little narrow."""
    inside = 0
    for seed in range(400):
        rng = np.random.default_rng(seed)
        _, low, high = bootstrap.mean(rng.normal(5.0, 2.0, 20), rng)
        inside += low <= 5.0 <= high
    assert 0.89 < inside / 400 < 0.96


def test_pairs_stay_together():
    """Sessions that differ much, a policy that takes 0.8 of each: the ratio is sure, the mean is not."""
    rng = np.random.default_rng(1)
    base = rng.uniform(1.0, 20.0, 12)
    ratio = bootstrap.ratio(0.8 * base, base, rng)
    assert ratio.low == pytest.approx(0.8)
    assert ratio.high == pytest.approx(0.8)
    mean = bootstrap.mean(0.8 * base, rng)
    assert mean.high - mean.low > 2.0
