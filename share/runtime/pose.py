"""The pose of an agent for programs that use it: of a frame tracked here, or received from an agent."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from share.geometry import se3
from share.odometry.track_result import TrackResult
from share.protocol.agent_events import LocalisedPose
from share.types import F64, TrackState


@dataclass(frozen=True, eq=False)
class Pose:
    """The pose of an agent's body at a frame. The body is the IMU's frame, cam0's without an IMU.

    stamp_ns: of the frame, in the clock of its images. T_odom_body (4, 4): takes coordinates in the body to
    odom: metres, z up; continuous within a segment. T_map_body (4, 4): the same in the shared map `map_id`;
    None where that is not known. segment: number of the odometry segment, rising; poses of two segments are
    in different odom frames.

    velocity (3,): of the body in odom, m/s. angular_velocity (3,): about the body's axes, rad/s. cov, map_cov
    (6, 6): of T_odom_body and T_map_body, rotation before translation, perturbed on the right, so about the
    body's axes. All four are None where the tracker does not know them. age_ms: from the frame's arrival
    until the pose was known; None where that is not measured.
    is_connected: whether the agent hears its edge; None without one.
    """

    stamp_ns: int
    state: TrackState
    T_odom_body: F64
    T_map_body: F64 | None = None
    map_id: str | None = None
    segment: int = 0
    velocity: F64 | None = None
    angular_velocity: F64 | None = None
    cov: F64 | None = None
    map_cov: F64 | None = None
    age_ms: float | None = None
    is_connected: bool | None = None

    @property
    def position(self) -> F64:
        """Position (3,) of the body in odom, m."""
        return self.T_odom_body[:3, 3]

    @property
    def quaternion(self) -> F64:
        """Rotation (4,) of the body in odom: unit quaternion x y z w (Hamilton)."""
        return se3.quat_from_matrix(self.T_odom_body[:3, :3])


class PoseSink(Protocol):
    """A receiver of an agent's poses. Called in the agent's main thread: neither call may wait."""

    def publish(self, pose: Pose) -> None: ...

    def publish_state(self, stamp_ns: int, state: TrackState, age_ms: float | None = None) -> None:
        """Take a frame without a pose; age_ms: of the last pose, where there is no newer frame."""

    def close(self) -> None: ...


def tracked_pose(stamp_ns: int, segment: int, result: TrackResult) -> Pose | None:
    """Return the pose of a frame that was tracked without an edge; None if it has none."""
    if result.T_odom_body is None or not result.state.has_pose:
        return None
    return Pose(
        stamp_ns,
        result.state,
        result.T_odom_body,
        segment=segment,
        velocity=result.velocity,
        angular_velocity=result.angular_velocity,
        cov=result.cov,
    )


def localised_pose(localised: LocalisedPose, age_ms: float, is_connected: bool) -> Pose:
    """Return an agent's pose, in the map too where it is known there.

    is_connected: whether it hears its edge.
    """
    T_map_odom, map_id = localised.T_map_odom, localised.map_id
    pose = Pose(
        localised.stamp_ns,
        localised.state,
        localised.T_odom_body,
        segment=localised.segment,
        velocity=localised.velocity,
        angular_velocity=localised.angular_velocity,
        cov=localised.cov,
        age_ms=age_ms,
        is_connected=is_connected,
    )
    if T_map_odom is None or map_id is None:
        return pose
    T_map_body = T_map_odom @ localised.T_odom_body
    return replace(pose, T_map_body=T_map_body, map_id=map_id, map_cov=localised.map_cov)
