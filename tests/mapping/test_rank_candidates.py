"""The order of candidates in a hurried search."""

from __future__ import annotations

import numpy as np
from helpers.atlas_sim import EMPTY, STEP, UP

from share.geometry import se3
from share.mapping.map_graph import MapGraph
from share.mapping.query_queue import rank_candidates
from share.types import Keyframe


def graph_of(**lengths: int) -> tuple[MapGraph, dict[str, list[int]]]:
    """Agents that walk straight, a keyframe a metre, each in its own map."""
    graph, numbers = MapGraph(), {}
    step = se3.exp(np.array([0, 0, 0, 1.0, 0, 0]))
    for agent, count in lengths.items():
        steps = [step if i else np.eye(4) for i in range(count)]
        keyframes = [Keyframe(i, i - 1, i, T, STEP, T, UP, 0.01, EMPTY) for i, T in enumerate(steps)]
        numbers[agent] = [graph.add_keyframe(agent, keyframe, STEP, UP) for keyframe in keyframes]
    return graph, numbers


def test_larger_maps_come_first_and_the_score_decides_within_one() -> None:
    graph, at = graph_of(ann=2, bob=9, eve=5)
    others = [at["eve"][1], at["bob"][4], at["eve"][0], at["bob"][2]]
    expected = [at["bob"][4], at["bob"][2], at["eve"][1], at["eve"][0]]
    assert rank_candidates(graph, at["ann"][1], others) == expected


def test_candidates_out_of_view_come_last() -> None:
    graph, at = graph_of(ann=20, bob=3)
    near, far, other = at["ann"][16], at["ann"][2], at["bob"][0]
    assert rank_candidates(graph, at["ann"][19], [far, other, near]) == [near, other, far]
