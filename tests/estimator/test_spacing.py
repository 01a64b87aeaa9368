"""When a frame is to be the next keyframe, and whose turn it is to be compared with."""

from __future__ import annotations

import numpy as np
import pytest

from share.geometry import se3
from share.odometry.keyframes import Spacing
from share.odometry.relocalisation import Turns

SECOND = 1_000_000_000


@pytest.fixture
def newest() -> Spacing:
    spacing = Spacing(gap_s=0.1, m=0.15, rad=0.2, left=0.7)
    spacing.stamp_ns, spacing.T, spacing.features = SECOND, se3.exp(np.array([0, 0, 1.0, 4.0, 5.0, 6.0])), 100
    return spacing


def moved(newest: Spacing, turn: float = 0.0, way: float = 0.0) -> np.ndarray:
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
def test_moved_turned_or_little_left_in_view(
    newest: Spacing, turn: float, way: float, seen: int, wanted: bool
) -> None:
    assert newest.wanted(2 * SECOND, moved(newest, turn, way), seen) is wanted


def test_never_sooner_than_the_gap(newest: Spacing) -> None:
    far = moved(newest, way=3.0)
    assert not newest.wanted(SECOND + 99_000_000, far, 0)
    assert newest.wanted(SECOND + 100_000_000, far, 0)


def test_all_have_their_turn_likeliest_first_and_then_again() -> None:
    turns = Turns(2)
    seen = [list(turns.next([9, 7, 5])) for _ in range(4)]
    assert seen[:2] == [[9, 7], [5]]
    assert {n for turn in seen for n in turn} == {9, 7, 5}


def test_who_is_lost_anew_begins_with_the_likeliest() -> None:
    turns = Turns(2)
    turns.next([9, 7, 5])
    turns.begin()
    assert list(turns.next([4, 3])) == [4, 3]


def test_nobody_to_compare_with() -> None:
    assert list(Turns(2).next([])) == []
