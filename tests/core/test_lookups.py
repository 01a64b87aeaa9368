"""Whose keyframe is looked up next."""

from __future__ import annotations

from collections import Counter

from share.core.lookups import Lookups
from share.types import AgentKind

AR, ROBOT = AgentKind.AR, AgentKind.ROBOT


def test_one_agent_newest_first() -> None:
    queue = Lookups(10)
    for number in range(3):
        queue.add("ann", AR, number)
    assert [queue.next() for _ in range(4)] == [2, 1, 0, None]


def test_who_sends_more_is_not_served_more() -> None:
    queue = Lookups(1000)
    for number in range(90):
        queue.add("ann", AR, number)
    for number in range(100, 110):
        queue.add("bob", AR, number)
    first = [queue.next() for _ in range(20)]
    assert sum(number >= 100 for number in first if number is not None) == 10


def test_headsets_before_robots_but_robots_too() -> None:
    queue = Lookups(1000)
    who = Counter[str]()
    for number in range(200):
        queue.add("ann", AR, number)
        queue.add("rob", ROBOT, 1000 + number)
    for _ in range(100):
        number = queue.next()
        assert number is not None
        who["rob" if number >= 1000 else "ann"] += 1
    assert 15 <= who["rob"] <= 25  # of two that always wait, one turn in five


def test_one_too_many_costs_the_longest_queue_its_oldest() -> None:
    queue = Lookups(4)
    for number in range(4):
        queue.add("ann", AR, number)
    queue.add("bob", AR, 10)
    assert len(queue) == 4
    assert queue.skipped == {"ann": 1}
    assert {queue.next() for _ in range(4)} == {1, 2, 3, 10}
