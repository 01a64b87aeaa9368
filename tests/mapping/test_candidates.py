"""How the candidates of a query are checked, and in which order."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.atlas_sim import EMPTY, STEP, UP

from share.geometry import se3
from share.mapping.candidates import CandidateChecks, choose_checks, larger_maps_first
from share.mapping.map_graph import MapGraph
from share.types import Keyframe

SURE = np.diag([1e-8] * 3 + [1e-7] * 3)  # of a step: 0.3 mm


def graph_of(cov: np.ndarray = STEP, **lengths: int) -> tuple[MapGraph, dict[str, list[int]]]:
    """Agents that walk straight, a keyframe a metre, each in its own map. cov (6, 6): of a step."""
    graph, numbers = MapGraph(), {}
    step = se3.exp(np.array([0, 0, 0, 1.0, 0, 0]))
    for agent, count in lengths.items():
        steps = [step if i else np.eye(4) for i in range(count)]
        keyframes = [Keyframe(i, i - 1, i, T, cov, T, UP, 0.01, EMPTY) for i, T in enumerate(steps)]
        numbers[agent] = [graph.add_keyframe(agent, keyframe, cov, UP) for keyframe in keyframes]
    return graph, numbers


def test_larger_maps_come_first_and_the_score_decides_within_one() -> None:
    graph, at = graph_of(ann=2, bob=9, eve=5)
    others = [at["eve"][1], at["bob"][4], at["eve"][0], at["bob"][2]]
    expected = [at["bob"][4], at["bob"][2], at["eve"][1], at["eve"][0]]
    assert larger_maps_first(graph, others) == expected


@pytest.fixture
def room() -> tuple[MapGraph, int, list[int], set[int]]:
    """Graph, a keyframe, its candidates (out of view, of another map, near) and those with an image."""
    graph, at = graph_of(SURE, ann=20, bob=3)
    return graph, at["ann"][19], [at["ann"][2], at["bob"][0], at["ann"][16]], {*at["ann"], *at["bob"]}


def test_what_is_near_in_the_map_is_aligned_and_what_is_out_of_view_left_out(room) -> None:
    graph, node, (far, other, near), with_image = room
    assert choose_checks(graph, node, [far, other, near], with_image, False, False) == ([near], [other])


def test_without_an_image_what_is_near_is_verified(room) -> None:
    graph, node, candidates, with_image = room
    _, other, near = candidates
    for missing in (node, near):
        checks = choose_checks(graph, node, candidates, with_image - {missing}, False, False)
        assert checks == ([], [other, near])


def test_where_the_map_is_right_only_other_maps_are_of_interest(room) -> None:
    graph, node, candidates, with_image = room
    assert choose_checks(graph, node, candidates, with_image, True, False) == ([], [candidates[1]])


def test_a_recheck_does_not_believe_the_map(room) -> None:
    graph, node, candidates, with_image = room
    assert choose_checks(graph, node, candidates, with_image, False, True) == ([], candidates)
    far, other, _ = candidates
    assert choose_checks(graph, node, candidates, with_image, True, True) == ([], [far, other])


def test_an_uncertain_map_rules_nothing_out() -> None:
    """After 17 steps known to 0.4 m each, 17 m may be none; from 0.7 m off no images align."""
    graph, at = graph_of(np.diag([1e-4] * 3 + [0.16] * 3), ann=20)
    far, near = at["ann"][2], at["ann"][16]
    assert choose_checks(graph, at["ann"][19], [far, near], set(at["ann"]), False, False) == ([], [near])
    graph, at = graph_of(np.diag([1e-4] * 3 + [1.0] * 3), ann=20)
    checks = choose_checks(graph, at["ann"][19], [far, near], set(at["ann"]), False, False)
    assert checks == CandidateChecks([], [far, near])


def test_no_candidates(room) -> None:
    graph, node, _, with_image = room
    assert choose_checks(graph, node, [], with_image, False, False) == ([], [])
