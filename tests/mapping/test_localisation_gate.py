"""The localisation gate: which corrections pass, and which wait."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.atlas_sim import Walker, loop, settle

from share.config import MergeConfig
from share.mapping import localisation_gate
from share.mapping.atlas import Atlas
from share.mapping.localisation_gate import LocalisationGate, PlacementUncertainty, sigma_ahead
from share.mapping.loops import Loop

pytestmark = pytest.mark.usefixtures("entered_at_once")

ANN, BOB, EVE, ROBOT = ALL = range(4)  # segments, the oldest first


def known(cm: float, value: float = 1.0, answers: int | None = None) -> PlacementUncertainty:
    return PlacementUncertainty(value * np.eye(6), cm / 100, answers)


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> LocalisationGate:
    monkeypatch.setattr(localisation_gate, "PATIENCE", 3)
    return LocalisationGate(enter_m=0.05)


def test_corrections_in_the_own_map_pass_at_once(gate: LocalisationGate) -> None:
    assert gate.update(BOB, ALL, {BOB: known(80.0)}) == {}
    assert gate.published_cov(BOB, BOB) is not None
    assert gate.published_cov(BOB, ANN) is None


def test_a_small_sigma_passes_and_then_always(gate: LocalisationGate) -> None:
    assert gate.update(ANN, ALL, {BOB: known(4.9)}) == {}
    assert gate.update(ANN, ALL, {BOB: known(90.0, 2.0)}) == {}
    published = gate.published_cov(BOB, ANN)
    assert published is not None and (published == 2 * np.eye(6)).all()


def test_a_large_sigma_waits_in_the_own_map(gate: LocalisationGate) -> None:
    gate.update(BOB, ALL, {BOB: known(0.0)})
    assert gate.update(ANN, ALL, {BOB: known(7.0)}) == {BOB: pytest.approx(0.07)}
    assert gate.published_cov(BOB, ANN) is None
    assert gate.published_cov(BOB, BOB) is not None
    assert gate.update(ANN, ALL, {BOB: known(4.0)}) == {}
    assert gate.published_cov(BOB, ANN) is not None


def test_segments_of_one_map_enter_together(gate: LocalisationGate) -> None:
    gate.update(BOB, ALL, {BOB: known(0.0), EVE: known(1.0)})
    found = {BOB: known(2.0), EVE: known(7.0), ROBOT: known(1.0)}
    assert gate.update(ANN, ALL, found).keys() == {BOB, EVE}  # the robot comes from a map of its own
    assert gate.update(ANN, ALL, {BOB: known(2.0), EVE: known(3.0)}) == {}


def test_the_wait_is_bounded_by_keyframes_with_loops(gate: LocalisationGate) -> None:
    for keyframe in (2, 5, 9):
        for answers in (keyframe, keyframe, None):
            assert gate.update(ANN, ALL, {BOB: known(20.0, answers=answers)})
    assert not gate.update(ANN, ALL, {BOB: known(20.0, answers=11)})
    assert gate.published_cov(BOB, ANN) is not None


def test_the_gate_opens_wider_with_the_keyframes_that_did_not_help() -> None:
    gate = LocalisationGate(enter_m=0.05)
    waits = [bool(gate.update(ANN, ALL, {BOB: known(9.9, answers=keyframe)})) for keyframe in range(16)]
    assert waits == [True] * 15 + [False]


def test_a_robot_waits_until_it_is_surer_unless_it_comes_with_a_wearer(gate: LocalisationGate) -> None:
    robot = dataclasses.replace(known(2.1), is_worn=False)
    gate.update(ROBOT, ALL, {ROBOT: known(0.0)})
    assert gate.update(ANN, ALL, {ROBOT: robot}).keys() == {ROBOT}
    assert not gate.update(ANN, ALL, {ROBOT: dataclasses.replace(robot, sigma_m=0.019)})
    gate.update(BOB, ALL, {BOB: known(0.0), EVE: dataclasses.replace(robot, sigma_m=0.0)})
    assert not gate.update(ANN, ALL, {BOB: known(3.0), EVE: robot})


def test_a_rotation_counts_by_what_is_three_metres_ahead() -> None:
    cov = np.diag([0.01**2, 0.0, 0.0, 0.04**2, 0.0, 0.0])
    assert sigma_ahead(cov) == pytest.approx(0.05)


def test_the_wait_restarts_for_another_map(gate: LocalisationGate) -> None:
    for reference in (EVE, ANN):
        for keyframe in range(3):
            assert gate.update(reference, ALL, {ROBOT: known(20.0, answers=keyframe)})


def test_the_wait_restarts_after_an_undone_merge(gate: LocalisationGate) -> None:
    for keyframe in range(4):
        gate.update(ANN, ALL, {BOB: known(20.0, answers=keyframe)})
    assert gate.published_cov(BOB, ANN) is not None  # its wait was over
    gate.forget_waits({BOB})
    gate.update(BOB, [BOB], {BOB: known(0.0)})
    assert gate.update(ANN, ALL, {BOB: known(60.0, answers=9)})


def test_after_a_false_merge_the_own_map_is_published_again(gate: LocalisationGate) -> None:
    gate.update(BOB, [BOB, EVE], {BOB: known(0.0), EVE: known(0.0)})
    gate.update(ANN, ALL, {BOB: known(1.0), EVE: known(1.0)})
    assert not gate.update(BOB, [BOB, EVE], {BOB: known(0.0), EVE: known(30.0)})
    assert gate.published_cov(EVE, BOB) is not None


def test_a_restored_segment_stays_published(gate: LocalisationGate) -> None:
    gate.restore(BOB, ANN)
    assert gate.published_cov(BOB, ANN) is None  # how surely is asked
    assert not gate.update(ANN, ALL, {BOB: known(30.0)})
    assert gate.published_cov(BOB, ANN) is not None


# ---------------------------------------------------------------- in the atlas


def uncertain_loop(ann: Walker, bob: Walker, at: int) -> Loop:
    """A loop of a few inliers, with a large covariance."""
    rng = np.random.default_rng(at)
    sigma = np.diag([0.03**2] * 3 + [0.02**2] * 3)
    seen = loop(ann, at, bob, at, rng)
    return Loop(seen.a, seen.b, seen.T_a_b, sigma, 20)


def separate_maps() -> tuple[Atlas, Walker, Walker]:
    """Ann and bob in maps of their own, which see the same."""
    ann, bob = Walker("ann", 0), Walker("bob", 1, n=12, turn=3.5 * np.pi / 59 * 11)
    atlas = Atlas(MergeConfig(join_places=1, enter_m=0.1))
    for walker in (ann, bob):
        for keyframe in walker.keyframes:
            atlas.add_keyframe(walker.name, keyframe)
    settle(atlas)
    return atlas, ann, bob


def test_a_correction_waits_until_the_pose_in_the_map_is_known() -> None:
    atlas, ann, bob = separate_maps()
    assert atlas.propose(uncertain_loop(ann, bob, 0)).joined_maps is None
    assert atlas.propose(uncertain_loop(ann, bob, 1)).joined_maps == ("ann/0", "bob/0")
    (applied,) = settle(atlas)
    assert list(applied.corrections) == ["ann"]
    assert applied.waiting_sigma_m.keys() == {"bob"}
    assert 0.1 < applied.waiting_sigma_m["bob"] < 0.5
    atlas.propose(loop(ann, 11, bob, 11, np.random.default_rng(0)))
    (applied,) = settle(atlas)
    assert applied.corrections["bob"].map_id == "ann/0"
    assert not applied.waiting_sigma_m


def test_absent_agents_delay_no_correction_and_get_theirs_when_they_return() -> None:
    """As above; bob is absent while its pose becomes certain."""
    atlas, ann, bob = separate_maps()
    atlas.set_present("bob", False)
    atlas.propose(uncertain_loop(ann, bob, 0))
    assert atlas.propose(uncertain_loop(ann, bob, 1)).joined_maps == ("ann/0", "bob/0")
    (applied,) = settle(atlas)
    assert not applied.waiting_sigma_m
    atlas.propose(loop(ann, 11, bob, 11, np.random.default_rng(0)))
    (applied,) = settle(atlas)
    assert list(applied.corrections) == ["ann"]
    assert not atlas.solving.due_maps()
    atlas.set_present("bob", True)
    (applied,) = settle(atlas)
    assert applied.corrections["bob"].map_id == "ann/0"
    atlas.set_present("bob", True)
    assert not atlas.solving.due_maps()


@pytest.mark.parametrize("solved_between", [True, False])
def test_the_wait_restarts_when_a_merge_is_undone_and_made_again(
    solved_between: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also at once, where better evidence undoes it."""
    monkeypatch.setattr(localisation_gate, "PATIENCE", 1)
    atlas, ann, bob = separate_maps()
    for first in (0, 2):
        joined = [atlas.propose(uncertain_loop(ann, bob, at)).joined_maps for at in (first, first + 1)]
        assert joined == [None, ("ann/0", "bob/0")]
        assert settle(atlas)[-1].waiting_sigma_m.keys() == {"bob"}  # one keyframe of bob has loops
        atlas.graph.drop_loops(list(atlas.graph.edges.loops))
        if solved_between:
            settle(atlas)


def test_segments_without_keyframes_are_forgotten() -> None:
    gate = LocalisationGate(0.05)
    gate.restore(2, 0)
    gate.forget_all_but([0, 1])
    assert not gate.is_published(2, 0)
