"""No agent is believed to be surer than a good one can be, whatever it says."""

from __future__ import annotations

import numpy as np

from share.config import MergeConfig
from share.geometry import se3
from share.types import F64, Keyframe


def believed(config: MergeConfig, T_ref_body: F64, cov: F64) -> F64:
    """The covariance (6, 6) of a step, as it is believed: agents are surer of themselves than they should be;
    none is surer than the floor, which grows with the step."""
    turn, way = float(se3.angle(T_ref_body)), float(np.linalg.norm(T_ref_body[:3, 3]))
    rad2 = np.radians(config.odometry_floor_deg) ** 2 + (config.odometry_floor_per_rad * turn) ** 2
    m2 = config.odometry_floor_m**2 + (config.odometry_floor_per_m * way) ** 2
    return config.odometry_scale**2 * cov + np.diag([rad2] * 3 + [m2] * 3)


def plumb_line(config: MergeConfig, keyframe: Keyframe) -> F64:
    """See `share.graph.plumb`: no camera sits on its IMU better than it was calibrated."""
    size = float(np.linalg.norm(keyframe.up))
    sigma = np.hypot(keyframe.up_sigma, np.radians(config.gravity_floor_deg))
    return keyframe.up / (size * sigma) if size else np.zeros(3)
