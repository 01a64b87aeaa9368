"""The fewest loops that would have to be false for two stretches not to belong together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from share.types import I64


def fewest(pairs: Sequence[tuple[int, int]], start: int, goal: int) -> list[int]:
    """Indices of the pairs (loops, by the stretches that they tie) without which no way leads from
    `start` to `goal`: a minimum cut (Ford and Fulkerson 1956). Raises ValueError if start is goal.
    """
    if start == goal:
        raise ValueError("a stretch cannot be cut from itself")
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    names = sorted({start, goal, *(end for pair in pairs for end in pair)})
    place = {name: i for i, name in enumerate(names)}
    ends: I64 = np.array([(place[a], place[b]) for a, b in pairs], np.int64).reshape(-1, 2)
    both = np.concatenate([ends, ends[:, ::-1]])
    n = len(names)
    capacity = csr_array((np.ones(len(both), np.int32), (both[:, 0], both[:, 1])), shape=(n, n))
    capacity.sum_duplicates()
    flow = maximum_flow(capacity, place[start], place[goal]).flow
    left = capacity - flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    near = np.zeros(n, bool)
    near[breadth_first_order(left, place[start], return_predecessors=False)] = True
    return [int(i) for i in np.flatnonzero(near[ends[:, 0]] != near[ends[:, 1]])]
