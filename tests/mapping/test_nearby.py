"""Which keyframes of its map a keyframe is aligned with."""

from __future__ import annotations

import numpy as np
import pytest

from share.config import MergeConfig
from share.geometry import se3
from share.mapping.atlas import Atlas
from share.mapping.candidates import nearby_candidates
from share.mapping.loops import KeyframeKey, Loop
from share.types import Keyframe, View

COV = 1e-6 * np.eye(6)


def at(x: float, yaw: float = 0.0) -> np.ndarray:
    return se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, yaw])), np.array([x, 0.0, 0.0]))


def atlas_of(**poses: list[np.ndarray]) -> tuple[Atlas, dict[str, list[int]]]:
    """Agents with keyframes at these poses (4, 4) of their odometry, and the node ids."""
    atlas, nodes = Atlas(MergeConfig()), {}
    for agent, of_agent in poses.items():
        atlas.add_run(agent, agent)
        nodes[agent] = []
        for k, T in enumerate(of_agent):
            T_ref_body = se3.inverse(of_agent[k - 1]) @ T if k else T
            sent = Keyframe(k, k - 1, k, T_ref_body, COV, T, np.zeros(3), 0.0, View.empty())
            nodes[agent].append(atlas.add_keyframe(agent, sent))
    return atlas, nodes


def there_and_back() -> list[np.ndarray]:
    """0 to 12 m in steps of 0.5, and back beside it."""
    return [at(0.5 * k) for k in range(25)] + [at(12 - 0.5 * k + 0.1) for k in range(25)]


def test_those_that_see_most_come_first_without_its_neighbours_by_odometry() -> None:
    atlas, nodes = atlas_of(ann=there_and_back())
    ann = nodes["ann"]
    found = nearby_candidates(atlas.graph, ann[-5], set(ann))
    poses = atlas.graph.poses
    distance = [np.linalg.norm(poses[n][:3, 3] - poses[ann[-5]][:3, 3]) for n in found]
    assert len(found) == 2  # of one segment
    assert distance == sorted(distance) and max(distance) < 1.0
    excluded = {ann[-5], *atlas.graph.odometry.neighbours(ann[-5])}
    assert not excluded & set(found)
    assert all(n in ann[:10] for n in found)


def test_only_eligible_ones_are_named() -> None:
    atlas, nodes = atlas_of(ann=there_and_back())
    ann = nodes["ann"]
    every = nearby_candidates(atlas.graph, ann[-5], set(ann))
    rest = set(ann) - {every[0]}
    assert every[0] not in nearby_candidates(atlas.graph, ann[-5], rest)
    assert nearby_candidates(atlas.graph, ann[-5], set()) == []


@pytest.mark.parametrize(("T", "is_near"), [(at(1.7), True), (at(1.9), False), (at(0.0, 0.65), True)])
def test_the_limits_are_of_distance_and_angle(T: np.ndarray, is_near: bool) -> None:
    atlas, nodes = atlas_of(ann=[at(0.0)], bob=[T])
    merge(atlas, "ann", "bob", at(0.0), T)
    found = nearby_candidates(atlas.graph, nodes["bob"][0], {*nodes["ann"], *nodes["bob"]})
    assert found == (nodes["ann"] if is_near else [])


def merge(atlas: Atlas, a: str, b: str, T_a: np.ndarray, T_b: np.ndarray) -> None:
    """One map of both, by their first keyframes at T_a, T_b (4, 4) of one frame."""
    loop = Loop(KeyframeKey(a, 0), KeyframeKey(b, 0), se3.inverse(T_a) @ T_b, COV, 80)
    atlas.graph.add_loop(loop)
    atlas.graph.update_maps()


def test_other_maps_are_not_searched_and_every_agent_of_this_one_is() -> None:
    line = [at(0.2 * k) for k in range(6)]
    atlas, nodes = atlas_of(ann=line, bob=line, eve=line)
    merge(atlas, "ann", "bob", at(0.0), at(0.0))
    everyone = {n for of_agent in nodes.values() for n in of_agent}
    found = nearby_candidates(atlas.graph, nodes["bob"][3], everyone)
    assert len(found) == 2 and set(found) <= set(nodes["ann"])
    merge(atlas, "ann", "eve", at(0.0), at(0.0))
    found = nearby_candidates(atlas.graph, nodes["bob"][3], everyone)
    assert len(found) == 3  # two at most of one segment
    assert set(found) & set(nodes["ann"]) and set(found) & set(nodes["eve"])
    assert found[0] in (nodes["ann"][3], nodes["eve"][3])
