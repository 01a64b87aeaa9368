"""The poses of all keyframes in one array."""

from __future__ import annotations

import numpy as np
import pytest

from share.geometry import se3
from share.mapping.pose_table import PoseTable
from share.types import F64


def random_poses(n: int, seed: int = 0) -> F64:
    return se3.exp(np.random.default_rng(seed).normal(0, [0.5, 0.5, 0.5, 3, 3, 1], (n, 6)))


def table_of(poses: F64, first: int = 10) -> PoseTable:
    table = PoseTable()
    for k, T in enumerate(poses):
        table[first + k] = T
    return table


def test_it_is_a_mapping_in_order_of_the_ids() -> None:
    poses = random_poses(200)
    table = table_of(poses)
    assert list(table) == list(range(10, 210)) and len(table) == 200
    assert 10 in table and 210 not in table and 9 not in table
    assert np.array_equal(table[57], poses[47])
    table[57] = poses[0]
    assert np.array_equal(table[57], poses[0]) and len(table) == 200
    with pytest.raises(KeyError):
        table[210]
    with pytest.raises(ValueError, match="does not come after"):
        table[9] = poses[0]


def test_a_pose_that_was_read_does_not_change_with_the_table() -> None:
    table = table_of(random_poses(3))
    before = table[11]
    copy = before.copy()
    table[11] = np.eye(4)
    assert np.array_equal(before, copy)


def test_removed_poses_are_gone_and_make_room() -> None:
    poses = random_poses(500)
    table = table_of(poses)
    for node_id in range(10, 510):
        if node_id % 5:
            del table[node_id]
    table[600] = poses[3]  # more than fits: the rows of removed ones are dropped
    left = [*range(10, 510, 5), 600]
    assert list(table) == left
    assert np.array_equal(table.stack(left), np.concatenate([poses[::5], poses[3:4]]))
    for gone in (11, 509):
        with pytest.raises(KeyError, match=str(gone)):
            table.stack([10, gone])
        with pytest.raises(KeyError):
            del table[gone]
    assert {*table.near(poses[0], 1e6)[0].tolist()} == {*left}


def test_only_known_nodes_are_assigned() -> None:
    table = table_of(random_poses(4))
    del table[12]
    new = random_poses(6, seed=1)
    table.assign([9, 10, 12, 13, 14, 5], new)
    assert list(table) == [10, 11, 13]
    assert np.array_equal(table.stack([13, 10]), new[[3, 1]])
    empty = PoseTable()
    empty.assign([0, 1], new[:2])
    assert len(empty) == 0 and empty.stack([]).shape == (0, 4, 4)


def test_near_poses_are_found() -> None:
    poses = random_poses(300)
    table = table_of(poses)
    node_ids, T = table.near(poses[7], 2.0)
    is_near = np.linalg.norm(poses[:, :3, 3] - poses[7, :3, 3], axis=1) < 2.0
    assert np.array_equal(node_ids, 10 + np.flatnonzero(is_near))
    assert np.array_equal(T, poses[is_near])
