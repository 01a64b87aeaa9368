"""How many places a set of poses is: neighbouring views of one spot are one witness, not many."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from share.types import F64


def distinct(poses: F64, apart_m: float, apart_rad: float, enough: int | None = None) -> int:
    """Of poses (N, 4, 4), as many as lie further than this, or are turned by more, from each one that
    was counted before it. With `enough` counting ends there."""
    count = 0
    while len(poses) and count != enough:
        count += 1
        poses = poses[~_near(poses[0], poses, apart_m, apart_rad)]
    return count


def near_any(T: F64, poses: Sequence[F64], within_m: float, within_rad: float) -> bool:
    """Whether pose T (4, 4) lies as near as this to one of the others."""
    return len(poses) > 0 and bool(_near(T, np.array(poses), within_m, within_rad).any())


def _near(T: F64, poses: F64, within_m: float, within_rad: float) -> NDArray[np.bool_]:
    """Which of poses (N, 4, 4) lie as near as this to T (4, 4); T itself does, whatever was rounded."""
    shift = poses[:, :3, 3] - T[:3, 3]
    cosine = (poses[:, :3, :3].reshape(-1, 9) @ T[:3, :3].ravel() - 1) / 2
    near = ((shift**2).sum(1) <= within_m**2) & (cosine >= min(np.cos(within_rad), 1 - 1e-9))
    return np.asarray(near)
