"""Which keyframes are removed: fair between names, finished maps first."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from helpers.atlas_sim import EMPTY, STEP, UP, UP_SIGMA, Walker, loop

from share.config import MergeConfig
from share.geometry import se3
from share.mapping.agent_runs import AgentRuns
from share.mapping.atlas import Atlas
from share.mapping.culling import fair_quotas
from share.mapping.loop_consistency import articulation_segments
from share.mapping.loops import KeyframeKey
from share.mapping.segments import MIN_LOOP_GAP
from share.types import F64, Keyframe

CONFIG = MergeConfig()
STANDING = np.eye(4)


def walk(atlas: Atlas, run: str, name: str, count: int, step_m: float = 1.0, first: int = 0) -> None:
    """Add `count` keyframes of a run, `step_m` apart."""
    if first == 0:
        atlas.add_run(run, name)
    for k in range(first, first + count):
        T_odom_body = at(step_m * k)
        T = T_odom_body if k == 0 else at(step_m)
        keyframe = Keyframe(k, k - 1, k * 10**8, T, STEP, T_odom_body, UP, UP_SIGMA, EMPTY)
        keyframe, _ = atlas.reconnect(run, keyframe)
        atlas.add_keyframe(run, keyframe)


def at(x: float) -> F64:
    return se3.from_rt(np.eye(3), np.array([x, 0.0, 0.0]))


def held(atlas: Atlas) -> Counter[str]:
    """Number of keyframes of each run."""
    return Counter(key.agent for key in atlas.all_poses().keys)


def cull(atlas: Atlas, most: int) -> None:
    atlas.remove_keyframes(atlas.culling.choose(len(atlas) - most))


def test_the_name_with_most_keyframes_gives() -> None:
    held = Counter(ann=10, bob=50, eve=100)
    assert fair_quotas(held, held, 30, {}) == Counter(eve=30)
    assert fair_quotas(held, held, 60, {}) == Counter(eve=55, bob=5)
    assert fair_quotas(held, held, 150, {}) == Counter(eve=96, bob=47, ann=7)
    assert fair_quotas(held, Counter(ann=10, bob=50, eve=20), 30, {}) == Counter(eve=20, bob=10)
    assert fair_quotas(held, held, 1000, {}) == held


def test_among_equals_the_name_that_connected_longest_ago_gives() -> None:
    held = Counter(ann=1, bob=1, eve=1)
    assert fair_quotas(held, held, 1, {"eve": 0, "ann": 1, "bob": 2}) == Counter(eve=1)


def test_an_absent_run_is_superseded_by_a_newer_one_of_its_name() -> None:
    runs = AgentRuns()
    runs.add("ann-1", "ann")
    runs.set_present("ann-1", False)
    assert not runs.is_superseded("ann-1")
    runs.add("ann-2", "ann")
    assert runs.is_superseded("ann-1")
    runs.set_present("ann-2", False)
    assert runs.set_present("ann-1", True)
    assert (runs.is_superseded("ann-1"), runs.is_superseded("ann-2")) == (False, True)
    runs.remove("ann-2")
    assert runs.name("ann-2") == "ann-2"
    runs.set_present("ann-1", False)
    assert not runs.is_superseded("ann-1")  # no run of its name has come after it any more
    runs.add("ann-3", "ann")
    runs.remove("ann-3")
    assert not runs.is_superseded("ann-1")


@pytest.mark.parametrize(
    ("bonds", "expected"),
    [
        ([(0, 1), (1, 2)], {1}),
        ([(0, 1), (1, 2), (0, 2)], set()),
        ([(0, 1), (1, 2), (0, 2), (2, 3), (3, 4)], {2, 3}),
        ([(0, 1), (0, 2), (0, 3)], {0}),
        ([(0, 0), (0, 1), (5, 6)], set()),
    ],
)
def test_articulation_segments_disconnect_the_map(bonds: list[tuple[int, int]], expected: set[int]) -> None:
    assert articulation_segments(bonds) == expected


@pytest.mark.long
def test_many_small_runs_of_one_name_take_no_keyframe_of_others() -> None:
    atlas = Atlas(CONFIG)
    walk(atlas, "ann-1", "ann", 50)
    for k in range(40):
        walk(atlas, f"eve-{k}", "eve", 12)
        atlas.set_present(f"eve-{k}", False)
        if len(atlas) > 100:
            cull(atlas, 100)
            assert held(atlas)["ann-1"] == 50
            assert len(atlas) == 100


def test_many_small_runs_in_one_map_take_no_keyframe_of_others() -> None:
    ann, atlas, rng = Walker("ann", 1), Atlas(CONFIG), np.random.default_rng(0)
    atlas.add_run("ann", "ann")
    for keyframe in ann.keyframes:
        atlas.add_keyframe("ann", keyframe)
    for k in range(12):
        eve = Walker(f"eve-{k}", 10 + k, n=14)
        atlas.add_run(eve.name, "eve")
        for keyframe in eve.keyframes:
            atlas.add_keyframe(eve.name, keyframe)
        atlas.graph.add_loop(loop(ann, 5 * k, eve, 3, rng))
        atlas.set_present(eve.name, False)
        if len(atlas) > 120:
            cull(atlas, 120)
            assert len(atlas) == 120
            assert held(atlas)["ann"] == 60
    assert list(atlas.map_sizes()) == ["ann/0"]


def test_a_name_keeps_no_more_by_restarting() -> None:
    """A name with many runs gives as many keyframes as one with a single run."""
    atlas = Atlas(CONFIG)
    walk(atlas, "ann-1", "ann", 80)
    for k in range(4):
        walk(atlas, f"eve-{k}", "eve", 20)
        atlas.set_present(f"eve-{k}", False)
    walk(atlas, "bob-1", "bob", 80)
    cull(atlas, 150)
    by_name = Counter(key.agent.partition("-")[0] for key in atlas.all_poses().keys)
    assert by_name == Counter(ann=50, bob=50, eve=50)


def test_finished_maps_are_removed_first_and_whole() -> None:
    """The smallest first; a growing run keeps its keyframes."""
    atlas = Atlas(CONFIG)
    for k, count in enumerate((30, 12, 16)):
        walk(atlas, f"eve-{k}", "eve", count)
        atlas.set_present(f"eve-{k}", False)
    walk(atlas, "eve-9", "eve", 40)
    cull(atlas, 98 - 12 - 16 - 5)
    assert held(atlas) == Counter({"eve-0": 25, "eve-9": 40})
    assert atlas.is_run_gone("eve-1")
    assert not atlas.is_run_gone("eve-0")
    assert sorted(atlas.map_sizes()) == ["eve-0/0", "eve-9/0"]


def test_redundant_keyframes_are_removed_before_finished_maps() -> None:
    atlas = Atlas(CONFIG)
    walk(atlas, "eve-0", "eve", 20)
    atlas.set_present("eve-0", False)
    walk(atlas, "eve-1", "eve", 60, step_m=0.01)
    cull(atlas, 40)
    assert held(atlas) == Counter({"eve-0": 20, "eve-1": 20})


def test_new_segments_of_a_present_run_do_not_evade_its_quota() -> None:
    """Each is a map of its own with an anchor."""
    atlas = Atlas(CONFIG)
    walk(atlas, "ann-1", "ann", 30)
    atlas.add_run("eve-1", "eve")
    for k in range(100):
        keyframe = Keyframe(k, -1, k * 10**8, STANDING, STEP, STANDING, UP, UP_SIGMA, EMPTY)
        atlas.add_keyframe("eve-1", keyframe)
    cull(atlas, 60)
    assert held(atlas) == Counter({"ann-1": 30, "eve-1": 30})
    assert atlas.T_map_odom("eve-1") is not None


def test_an_absent_run_keeps_its_newest_keyframes() -> None:
    atlas = Atlas(CONFIG)
    walk(atlas, "ann-1", "ann", 60)
    atlas.set_present("ann-1", False)
    cull(atlas, 20)
    left = {key.id for key in atlas.all_poses().keys}
    assert left >= {0, *range(60 - MIN_LOOP_GAP, 60)}


def test_with_more_names_than_capacity_the_longest_absent_are_removed_whole() -> None:
    atlas = Atlas(CONFIG)
    for k in range(30):
        walk(atlas, f"n{k}-1", f"n{k}", 3)
        atlas.set_present(f"n{k}-1", False)
    cull(atlas, 20)
    assert len(atlas) <= 30  # the gauge of each map; what holds it may not go while its agent may come back
    assert all(count == 1 for count in held(atlas).values())


def test_newest_keyframes_of_absent_runs_are_removed_where_nothing_else_can_be() -> None:
    atlas = Atlas(CONFIG)
    walk(atlas, "ann-1", "ann", 12)
    for k in range(9):
        walk(atlas, f"n{k}-1", f"n{k}", 12)
        atlas.set_present(f"n{k}-1", False)
    cull(atlas, 47)
    assert held(atlas) == Counter({"ann-1": 12, "n0-1": 3} | {f"n{k}-1": 4 for k in range(1, 9)})


@pytest.mark.long
def test_many_absent_names_leave_a_present_one_its_share() -> None:
    atlas = Atlas(CONFIG)
    walk(atlas, "ann-1", "ann", 100)
    for k in range(50):
        walk(atlas, f"n{k}-1", f"n{k}", 12)
        atlas.set_present(f"n{k}-1", False)
        cull(atlas, 120)
        assert len(atlas) <= 120
    assert held(atlas)["ann-1"] == 60


def test_a_segment_that_connects_two_others_keeps_a_keyframe() -> None:
    ann, bob = Walker("ann", 1, n=20), Walker("bob", 2, n=20)
    eve, atlas, rng = Walker("eve-0", 3, n=20), Atlas(CONFIG), np.random.default_rng(0)
    for walker, name in ((ann, "ann"), (bob, "bob"), (eve, "eve")):
        atlas.add_run(walker.name, name)
        for keyframe in walker.keyframes:
            atlas.add_keyframe(walker.name, keyframe)
    for one in (loop(ann, 3, eve, 4, rng), loop(bob, 7, eve, 15, rng)):
        atlas.graph.add_loop(one)
    atlas.set_present("eve-0", False)
    walk(atlas, "eve-1", "eve", 20)
    everything = [n for n in atlas.graph.poses if atlas.key(n).agent == "eve-0"]
    assert len(atlas.remove_keyframes(everything)) == 19  # however they were chosen
    cull(atlas, 45)
    assert held(atlas)["eve-0"] == 1
    assert len(atlas) == 45
    assert len(set(atlas.all_poses().map_ids)) == 2  # eve's new run is alone; ann and bob are together
    assert atlas.map_id(KeyframeKey("ann", 0)) == atlas.map_id(KeyframeKey("bob", 19))


@pytest.mark.parametrize("all_gone", [False, True])
def test_a_run_continues_after_its_newest_keyframes_were_removed(all_gone: bool) -> None:
    atlas = Atlas(CONFIG)
    walk(atlas, "eve-0", "eve", 20)
    atlas.set_present("eve-0", False)
    walk(atlas, "eve-1", "eve", 5)
    numbers = [atlas.graph.odometry.node_id(KeyframeKey("eve-0", k)) for k in range(0 if all_gone else 8, 20)]
    assert len(atlas.remove_keyframes(numbers)) == len(numbers)
    assert atlas.is_run_gone("eve-0") is all_gone
    atlas.set_present("eve-1", False)
    atlas.set_present("eve-0", True)
    keyframe = Keyframe(20, 19, 20 * 10**8, at(1.0), STEP, at(20.0), UP, UP_SIGMA, EMPTY)
    tied, link = atlas.reconnect("eve-0", keyframe)
    atlas.add_keyframe("eve-0", tied)
    assert link is not None
    assert link.reference == (-1 if all_gone else 7)
    assert atlas.pose(KeyframeKey("eve-0", 20)) == pytest.approx(at(20.0))
    assert atlas.map_id(KeyframeKey("eve-0", 20)) == "eve-0/0"
    if not all_gone:
        assert link.T_ref_body == pytest.approx(at(13.0))
        assert np.trace(link.cov) > 12 * np.trace(STEP)
    walk(atlas, "eve-0", "eve", 3, first=21)
    assert len(atlas) == (4 if all_gone else 12) + 5
