"""Which stretches hold a map together."""

from __future__ import annotations

from collections.abc import Iterable


def bridging(bonds: Iterable[tuple[int, int]]) -> set[int]:
    """Stretches without which others of their map were not tied any more: the articulation points of the
    graph of `bonds` (Hopcroft and Tarjan, CACM 1973)."""
    beside: dict[int, list[int]] = {}
    for a, b in bonds:
        if a != b:
            beside.setdefault(a, []).append(b)
            beside.setdefault(b, []).append(a)
    depth: dict[int, int] = {}
    low: dict[int, int] = {}
    out: set[int] = set()
    for root in beside:
        if root in depth:
            continue
        depth[root] = low[root] = 0
        way, children = [(root, iter(beside[root]))], 0
        while way:
            here, others = way[-1]
            for other in others:
                if other not in depth:
                    depth[other] = low[other] = len(way)
                    way.append((other, iter(beside[other])))
                    break
                low[here] = min(low[here], depth[other])
            else:
                way.pop()
                if not way:
                    continue
                before = way[-1][0]
                low[before] = min(low[before], low[here])
                if before == root:
                    children += 1
                elif low[here] >= depth[before]:
                    out.add(before)
        if children > 1:
            out.add(root)
    return out
