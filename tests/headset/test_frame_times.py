"""When frames were, on the server's clock, and how a body moves."""

from __future__ import annotations

import numpy as np
import pytest

from share.geometry import se3
from share.headset.frame_times import BodyMotion, LeastDelay, MotionEstimate

MS, SECOND = 10**6, 10**9


def errors_ms(rng: np.random.Generator, offset_ns: int, drift: float = 0.0, seconds: int = 60) -> np.ndarray:
    """How far frames are put from their time: the way takes 4 ms and a queue that is empty now and then."""
    delays = LeastDelay()
    out = []
    for k in range(30 * seconds):
        true_ns = 10**15 + k * SECOND // 30
        stamp_ns = round(true_ns + offset_ns + drift * k * SECOND / 30)
        age_ms, way_ms = rng.uniform(3, 15), 4 + rng.exponential(10.0)
        delays.set_rtt(8.0 + rng.exponential(3.0))
        received_ns = true_ns + round((age_ms + way_ms) * MS)
        out.append((delays.time_of(stamp_ns, received_ns, age_ms) - true_ns) / MS)
    return np.array(out)


@pytest.mark.parametrize("offset_s", [0, -10, 1e6])
def test_frames_are_in_their_time_whatever_the_agents_clock(
    rng: np.random.Generator, offset_s: float
) -> None:
    after = errors_ms(rng, round(offset_s * SECOND))[60:]
    assert np.abs(after).max() < 2.0 and np.abs(after).mean() < 0.6


def test_a_clock_that_drifts_is_followed(rng: np.random.Generator) -> None:
    for drift in (5e-5, -5e-5):
        assert np.abs(errors_ms(rng, 0, drift)[60:]).max() < 2.5


def test_a_clock_that_is_set_is_followed_at_once() -> None:
    delays = LeastDelay()
    for k in range(100):
        assert delays.time_of(k * 33 * MS, k * 33 * MS + 5 * MS, 0.0) == k * 33 * MS + 5 * MS
    for step_ns in (-10 * SECOND, 10 * SECOND):
        stamp_ns = 5 * SECOND + step_ns
        assert delays.time_of(stamp_ns, 5 * SECOND + 5 * MS, 0.0) == 5 * SECOND + 5 * MS


def test_a_message_that_was_held_up_does_not_shift_its_frame() -> None:
    delays = LeastDelay()
    delays.time_of(0, 5 * MS, 1.0)
    assert delays.time_of(33 * MS, 533 * MS, 1.0) == 37 * MS


def moving(seconds: float, hz: float = 30.0) -> list[BodyMotion | None]:
    estimate = MotionEstimate()
    return [
        estimate.add(
            round(t * SECOND), se3.from_rt(se3.so3_exp(np.array([0, 0, 1.5 * t])), np.array([0.8 * t, 0, 0]))
        )
        for t in np.arange(0, seconds, 1 / hz)
    ]


def test_a_steady_motion_is_found() -> None:
    first, second, *rest = moving(1.0)
    assert first is None and second is None
    for one in rest:
        assert one is not None
        assert one.velocity == pytest.approx([0.8, 0, 0]) and one.angular_velocity == pytest.approx(
            [0, 0, 1.5]
        )


def test_noise_of_a_tracker_leaves_little(rng: np.random.Generator) -> None:
    estimate, velocity, turn = MotionEstimate(), [], []
    for k in range(300):
        noise = rng.normal(size=6) * [*[3e-4] * 3, *[5e-4] * 3]
        if (motion := estimate.add(k * SECOND // 30, se3.exp(noise))) is not None:
            velocity.append(motion.velocity)
            turn.append(motion.angular_velocity)
    assert np.std(velocity) < 0.015 and np.std(turn) < 0.01  # in 50 ms 0.8 mm, 0.03 degrees


def test_after_a_gap_or_a_stamp_that_falls_there_is_none() -> None:
    estimate = MotionEstimate()
    for k in range(5):
        estimate.add(k * SECOND // 30, np.eye(4))
    assert estimate.add(SECOND, np.eye(4)) is None
    assert estimate.add(SECOND + SECOND // 15, np.eye(4)) is not None
    assert estimate.add(SECOND // 2, np.eye(4)) is None
    half_turn = se3.from_rt(se3.so3_exp(np.array([0, 0, 3.0])), np.zeros(3))
    assert estimate.add(SECOND // 2 + SECOND // 10, half_turn) is None
