"""The most alike poses, found by a k-d tree and in slices."""

from __future__ import annotations

import tracemalloc
from collections import Counter

import numpy as np
import pytest

from share.geometry import se3
from share.mapping.loop_consistency import PLACE_M, PLACE_RAD
from share.mapping.redundancy import TwoNearest, redundant, run_without_pause
from share.types import F64


def walks(n: int, seed: int = 0) -> F64:
    """Poses of bodies that stand, walk and turn in a hall."""
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0, 0.3, n))
    t = np.column_stack([rng.uniform(0, 12, n), rng.uniform(0, 8, n), rng.normal(1.6, 0.05, n)])
    t[: n // 4] = t[0] + rng.normal(0, 0.01, (n // 4, 3))  # standing
    return se3.from_rt(se3.so3_exp(np.column_stack([rng.normal(0, 0.1, (n, 2)), yaw])), t)


def all_distances(poses: F64) -> F64:
    shift, angle = se3.pairwise_distances(poses, poses)
    distance = shift / PLACE_M + angle / PLACE_RAD
    np.fill_diagonal(distance, np.inf)
    return distance


def test_the_two_nearest_are_those_of_all_pairs() -> None:
    poses = walks(400)
    nearest = TwoNearest(poses)
    nearest.search(np.arange(400))
    expected = np.sort(all_distances(poses), axis=1)[:, :2]
    assert nearest.distance == pytest.approx(expected, abs=1e-6)


def test_neighbours_that_are_removed_are_replaced() -> None:
    poses = walks(300)
    nearest, distance = TwoNearest(poses), all_distances(poses)
    nearest.search(np.arange(300))
    removed = np.random.default_rng(1).permutation(300)[:200]
    for row in removed.tolist():
        nearest.search(nearest.remove(row))
    left = np.setdiff1d(np.arange(300), removed)
    distance[removed], distance[:, removed] = np.inf, np.inf
    assert nearest.distance[left] == pytest.approx(np.sort(distance[left], axis=1)[:, :2], abs=1e-6)


def test_the_same_are_removed_as_by_all_pairs() -> None:
    poses = walks(300)
    distance, left, expected = all_distances(poses), np.ones(300, bool), []
    for _ in range(60):
        two = np.sort(distance, axis=1)[:, :2]
        rank = np.where(left, two[:, 0] + 1e-3 * np.minimum(two[:, 1], 10), np.inf)
        expected.append(int(rank.argmin()))
        left[expected[-1]] = False
        distance[expected[-1]], distance[:, expected[-1]] = np.inf, np.inf
    assert run_without_pause(redundant(poses, ["ann"] * 300, Counter(ann=60))) == expected


@pytest.mark.long
def test_slices_and_memory_do_not_grow_with_the_square_of_the_map() -> None:
    """Each slice costs little, all of them together as much as there are poses."""
    costs, peaks = {}, {}
    for n in (2000, 16_000):
        poses = walks(n)
        tracemalloc.start()
        slices = list(redundant(poses, ["ann"] * n, Counter(ann=n // 20), 1.0))
        peaks[n] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        costs[n] = sum(slices)
        assert max(slices[1:]) < 400
        assert slices[0] <= 10 + n // 16
    assert costs[16_000] < 9 * costs[2000]
    assert peaks[16_000] < 10 * peaks[2000] < 16e6
