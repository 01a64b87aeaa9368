"""Balanced orders."""

from __future__ import annotations

import numpy as np
import pytest

from share.lab.study.orders import Balance, draw_orders


@pytest.mark.parametrize("seed", range(5))
def test_twenty_participants_have_twenty_orders_of_four_conditions_in_perfect_balance(seed: int) -> None:
    orders = draw_orders(4, 20, np.random.default_rng(seed))
    assert len(set(map(tuple, orders.tolist()))) == 20
    for condition in range(4):
        assert (orders == condition).sum(axis=0).tolist() == [5, 5, 5, 5]
        followers = [list(row)[list(row).index(condition) + 1] for row in orders if row[-1] != condition]
        assert sorted(followers) == sorted([k for k in range(4) if k != condition] * 5)


@pytest.mark.parametrize(
    ("conditions", "participants"),
    [(2, 8), (3, 6), (3, 12), (4, 4), (4, 24), (5, 20), (6, 18), (7, 14), (8, 16)],
)
def test_whole_blocks_are_balanced(conditions: int, participants: int) -> None:
    orders = draw_orders(conditions, participants, np.random.default_rng(1))
    assert (np.sort(orders) == np.arange(conditions)).all()
    assert Balance.of(orders).is_exact


def test_all_orders_come_before_one_comes_twice() -> None:
    orders = [tuple(row) for row in draw_orders(4, 60, np.random.default_rng(2)).tolist()]
    assert len(set(orders[:24])) == len(set(orders[24:48])) == 24
    assert len(set(orders[48:])) == 12


@pytest.mark.parametrize("participants", range(1, 48))
def test_an_even_number_of_conditions_is_never_off_by_more_than_one(participants: int) -> None:
    balance = Balance.of(draw_orders(4, participants, np.random.default_rng(participants)))
    off_diagonal = balance.successions[~np.eye(4, dtype=bool)]
    assert np.ptp(balance.places) <= 1 and np.ptp(off_diagonal) <= 1


@pytest.mark.parametrize("conditions", [3, 5, 7])
@pytest.mark.parametrize("participants", range(1, 36))
def test_odd_conditions_are_off_by_one_in_place_or_two_in_succession_at_most(
    conditions: int, participants: int
) -> None:
    balance = Balance.of(draw_orders(conditions, participants, np.random.default_rng(participants)))
    off_diagonal = balance.successions[~np.eye(conditions, dtype=bool)]
    assert np.ptp(balance.places) <= (participants % conditions > 0) and np.ptp(off_diagonal) <= 2


def test_a_plan_that_is_stopped_after_any_block_of_four_is_balanced() -> None:
    orders = draw_orders(4, 20, np.random.default_rng(3))
    assert all(Balance.of(orders[:count]).is_exact for count in (4, 8, 12, 16, 20))


def test_what_is_not_balanced_is_said_exactly() -> None:
    lines = Balance.of(np.array([[0, 1], [1, 0], [0, 1]])).lines(["A", "B"])
    assert lines == [
        "2 different orders of 3",
        "each condition in each place: NOT BALANCED: mostly once; twice: A in place 1, B in place 2",
        "each condition right after each other: NOT BALANCED: mostly once; twice: B right after A",
    ]


@pytest.mark.parametrize("conditions", [1, 9])
def test_other_numbers_of_conditions_are_refused(conditions: int) -> None:
    with pytest.raises(ValueError, match="2 to 8 can be balanced"):
        draw_orders(conditions, 4, np.random.default_rng(1))
