"""A keyframe of another room's agent is searched in a map that changes meanwhile."""

from __future__ import annotations

import pytest
from helpers.edge_sim import ModelRun, Person, Town, walls

from share.mapping.loops import KeyframeKey
from share.mapping.places import FindKeyframe
from share.mapping.steps import VerifyStep

ROOM = walls(4)


@pytest.fixture
def town() -> Town:
    """Ann has walked for 3 s."""
    town = Town([Person("ann", ROOM, 0.0, 11)])
    town.walk(12)
    town.run(500)
    return town


def request_of(town: Town) -> FindKeyframe:
    """Her last keyframe, as if somebody of another room had sent it."""
    return FindKeyframe(
        KeyframeKey("eve-1", 0), town.keyframes("ann")[-1], town.people[town.peer("ann")].hello.rig
    )


def run_all(edge: ModelRun) -> int:
    """Run all look-ups; return the number of candidates that were verified."""
    verified = 0
    while (step := edge.mapper.next_lookup()) is not None:
        verified += isinstance(step, VerifyStep)
        edge.mapper.finish_step(step, step.run(), 1.0)
    return verified


def test_a_place_is_found_with_one_answer(town: Town) -> None:
    edge = town.edge
    assert edge is not None
    edge.mapper.search.add(request_of(town))
    assert run_all(edge) == 1
    (sought,) = edge.mapper.search.take_answers()
    assert sought.place is not None
    assert sought.place.inliers > 100
    assert edge.mapper.next_lookup() is None
    assert edge.mapper.search.take_answers() == ()  # also once the first was taken


def test_an_answer_that_is_taken_at_once_is_the_only_one(town: Town) -> None:
    edge, answers = town.edge, []
    assert edge is not None
    edge.mapper.search.add(request_of(town))
    while (step := edge.mapper.next_lookup()) is not None:
        edge.mapper.finish_step(step, step.run(), 1.0)
        answers += edge.mapper.search.take_answers()
    answers += edge.mapper.search.take_answers()
    assert len(answers) == 1


@pytest.mark.parametrize("is_late", [False, True])
@pytest.mark.parametrize("count", [1, 3, 8])
def test_candidates_that_are_removed_meanwhile_are_left_out(town: Town, count: int, is_late: bool) -> None:
    """During the query, or between it and the first verification; three are verified at most."""
    edge = town.edge
    assert edge is not None
    edge.mapper.search.add(request_of(town))
    step = edge.mapper.next_lookup()
    assert step is not None
    found = step.run()
    assert len(found) >= 8
    if is_late:
        edge.mapper.finish_step(step, found, 1.0)
    for candidate in found[:count]:
        edge.mapper.views.remove(candidate.id)
    if not is_late:
        edge.mapper.finish_step(step, found, 1.0)
    run_all(edge)
    (sought,) = edge.mapper.search.take_answers()
    assert (sought.place is None) == (count >= 3)
