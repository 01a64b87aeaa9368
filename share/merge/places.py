"""How many places a set of poses is: neighbouring views of one spot are one witness, not many."""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.types import F64


def distinct(poses: F64, apart_m: float, apart_rad: float) -> int:
    """Of poses (N, 4, 4), as many as lie further than this, or are turned by more, from each one that
    was counted before it."""
    counted: list[F64] = []
    for T in poses:
        if counted:
            step = se3.inverse(np.array(counted)) @ T
            away = np.linalg.norm(step[:, :3, 3], axis=1)
            if ((away <= apart_m) & (se3.angle(step) <= apart_rad)).any():
                continue
        counted.append(T)
    return len(counted)
