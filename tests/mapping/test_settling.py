"""Agents that enter another map settle there first."""

from __future__ import annotations

import numpy as np
from helpers.atlas_sim import Walker, loop, settle

from share.config import MergeConfig
from share.mapping.atlas import Atlas
from share.mapping.settling import MAX_SETTLING_S, SETTLING_KEYFRAMES, Settling

ANN, BOB = range(2)


def met() -> tuple[Atlas, dict[str, Walker], np.random.Generator]:
    """Ann and Bob, each with ten keyframes, and enough loops between them to enter one map."""
    walkers = {name: Walker(name, seed, phase=0.4 * seed) for seed, name in enumerate(("ann", "bob"))}
    atlas, rng = Atlas(MergeConfig(enter_m=1.0)), np.random.default_rng(2)
    for k in range(10):
        for walker in walkers.values():
            atlas.add_keyframe(walker.name, walker.keyframes[k])
    settle(atlas)
    for k in range(0, 10, 3):
        atlas.propose(loop(walkers["ann"], k, walkers["bob"], k, rng))
    return atlas, walkers, rng


def test_who_enters_is_shown_the_map_after_two_further_keyframes() -> None:
    atlas, walkers, _ = met()
    shown = []
    for k in range(10, 14):
        shown += [one.corrections for one in settle(atlas) if "bob" in one.corrections]
        assert bool(shown) == (k >= 10 + SETTLING_KEYFRAMES)
        atlas.add_keyframe("bob", walkers["bob"].keyframes[k])
    assert shown[0]["bob"].map_id == "ann/0"


def test_the_map_is_solved_anew_for_each_of_them() -> None:
    """Also without a new loop: else the agent would wait for one."""
    atlas, walkers, _ = met()
    settle(atlas)
    for k in range(10, 10 + SETTLING_KEYFRAMES):
        assert atlas.solving.due_maps() == []
        atlas.add_keyframe("bob", walkers["bob"].keyframes[k])
        assert atlas.solving.due_maps() == ["ann/0"]
        settle(atlas)
    atlas.add_keyframe("bob", walkers["bob"].keyframes[10 + SETTLING_KEYFRAMES])
    assert atlas.solving.due_maps() == []


def test_who_makes_no_keyframes_enters_after_some_time() -> None:
    """Also when nothing else happens in the map: two who stand together have to meet."""
    atlas, *_ = met()
    assert not atlas.solving.note_time(100.0)
    assert not any("bob" in one.corrections for one in settle(atlas))
    assert not atlas.solving.note_time(100.0 + 0.9 * MAX_SETTLING_S) and atlas.solving.due_maps() == []
    assert atlas.solving.note_time(100.0 + MAX_SETTLING_S)
    (applied,) = settle(atlas)
    assert applied.corrections["bob"].map_id == "ann/0"
    assert not atlas.solving.note_time(200.0) and atlas.solving.due_maps() == []


def test_an_undone_merge_holds_no_correction_back_in_the_own_map() -> None:
    settling = Settling()
    settling.begin(BOB, ANN, 5)
    assert settling.continues(BOB, ANN, 6) and not settling.continues(BOB, BOB, 6)
    assert settling.is_settling(BOB, ANN)
    settling.begin(BOB, ANN, 9)
    assert settling.continues(BOB, ANN, 10) and not settling.continues(BOB, ANN, 9 + SETTLING_KEYFRAMES)


def test_a_segment_without_keyframes_is_forgotten() -> None:
    settling = Settling()
    settling.begin(BOB, ANN, 5)
    settling.forget_all_but([ANN])
    assert not settling.is_settling(BOB, ANN)
