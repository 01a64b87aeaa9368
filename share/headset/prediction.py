"""Where a head will be when a frame is shown: its newest pose, carried on at constant velocity and turn."""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.types import F64

MAX_AHEAD_S = 0.1  # beyond, a head has turned otherwise


def predict_pose(T_world_body: F64, velocity: F64, angular_velocity: F64, ahead_s: float) -> F64:
    """Return T_world_body (4, 4) `ahead_s` later, at most MAX_AHEAD_S.

    velocity (3,) m/s along the world's axes, angular_velocity (3,) rad/s about the body's.
    """
    ahead_s = min(max(ahead_s, 0.0), MAX_AHEAD_S)
    R = T_world_body[:3, :3] @ se3.so3_exp(np.asarray(angular_velocity) * ahead_s)
    return se3.from_rt(R, T_world_body[:3, 3] + np.asarray(velocity) * ahead_s)
