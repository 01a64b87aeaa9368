"""When the first pose is published: tilt and velocity are known, and the tilt makes no drift."""

from __future__ import annotations

import numpy as np
import pytest

from share.odometry.initialisation import has_converged, is_publishable, tilt_sigma, waiting_for
from share.odometry.state import CORE_SIZE, VELOCITY, FilterState, initial_state
from share.types import WaitReason


def state(tilt_deg: float, speed: float = 0.0, speed_sigma: float = 0.05) -> FilterState:
    sigma = np.full(CORE_SIZE, 1e-3)
    sigma[0:2] = np.radians(tilt_deg) / np.sqrt(2)
    sigma[VELOCITY] = speed_sigma / np.sqrt(3)
    out = initial_state(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.eye(4), sigma)
    out.v = np.array([speed, 0.0, 0.0])
    return out


def test_the_tilt_sigma_is_that_of_both_axes():
    assert tilt_sigma(state(2.5)) == pytest.approx(np.radians(2.5))


@pytest.mark.parametrize(
    ("s", "waits"),
    [
        (state(3.1), WaitReason.TILT),
        (state(2.5, speed_sigma=0.31), WaitReason.SPEED),
        (state(2.5, 2.0), WaitReason.TILT),
    ],
)
def test_the_wait_reason(s, waits):
    assert not is_publishable(s, 0.2, new_segment=True)
    assert waiting_for(s) is waits


def test_a_resting_or_slow_body_gets_a_pose_at_once():
    for speed in (0.0, 0.6):
        assert is_publishable(state(2.5, speed), 0.0, new_segment=True)


def test_a_fast_body_waits_for_its_tilt_but_not_for_ever():
    assert has_converged(state(2.5, 1.5))
    assert not is_publishable(state(2.5, 1.5), 0.8, new_segment=True)
    assert is_publishable(state(1.1, 1.5), 0.5, new_segment=True)
    assert is_publishable(state(2.5, 1.5), 0.9, new_segment=True)


def test_a_relocalised_body_does_not_wait():
    assert is_publishable(state(2.5, 1.5), 0.0, new_segment=False)
