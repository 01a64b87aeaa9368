"""Which poses of a map are most alike, and so redundant.

The distance of two poses is |shift| / PLACE_M + angle / PLACE_RAD. In the space of positions / PLACE_M and
rotation matrices / (sqrt(2) PLACE_RAD) the Euclidean distance is never larger, since |R_a - R_b| <= sqrt(2)
angle: a k-d tree in it finds all near poses (Bentley, CACM 18(9), 1975).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from share.mapping.loop_consistency import PLACE_M, PLACE_RAD
from share.types import F64, I64

T = TypeVar("T")
# Work in slices, each with its cost in some 10 us, with a result at the end.
InSlices = Generator[int, None, T]

_ROWS_PER_SLICE = 128  # poses whose neighbours are searched for
_REMOVED_PER_SLICE = 32
_POSES_PER_COST = 16  # prepared
_REMOVAL_COST = 10
_NEIGHBOURS = 8  # searched for at first; removed ones count
_MAX_NEIGHBOURS = 512  # beyond, a pose counts as alone
_NO_NEIGHBOUR_DISTANCE = 1e9  # of a pose without others
_SECOND_WEIGHT = 1e-3  # of the second neighbour's distance, which decides between a pair
_MAX_SECOND = 10.0  # of that distance; further ones count as this


def run_without_pause(work: InSlices[T]) -> T:
    """Return the result of work in slices, without a pause."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            result: T = end.value
            return result


def redundant(
    poses: F64, owners: Sequence[str | None], quotas: Counter[str], max_distance: float = np.inf
) -> InSlices[list[int]]:
    """Select poses (N, 4, 4) to remove, by index, in order of removal.

    Repeatedly takes one of the closest pair, the one whose second neighbour is nearer, while the pair is
    closer than `max_distance`. owners: name of each pose; None: must stay. quotas: removals of each name;
    counted down.
    """
    if len(poses) == 1:  # of many runs that are over at once
        yield 1
        return _redundant_alone(owners[0], quotas) if max_distance == np.inf else []
    nearest = TwoNearest(poses, max_distance)
    names = np.array([name or "" for name in owners])
    is_removable = np.array([name is not None and quotas[name] > 0 for name in owners], bool)
    rank = np.full(len(poses), np.inf)
    yield 10 + len(poses) // _POSES_PER_COST
    candidates = np.flatnonzero(is_removable)
    for first in range(0, len(candidates), _ROWS_PER_SLICE):
        rows = candidates[first : first + _ROWS_PER_SLICE]
        rank[rows] = nearest.search(rows)
        yield len(rows)
    out: list[int] = []
    while is_removable.any():
        removed = int(np.where(is_removable, rank, np.inf).argmin())
        if nearest.distance[removed, 0] > max_distance:
            break
        out.append(removed)
        quotas[str(names[removed])] -= 1
        is_removable[removed] = False
        if not quotas[str(names[removed])]:
            is_removable[names == names[removed]] = False
        stale = nearest.remove(removed)
        stale = stale[is_removable[stale]]
        rank[stale] = nearest.search(stale)
        if len(out) % _REMOVED_PER_SLICE == 0:
            yield _REMOVED_PER_SLICE * _REMOVAL_COST
    return out


def _redundant_alone(owner: str | None, quotas: Counter[str]) -> list[int]:
    """Return what `redundant` does of a pose without others."""
    if owner is None or quotas[owner] <= 0:
        return []
    quotas[owner] -= 1
    return [0]


class TwoNearest:
    """The two nearest neighbours of each of N poses, while poses are removed.

    index, distance (N, 2): after `search`; inf where there is none nearer than `max_distance`, or only behind
    `_MAX_NEIGHBOURS` others.
    """

    def __init__(self, poses: F64, max_distance: float = np.inf) -> None:
        from scipy.spatial import KDTree

        rotations = poses[:, :3, :3].reshape(-1, 9) / (np.sqrt(2) * PLACE_RAD)
        self._points = np.concatenate([poses[:, :3, 3] / PLACE_M, rotations], axis=1)
        self._tree = KDTree(self._points, balanced_tree=False, compact_nodes=False)
        self._is_kept = np.ones(len(poses), bool)
        self._max_distance = max_distance
        self.index = np.full((len(poses), 2), -1)
        self.distance = np.full((len(poses), 2), np.inf)

    def search(self, rows: I64) -> F64:
        """Find the neighbours of poses `rows` (K,), and return how redundant each is (K,): less is more."""
        todo, count = rows, _NEIGHBOURS
        while len(todo):
            count = min(count, len(self._points))
            is_certain = self._search_among(todo, count)
            if count >= min(_MAX_NEIGHBOURS, len(self._points)):
                break
            todo, count = todo[~is_certain], 4 * count
        rank = self.distance[rows, 0] + _SECOND_WEIGHT * np.minimum(self.distance[rows, 1], _MAX_SECOND)
        return np.asarray(np.minimum(rank, _NO_NEIGHBOUR_DISTANCE))

    def remove(self, row: int) -> I64:
        """Remove a pose; return those of which it was a neighbour."""
        self._is_kept[row] = False
        return np.flatnonzero((self.index == row).any(axis=1) & self._is_kept)

    def _search_among(self, rows: I64, count: int) -> NDArray[np.bool_]:
        """Take the neighbours of `rows` (K,) from their `count` nearest in the tree; return where no other
        can be nearer (K,)."""
        reach, found = self._tree.query(
            self._points[rows], np.arange(1, count + 1), distance_upper_bound=self._max_distance
        )
        is_found = found < len(self._points)
        found = np.where(is_found, found, 0)
        distance = _distance(self._points[rows, None], self._points[found])
        distance[~is_found | ~self._is_kept[found] | (found == rows[:, None])] = np.inf
        two = np.argsort(distance, axis=1, kind="stable")[:, :2]
        self.index[rows, : two.shape[1]] = np.take_along_axis(found, two, axis=1)
        self.distance[rows, : two.shape[1]] = np.take_along_axis(distance, two, axis=1)
        return np.asarray((self.distance[rows, 1] <= reach[:, -1]) | ~is_found[:, -1])


def _distance(a: F64, b: F64) -> F64:
    """Distance of poses, as points of the tree (..., 12)."""
    difference = a - b
    shift = np.sqrt((difference[..., :3] ** 2).sum(axis=-1))
    chord = np.sqrt((difference[..., 3:] ** 2).sum(axis=-1)) * PLACE_RAD / 2  # sin(angle / 2)
    return np.asarray(shift + 2 * np.arcsin(np.minimum(chord, 1.0)) / PLACE_RAD)
