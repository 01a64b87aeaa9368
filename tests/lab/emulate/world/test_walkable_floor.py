"""The walkable share of the floor between furniture."""

from __future__ import annotations

import numpy as np
import pytest

from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import box
from share.lab.emulate.world.scenes.layout_builder import LayoutBuilder, clear_floor, walkable_share

PAINT = Material("paint")


@pytest.fixture
def plan() -> LayoutBuilder:
    """An empty hall of 10 x 6 m."""
    return LayoutBuilder("hall", 0, (10.0, 6.0, 4.0), np.random.default_rng(0))


def test_an_empty_hall_is_walkable(plan: LayoutBuilder) -> None:
    """All but 0.45 m along the walls, to a cell of 0.1 m."""
    assert walkable_share(plan) == pytest.approx((10 - 0.9) * (6 - 0.9) / 60, abs=0.03)


def test_only_obstacles_reduce_the_walkable_share(plan: LayoutBuilder) -> None:
    empty = walkable_share(plan)
    plan.add_unchecked("line", box((2, 2, 0), (8, 4, 0.02), PAINT), solid=True)  # below the feet
    plan.add_unchecked("lamp", box((2, 2, 3), (8, 4, 3.2), PAINT), solid=True)  # above the head
    plan.add_unchecked("shade", box((2, 2, 1), (8, 4, 1.2), PAINT))  # one walks through it
    assert walkable_share(plan) == empty
    plan.add_unchecked("van", box((2, 2, 0), (8, 4, 2), PAINT), solid=True)
    assert walkable_share(plan) == pytest.approx(empty - 6.9 * 2.9 / 60, abs=0.03)


def test_a_hall_cut_in_two_has_its_larger_half(plan: LayoutBuilder) -> None:
    plan.add_unchecked("wall", box((6, 0, 0), (6.2, 6, 2), PAINT), solid=True)
    assert walkable_share(plan) == pytest.approx((6 - 0.9) * (6 - 0.9) / 60, abs=0.03)


def test_the_last_named_pieces_are_removed_until_enough_floor_is_free(plan: LayoutBuilder) -> None:
    for k in range(4):
        plan.add_unchecked("gear", box((2 + 2 * k, 0, 0), (2.2 + 2 * k, 5.5, 2), PAINT), solid=True)
    plan.add_unchecked("van", box((0, 5.6, 0), (0.2, 5.8, 2), PAINT), solid=True)
    clear_floor(plan, 0.3, {"gear"})
    assert [p.name for p in plan.pieces] == ["gear 0", "gear 1", "van 4"]
    assert walkable_share(plan) >= 0.3
    clear_floor(plan, 0.99, {"gear"})
    assert [p.name for p in plan.pieces] == ["van 4"]
