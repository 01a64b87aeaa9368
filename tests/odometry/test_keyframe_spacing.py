"""When a frame is to be a keyframe, and the round robin of relocalisation."""

from __future__ import annotations

import numpy as np
import pytest

from share.geometry import se3
from share.odometry.keyframes import KeyframeSpacing
from share.odometry.relocalisation import RoundRobin

SECOND = 1_000_000_000


@pytest.fixture
def newest() -> KeyframeSpacing:
    spacing = KeyframeSpacing(distance_m=0.15, angle_rad=0.2, min_share=0.7)
    spacing.stamp_ns, spacing.T, spacing.feature_count = (
        SECOND,
        se3.exp(np.array([0, 0, 1.0, 4.0, 5.0, 6.0])),
        100,
    )
    return spacing


def moved(newest: KeyframeSpacing, turn: float = 0.0, way: float = 0.0) -> np.ndarray:
    return newest.T @ se3.exp(np.array([0, turn, 0, 0, 0, way]))


@pytest.mark.parametrize(
    ("turn", "way", "seen", "wanted"),
    [
        (0.0, 0.0, 100, False),
        (0.19, 0.14, 70, False),
        (0.0, 0.16, 100, True),
        (-0.21, 0.0, 100, True),
        (0.0, 0.0, 69, True),
    ],
)
def test_motion_rotation_or_few_features_trigger_a_keyframe(
    newest: KeyframeSpacing, turn: float, way: float, seen: int, wanted: bool
) -> None:
    assert newest.wants_keyframe(2 * SECOND, moved(newest, turn, way), seen) is wanted


def test_keyframes_keep_the_least_gap(newest: KeyframeSpacing) -> None:
    far = moved(newest, way=3.0)
    assert not newest.wants_keyframe(SECOND + 99_000_000, far, 0)
    assert newest.wants_keyframe(SECOND + 100_000_000, far, 0)


def test_round_robin_goes_through_all_and_starts_again() -> None:
    turns = RoundRobin(2)
    seen = [list(turns.next_batch([9, 7, 5])) for _ in range(4)]
    assert seen[:2] == [[9, 7], [5]]
    assert {n for turn in seen for n in turn} == {9, 7, 5}


def test_round_robin_restarts_after_a_reset() -> None:
    turns = RoundRobin(2)
    turns.next_batch([9, 7, 5])
    turns.reset()
    assert list(turns.next_batch([4, 3])) == [4, 3]


def test_round_robin_of_none() -> None:
    assert list(RoundRobin(2).next_batch([])) == []
