"""The accelerometer is interpolated at the stamps of the gyroscope, never extrapolated."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from share.sensors.sample_processor import ImuInterpolator

GAP = 20


def run(
    gyro: list[int], accel: list[int], lag: int = 0
) -> tuple[ImuInterpolator, list[tuple[int, list[float]]]]:
    """Yield both in order of arrival, the accelerometer later by `lag`; its value is 2 * time."""
    join = ImuInterpolator(GAP)
    events = [(t, 1, t) for t in gyro] + [(t + lag, 0, t) for t in accel]
    out: list[tuple[int, list[float]]] = []
    for _, is_gyro, t in sorted(events):
        fed = join.add_gyro(t, (t, 0, 0)) if is_gyro else join.add_accel(t, (2 * t, 0, 0))
        out += list(fed)
    return join, out


stamps = st.lists(st.integers(0, 400), max_size=60, unique=True).map(sorted)


@pytest.mark.long
@settings(max_examples=200, deadline=None)
@given(stamps, stamps, st.integers(0, 50))
def test_joined_samples_equal_numpys_interpolation_between_near_neighbours(
    gyro: list[int], accel: list[int], lag: int
) -> None:
    join, out = run(gyro, accel, lag)
    a = np.array(accel)
    wanted = []
    for t in gyro:
        before, after = a[a <= t], a[a >= t]
        if len(before) and len(after) and after[0] - before[-1] <= GAP:
            wanted.append(t)
    assert [stamp for stamp, _ in out] == wanted
    np.testing.assert_allclose([v[3] for _, v in out], np.interp(wanted, a, 2 * a) if wanted else [])
    assert [v[0] for _, v in out] == wanted
    inside = [t for t in gyro if len(a) and t <= a[-1]]
    assert (join.interpolated, join.unmatched) == (len(wanted), len(inside) - len(wanted))


def test_a_sample_waits_for_the_next_of_the_other_sensor() -> None:
    join = ImuInterpolator(GAP)
    assert list(join.add_accel(0, (0, 0, 0))) == []
    assert list(join.add_gyro(5, (1, 2, 3))) == []
    assert list(join.add_accel(10, (10, 20, 30))) == [(5, [1, 2, 3, 5, 10, 15])]


def test_a_silent_accelerometer_does_not_fill_the_memory() -> None:
    join = ImuInterpolator(GAP, max_wait_ns=100)
    for t in range(1000):
        assert list(join.add_gyro(t, (0, 0, 0))) == []
    assert join.unmatched == 899
