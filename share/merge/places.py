"""How many places a set of poses is: neighbouring views of one spot are one witness, not many."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from share.types import F64


def distinct(poses: F64, apart_m: float, apart_rad: float, enough: int | None = None) -> int:
    """Of poses (N, 4, 4), as many as lie further than this, or are turned by more, from each one that
    was counted before it. With `enough` counting ends there."""
    counted: list[F64] = []
    for T in poses:
        if enough is not None and len(counted) >= enough:
            break
        if not near_any(T, counted, apart_m, apart_rad):
            counted.append(T)
    return len(counted)


def near_any(T: F64, poses: Sequence[F64], within_m: float, within_rad: float) -> bool:
    """Whether pose T (4, 4) lies as near as this to one of the others."""
    if not len(poses):
        return False
    others = np.array(poses)
    away = np.linalg.norm(others[:, :3, 3] - T[:3, 3], axis=1)
    cosine = (np.einsum("nij,ij->n", others[:, :3, :3], T[:3, :3]) - 1) / 2
    return bool(((away <= within_m) & (cosine >= np.cos(within_rad))).any())
