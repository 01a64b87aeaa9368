"""Vibration and knocks: strength, determinism, no net motion."""

from __future__ import annotations

import numpy as np
import pytest

from share.lab.emulate.sensor.imu import knock_acceleration, vibration_acceleration

FAST = np.arange(0.0, 20.0, 1e-4)


def drift(acceleration: np.ndarray, step_s: float) -> tuple[float, float]:
    """Most speed, m/s, and way, m, that it gives beyond a constant velocity."""
    speed = np.cumsum(acceleration, axis=0) * step_s
    speed -= speed.mean(axis=0)
    return float(np.abs(speed).max()), float(np.abs(np.cumsum(speed, axis=0) * step_s).max())


def test_vibration_is_as_strong_as_asked_for():
    found = [vibration_acceleration(FAST[::10], 3.0, (7, k)).std() for k in range(8)]
    assert np.mean(found) == pytest.approx(3.0, rel=0.15)


@pytest.mark.parametrize(
    "made", [lambda t: vibration_acceleration(t, 3.0, (7,)), lambda t: knock_acceleration(t, 8.0, 0.5, (7,))]
)
def test_a_shorter_series_is_the_head_of_a_longer_one(made):
    times = np.arange(0.0, 9.0, 0.005)
    np.testing.assert_allclose(made(times[:700]), made(times)[:700], atol=1e-9)


@pytest.mark.parametrize(
    ("made", "speed", "way"),
    [
        (lambda t: vibration_acceleration(t, 3.0, (7,)), 0.04, 6e-3),
        (lambda t: knock_acceleration(t, 8.0, 0.5, (7,)), 0.08, 2e-3),
    ],
)
def test_vibration_leaves_position_and_velocity_unchanged(made, speed, way):
    most_speed, most_way = drift(made(FAST), 1e-4)
    assert most_speed < speed
    assert most_way < way


def test_knocks_are_as_many_and_as_strong_as_asked_for():
    found = np.linalg.norm(knock_acceleration(FAST, 8.0, 0.5, (7,)), axis=1)
    assert 8.0 <= found.max() < 24.0
    quiet = np.mean(found < 0.1)
    assert 0.6 < quiet < 0.95
