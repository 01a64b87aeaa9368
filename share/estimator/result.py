"""What a tracker says of a frame."""

from __future__ import annotations

from dataclasses import dataclass

from share.types import F64, TrackState, Wait


@dataclass(frozen=True, eq=False)
class TrackResult:
    """What one frame came to. T_odom_body is None where there is no pose to be had.

    keyframe: this frame became one; the tracker's `keyframe` gives what it shows. points: how many
    the pose rests on. new_stretch: odometry broke before this keyframe. cov (6, 6): of T_odom_body, perturbed
    on the right, where the tracker knows it. sound: False while images and IMU contradict each other. waits:
    for what, where there is no pose yet.
    """

    state: TrackState
    T_odom_body: F64 | None
    keyframe: bool = False
    points: int = 0
    new_stretch: bool = False
    cov: F64 | None = None
    sound: bool = True
    waits: Wait | None = None
