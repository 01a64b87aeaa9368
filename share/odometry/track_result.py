"""What a tracker says of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.types import F64, TrackState, WaitReason


@dataclass(frozen=True, eq=False)
class TrackResult:
    """What one frame came to. T_odom_body is None where there is no pose to be had.

    keyframe: this frame became one, or one before it whose view is made by now: the tracker's
    `keyframe_ready` gives what that shows. points: how many the pose
    rests on. new_stretch: odometry broke before this keyframe. cov (6, 6): of T_odom_body, perturbed on the
    right, where the tracker knows it. sound: False while images and IMU contradict each other. waits: for
    what, where there is no pose yet. found: how many features were, also those that were not believed.
    surprise: median squared distance of the features from where they were expected, in sigmas, 0 without any.
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


def finite_median(nis: F64) -> float:
    """The median of squared distances (N,), NaN unknown, in sigmas; 0 without any."""
    finite = nis[np.isfinite(nis)]
    return median(finite) if len(finite) else 0.0


# ---- The median, as numpy has it, for the few dozen numbers that a frame asks of: a fifth of its time.


def median(values: F64) -> float:
    """Of (N,), at least one; NaN if one of them is."""
    half, odd = divmod(len(values), 2)
    part = np.partition(values, (half if odd else half - 1, half, -1))
    if np.isnan(part[-1]):
        return float("nan")
    return float(part[half] if odd else (part[half - 1] + part[half]) / 2)
