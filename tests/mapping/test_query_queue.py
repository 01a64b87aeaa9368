"""Which keyframe is looked up next."""

from __future__ import annotations

from collections import Counter

import pytest

from share.config import EdgeConfig
from share.mapping import query_queue
from share.mapping.query_queue import QueryQueue
from share.types import AgentKind

AR, ROBOT = AgentKind.AR, AgentKind.ROBOT


def test_the_newest_keyframe_of_an_agent_is_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(query_queue, "MAX_WAITING_EACH", 10)
    queue = QueryQueue(EdgeConfig(max_waiting=10))
    for number in range(3):
        queue.add("ann", AR, number)
    assert [queue.next_query() for _ in range(4)] == [2, 1, 0, None]


def test_an_agent_that_sends_more_is_not_served_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(query_queue, "MAX_WAITING_EACH", 1000)
    queue = QueryQueue(EdgeConfig(max_waiting=1000))
    for number in range(90):
        queue.add("ann", AR, number)
    for number in range(100, 110):
        queue.add("bob", AR, number)
    first = [queue.next_query() for _ in range(20)]
    assert sum(number >= 100 for number in first if number is not None) == 10


def test_headsets_are_served_before_robots_but_not_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(query_queue, "MAX_WAITING_EACH", 1000)
    queue = QueryQueue(EdgeConfig(max_waiting=1000))
    who = Counter[str]()
    for number in range(200):
        queue.add("ann", AR, number)
        queue.add("rob", ROBOT, 1000 + number)
    for _ in range(100):
        number = queue.next_query()
        assert number is not None
        who["rob" if number >= 1000 else "ann"] += 1
    assert 15 <= who["rob"] <= 25  # of two that always wait, one turn in five


def test_a_full_queue_skips_the_oldest_of_the_longest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(query_queue, "MAX_WAITING_EACH", 4)
    queue = QueryQueue(EdgeConfig(max_waiting=4))
    for number in range(4):
        queue.add("ann", AR, number)
    queue.add("bob", AR, 10)
    assert len(queue) == 4
    assert queue.skipped == {"ann": 1}
    assert {queue.next_query() for _ in range(4)} == {1, 2, 3, 10}


def test_an_agent_that_sends_much_has_its_older_keyframes_skipped() -> None:
    queue = QueryQueue(EdgeConfig(max_waiting=12))
    for number in range(8):
        queue.add("ann", AR, number)
    queue.add("bob", AR, 10)
    assert queue.skipped == {"ann": 5}
    assert {queue.next_query() for _ in range(4)} == {5, 6, 7, 10}


def test_of_many_agents_the_newest_are_served_and_none_starves() -> None:
    """Twenty agents in turn, half as many look-ups as keyframes: only recent keyframes are looked up, and
    each agent has its turn."""
    queue, served, age = QueryQueue(EdgeConfig(max_waiting=12)), Counter[int](), []
    for number in range(2000):
        queue.add(f"agent{number % 20}", AR, number)
        if number % 2:
            found = queue.next_query()
            assert found is not None
            served[found % 20] += 1
            age.append(number - found)
    assert max(age[20:]) <= 6
    assert min(served.values()) >= 30 and len(served) == 20


def test_skipped_keyframes_are_returned_newest_first() -> None:
    queue = QueryQueue(EdgeConfig(max_waiting=12))
    for number in range(300):
        queue.add("ann", AR, number)
    assert [queue.next_query() for _ in range(4)] == [299, 298, 297, None]
    late = [queue.next_skipped() for _ in range(101)]
    assert late == [*range(296, 196, -1), None]
