"""What the mapper decides, and tells the edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.types import F64, Correction


@dataclass(frozen=True, eq=False)
class Finding:
    """Something decided about an agent's run, why, and the correction that follows, if one does."""

    agent: str
    what: str
    reason: str
    correction: Correction | None = None


def in_map(agent: str, map_id: str, T_map_odom: F64, about: int, cov: F64 | None = None) -> Finding:
    """Which map a run is in, before anything moves it there. A map is named after what founded it. about: a
    keyframe of the stretch. cov (6, 6): of T_map_odom; exact where it is the map's own gauge."""
    founds = "founds" if map_id.startswith(f"{agent}/") else "is in"
    return Finding(
        agent,
        "correction",
        f"{founds} map {map_id}",
        Correction(T_map_odom, np.zeros((6, 6)) if cov is None else cov, map_id, 0, about),
    )
