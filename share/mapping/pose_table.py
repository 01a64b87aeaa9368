"""The poses of all keyframes in one array, by node id."""

from __future__ import annotations

from collections.abc import Iterator, MutableMapping, Sequence

import numpy as np
from numpy.typing import NDArray

from share.types import F64, I64

_MIN_ROWS = 64


class PoseTable(MutableMapping[int, F64]):
    """Poses T (4, 4) by node id, in ascending order of the ids; a new id is above all before it.

    What concerns many poses is done on the array at once: one by one, 20,000 poses take tens of milliseconds.
    """

    def __init__(self) -> None:
        self._rows: dict[int, int] = {}
        self._ids = np.zeros(_MIN_ROWS, np.int64)  # ascending, also of removed poses
        self._T = np.full((_MIN_ROWS, 4, 4), np.nan)  # NaN where removed
        self._used = 0  # rows

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[int]:
        return iter(self._rows)

    def __contains__(self, node_id: object) -> bool:
        return node_id in self._rows

    def __getitem__(self, node_id: int) -> F64:
        T: F64 = self._T[self._rows[node_id]].copy()
        return T

    def __setitem__(self, node_id: int, T: F64) -> None:
        """Raises ValueError for a new id that is not above all before it."""
        if node_id not in self._rows:
            self._append(node_id)
        self._T[self._rows[node_id]] = T

    def __delitem__(self, node_id: int) -> None:
        self._T[self._rows.pop(node_id)] = np.nan

    def stack(self, node_ids: Sequence[int] | I64) -> F64:
        """Poses (N, 4, 4) of these nodes. Raises KeyError if one is unknown."""
        rows, is_known = self._find(np.asarray(node_ids, np.int64))
        if not is_known.all():
            raise KeyError(int(np.asarray(node_ids)[~is_known][0]))
        T: F64 = self._T[rows]
        return T

    def assign(self, node_ids: Sequence[int] | I64, T: F64) -> None:
        """Set the poses (N, 4, 4) of those of these nodes that are known."""
        rows, is_known = self._find(np.asarray(node_ids, np.int64))
        if is_known.all():
            self._T[rows] = T
        else:
            self._T[rows[is_known]] = T[is_known]

    def near(self, T: F64, max_m: float) -> tuple[I64, F64]:
        """Nodes (N,) whose positions are nearer than `max_m` to that of T (4, 4), and their poses (N, 4, 4);
        of all maps."""
        shift = self._T[: self._used, :3, 3] - T[:3, 3]
        rows = np.flatnonzero((shift * shift).sum(axis=1) < max_m**2)  # False for NaN
        return self._ids[rows], self._T[rows]

    def _find(self, node_ids: I64) -> tuple[I64, NDArray[np.bool_]]:
        """Rows (N,) of nodes, and which of them are known (N,)."""
        rows = np.searchsorted(self._ids[: self._used], node_ids)
        rows = np.minimum(rows, max(0, self._used - 1))
        is_known = (self._ids[rows] == node_ids) & ~np.isnan(self._T[rows, 3, 3])
        return rows, is_known

    def _append(self, node_id: int) -> None:
        if self._used and node_id <= self._ids[self._used - 1]:
            raise ValueError(f"node {node_id} does not come after node {self._ids[self._used - 1]}")
        if self._used == len(self._ids):
            self._make_room()
        self._ids[self._used] = node_id
        self._rows[node_id] = self._used
        self._used += 1

    def _make_room(self) -> None:
        """Drop the rows of removed poses, and double the arrays if few were."""
        kept = np.fromiter(self._rows.values(), np.int64, len(self._rows))
        size = max(_MIN_ROWS, 2 * len(kept))
        ids, T = np.zeros(size, np.int64), np.full((size, 4, 4), np.nan)
        ids[: len(kept)], T[: len(kept)] = self._ids[kept], self._T[kept]
        self._ids, self._T, self._used = ids, T, len(kept)
        self._rows = {int(node_id): row for row, node_id in enumerate(ids[: len(kept)])}
