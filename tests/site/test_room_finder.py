from __future__ import annotations

import numpy as np

from share.mapping.loops import KeyframeKey
from share.mapping.places import FoundPlace
from share.site.directory import RoomRanking, RoomScore
from share.site.room_finder import RoomFinder

S = 10**9
KEY = KeyframeKey("ann-1", 7)


def ranking(key: KeyframeKey = KEY, **scores: float) -> RoomRanking:
    ranked = sorted(scores.items(), key=lambda item: -item[1])
    return RoomRanking("hall", key, tuple(RoomScore(room, score) for room, score in ranked))


def place(inliers: int = 100) -> FoundPlace:
    return FoundPlace("bob-2/0", np.eye(4), 1e-4 * np.eye(6), inliers)


def test_only_rooms_that_look_more_like_it_than_its_own_search():
    assert RoomFinder().choose_rooms(ranking(hall=1.0, lab=1.2), 0) == ()
    assert RoomFinder().choose_rooms(ranking(hall=1.0, lab=3.0, kitchen=1.0), 0) == ("lab",)
    assert RoomFinder().choose_rooms(ranking(hall=1.0, lab=3.0, kitchen=2.0), 0) == ("lab", "kitchen")
    assert RoomFinder().choose_rooms(ranking(), 0) == ()


def test_at_most_three_rooms_search():
    scores = {f"r{n}": 5.0 - 0.1 * n for n in range(9)}
    assert RoomFinder().choose_rooms(ranking(**scores), 0) == ("r0", "r1", "r2")


def test_the_only_room_that_has_it_is_the_one():
    finder = RoomFinder()
    finder.choose_rooms(ranking(lab=3.0, kitchen=2.0), 0)
    assert finder.add_answer("kitchen", KEY, None, 1) is None
    found = finder.add_answer("lab", KEY, place(), 2)
    assert found is not None
    assert (found.room, found.key) == ("lab", KEY)


def test_of_rooms_that_look_alike_none_is():
    for inliers, chosen in ((100, None), (60, None), (50, "lab"), (20, "lab")):
        finder = RoomFinder()
        finder.choose_rooms(ranking(lab=3.0, twin=2.9), 0)
        finder.add_answer("lab", KEY, place(100), 1)
        found = finder.add_answer("twin", KEY, place(inliers), 2)
        assert (None if found is None else found.room) == chosen


def test_one_keyframe_of_a_run_is_searched_at_a_time_and_a_silent_room_ends_it():
    finder, later = RoomFinder(), KeyframeKey("ann-1", 8)
    assert finder.choose_rooms(ranking(lab=3.0), 0)
    assert finder.choose_rooms(ranking(later, lab=3.0), S // 2) == ()
    assert finder.choose_rooms(ranking(KeyframeKey("bob-2", 0), lab=3.0), S // 2)  # another run
    assert finder.choose_rooms(ranking(later, lab=3.0), S)
    assert finder.add_answer("lab", KEY, place(), S) is None  # too late
    assert finder.add_answer("lab", later, place(), S) is not None


def test_after_a_search_in_vain_only_what_looks_much_more_like_it_is_searched_at_once():
    finder = RoomFinder()
    finder.choose_rooms(ranking(lab=1.0), 0)
    assert finder.add_answer("lab", KEY, None, S) is None
    assert finder.choose_rooms(ranking(lab=1.2), S + 1) == ()
    assert finder.choose_rooms(ranking(lab=2.0), S + 1) == ("lab",)
    finder.add_answer("lab", KEY, None, S + 2)
    assert finder.choose_rooms(ranking(lab=1.2), 2 * S + 2) == ("lab",)


def test_answers_that_nobody_asked_for():
    finder = RoomFinder()
    assert finder.add_answer("lab", KEY, place(), 0) is None
    finder.choose_rooms(ranking(lab=3.0), 0)
    assert finder.add_answer("kitchen", KEY, place(), 1) is None
    finder.forget("ann-1")
    assert finder.add_answer("lab", KEY, place(), 2) is None
