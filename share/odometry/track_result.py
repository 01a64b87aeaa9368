"""The result of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.types import F64, TrackState, WaitReason


@dataclass(frozen=True, eq=False)
class TrackResult:
    """The result of one frame. T_odom_body is None where there is no pose.

    keyframe_ready: a keyframe is ready, of this frame or of one before; `make_keyframe` returns it.
    inlier_count: features that the pose is based on. new_segment: odometry began anew before this frame. cov
    (6, 6): of T_odom_body since odom began, with the tilt that odom then had, perturbed on the right.
    is_consistent: False while images and IMU contradict each other. waiting_for: what the first pose waits
    for. found_count: features found, outliers included. median_nis: over the features; 0 without any.
    velocity (3,): of the body in odom, m/s. angular_velocity (3,): in the body, rad/s. The covariance and the
    velocities are None where the tracker does not know them.
    """

    state: TrackState
    T_odom_body: F64 | None
    keyframe_ready: bool = False
    inlier_count: int = 0
    new_segment: bool = False
    cov: F64 | None = None
    is_consistent: bool = True
    waiting_for: WaitReason | None = None
    found_count: int = 0
    median_nis: float = 0.0
    velocity: F64 | None = None
    angular_velocity: F64 | None = None


def finite_median(nis: F64) -> float:
    """Return the median of the finite values (N,); 0 without any."""
    finite = nis[np.isfinite(nis)]
    return median(finite) if len(finite) else 0.0


def median(values: F64) -> float:
    """Return the median of (N,), N >= 1, as `np.median`, but five times as fast for a few dozen values;
    NaN if one is."""
    half, odd = divmod(len(values), 2)
    part = np.partition(values, (half if odd else half - 1, half, -1))
    if np.isnan(part[-1]):
        return float("nan")
    return float(part[half] if odd else (part[half - 1] + part[half]) / 2)
