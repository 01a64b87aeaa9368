"""Runs of one room or one recorded motion are in one part, and no part is empty."""

from __future__ import annotations

import numpy as np
import pytest

from share.lab.train.keyframe_table import PARTS, room_groups, split_runs


def about(scene="warehouse", seed=1, motions=("ar=walk:speed=0.6",), session="s"):
    return {"session": session, "provenance": {"scene": scene, "seed": seed, "motions": list(motions)}}


def test_runs_in_one_room_are_one_group():
    found = room_groups([about(seed=1), about(seed=2), about(seed=1), about("firestation", 1)])
    assert found[0] == found[2]
    assert len(set(found.tolist())) == 3


def test_a_recorded_motion_joins_rooms_and_a_planned_one_does_not():
    found = room_groups(
        [about(seed=1, motions=["paper:1"]), about(seed=2, motions=["paper:1"]), about(seed=3)]
    )
    assert found[0] == found[1] != found[2]
    chained = room_groups(
        [
            about(seed=1, motions=["a=paper:1"]),
            about(seed=2, motions=["b=tum:x.tum"]),
            about(seed=3, motions=["a=paper:1", "b=tum:x.tum"]),
        ]
    )
    assert chained[0] == chained[2] == chained[1]


def test_recordings_of_real_rooms_are_groups_of_their_own():
    real = {"session": "field", "provenance": {}}
    found = room_groups([real, about(), {"session": "field", "provenance": {}}])
    assert found[0] == found[2] != found[1]


@pytest.mark.parametrize("rooms", [4, 5, 9, 40])
def test_parts_are_whole_groups_and_none_is_empty(rooms):
    group = np.repeat(np.arange(rooms), 3)
    parts = split_runs(group, seed=1)
    assert list(parts) == list(PARTS)
    assert sorted(np.concatenate(list(parts.values())).tolist()) == list(range(3 * rooms))
    assert all(len(runs) for runs in parts.values())
    groups = [set(group[runs].tolist()) for runs in parts.values()]
    assert sum(map(len, groups)) == rooms
    assert len(parts["train"]) == max(map(len, parts.values()))


def test_the_seed_decides_the_split():
    group = np.arange(20)
    one, same, other = (split_runs(group, seed)["test"].tolist() for seed in (1, 1, 2))
    assert one == same != other
