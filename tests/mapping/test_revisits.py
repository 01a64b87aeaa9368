"""Keyframes of an agent that waits to enter another's map are looked up again."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.atlas_sim import Walker, loop, settle

from share.config import MergeConfig
from share.mapping import revisits
from share.mapping.atlas import Atlas
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.revisits import Revisits

UNCERTAIN = np.diag([0.03**2] * 3 + [0.02**2] * 3)


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> tuple[Atlas, Revisits, Walker, Walker]:
    """Ann and bob in maps of their own, every keyframe looked up there."""
    monkeypatch.setattr(revisits, "_NEWEST", 3)
    ann, bob = Walker("ann", 0), Walker("bob", 1, n=12, turn=3.5 * np.pi / 59 * 11)
    atlas = Atlas(MergeConfig(join_places=1, enter_m=0.1))
    again = Revisits(atlas.graph)
    for walker in (ann, bob):
        for keyframe in walker.keyframes:
            assert not again.note_lookup(atlas.add_keyframe(walker.name, keyframe))
    settle(atlas)
    return atlas, again, ann, bob


def join(atlas: Atlas, ann: Walker, bob: Walker) -> None:
    """Two loops of a few inliers, which leave bob's place uncertain."""
    for at in (0, 1):
        seen = loop(ann, at, bob, at, np.random.default_rng(at))
        atlas.propose(Loop(seen.a, seen.b, seen.T_a_b, UNCERTAIN, 20))
    (applied,) = settle(atlas)
    assert applied.waiting_sigma_m.keys() <= {"bob"}


def test_who_waits_is_looked_up_again_the_newest_first(
    room: tuple[Atlas, Revisits, Walker, Walker],
) -> None:
    atlas, again, ann, bob = room
    assert atlas.waiting_segments() == []
    join(atlas, ann, bob)
    assert atlas.waiting_segments() == [atlas.graph.odometry.current_segment("bob")]
    found = []
    while (node_id := again.next_node(atlas.waiting_segments())) is not None:
        assert again.note_lookup(node_id)
        found.append(atlas.key(node_id))
    assert found == [KeyframeKey("bob", at) for at in (11, 10, 9)]


def test_who_has_entered_is_not(room: tuple[Atlas, Revisits, Walker, Walker]) -> None:
    atlas, again, ann, bob = room
    join(atlas, ann, bob)
    newest = atlas.graph.odometry.newest_node("bob")
    assert newest is not None and not atlas.is_placed(newest)
    atlas.propose(loop(ann, 11, bob, 11, np.random.default_rng(0)))
    settle(atlas)
    assert atlas.is_placed(newest)
    assert again.next_node(atlas.waiting_segments()) is None


def test_nor_who_has_gone_or_was_removed(room: tuple[Atlas, Revisits, Walker, Walker]) -> None:
    atlas, again, ann, bob = room
    join(atlas, ann, bob)
    segments = atlas.waiting_segments()
    atlas.set_present("bob", False)
    assert atlas.waiting_segments() == []
    for at in (11, 10, 9):
        again.remove(atlas.graph.odometry.node_id(KeyframeKey("bob", at)))
    assert again.next_node(segments) is None


def test_a_loop_of_one_looked_up_again_answers_no_keyframe(
    room: tuple[Atlas, Revisits, Walker, Walker],
) -> None:
    atlas, _, ann, bob = room
    join(atlas, ann, bob)
    assert atlas.propose(loop(ann, 3, bob, 3, np.random.default_rng(3)), is_answer=False).accepted
    (map_id,) = atlas.solving.due_maps()
    assert atlas.solving.make_job(map_id).answered_ids == ()
