"""Events and effects of the agent's state machine. Times are host monotonic ns; `stamp_ns` is the frame's
stamp in the sensor's clock. What clients of a room have too is in `share.protocol.common_events`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from share.protocol.common_events import Connected, EdgeMessageReceived, FailRun, PrintLine, SendToEdge
from share.types import F64, Frame, OdometryKeyframe, TrackState, WaitReason
from share.wire.layouts import Bytes
from share.wire.messages import Status

# ---------------------------------------------------------------- events


@dataclass(frozen=True, eq=False)
class FrameTracked:
    """The tracker has processed a frame. T_odom_body (4, 4) where the state has a pose.

    arrived_ns, done_ns: when the frame arrived and when its pose was known. is_keyframe: it becomes a
    keyframe and `KeyframeMade` follows. new_segment: odometry broke before it. error_cm: expected position
    error; None without an error model. waiting_for: what the tracker needs before its first pose. cov,
    velocity, angular_velocity: as in `TrackResult`.
    """

    index: int
    stamp_ns: int
    arrived_ns: int
    done_ns: int
    state: TrackState
    T_odom_body: F64 | None = None
    is_keyframe: bool = False
    new_segment: bool = False
    error_cm: float | None = None
    waiting_for: WaitReason | None = None
    cov: F64 | None = None
    velocity: F64 | None = None
    angular_velocity: F64 | None = None

    @property
    def track_ms(self) -> float:
        return (self.done_ns - self.arrived_ns) / 1e6


@dataclass(frozen=True, eq=False)
class KeyframeMade:
    """The keyframe candidate of a tracked frame, made after its pose was published; None if that failed."""

    frame: FrameTracked
    candidate: OdometryKeyframe | None


@dataclass(frozen=True, eq=False)
class FrameArrived:
    """A frame for the edge to track, with the IMU samples since the one before."""

    frame: Frame
    arrived_ns: int


@dataclass(frozen=True, eq=False)
class SendFailed:
    """The link refused this message or frame: nothing of it was sent."""

    effect: SendToEdge | SendFrameToEdge


@dataclass(frozen=True)
class AgentTick:
    """Time has passed; every 50 ms suffices.

    waiting_image_ns: arrival of the newest image that is not tracked yet; None without one. sensor_trouble:
    a sensor fault, for a person; empty without one."""

    waiting_image_ns: int | None = None
    sensor_trouble: str = ""


@dataclass(frozen=True)
class InputFinished:
    """No frame will follow."""


AgentEvent = (
    Connected
    | FrameTracked
    | KeyframeMade
    | FrameArrived
    | SendFailed
    | EdgeMessageReceived
    | AgentTick
    | InputFinished
)

# ---------------------------------------------------------------- effects


@dataclass(frozen=True, eq=False)
class SendFrameToEdge:
    """Hand frame `index`, for the edge to track, to the link; answer `SendFailed` if it refuses."""

    index: int
    frames: Sequence[Bytes]


@dataclass(frozen=True, eq=False)
class FrameTrackedRemotely:
    """The edge has tracked a frame; `FrameDone` follows. is_consistent: as in `TrackResult`."""

    frame: FrameTracked
    is_consistent: bool


@dataclass(frozen=True, eq=False)
class LocalisedPose:
    """The agent's pose. arrived_ns: arrival of its frame. segment: number of the odometry segment, rising.
    T_map_odom (4, 4): in force now; None before the first correction.

    cov, velocity, angular_velocity: as in `TrackResult`. map_cov (6, 6): of T_map_odom T_odom_body, perturbed
    on the right; None before the first correction.
    """

    index: int
    stamp_ns: int
    arrived_ns: int
    segment: int
    T_odom_body: F64
    T_map_odom: F64 | None
    map_id: str | None
    state: TrackState
    cov: F64 | None = None
    velocity: F64 | None = None
    angular_velocity: F64 | None = None
    map_cov: F64 | None = None


@dataclass(frozen=True)
class CorrectionApplied:
    """A correction is the target from now on. jumps: it is in force at once, else it comes gradually.

    keyframe_id, frame_index, stamp_ns: the keyframe that it answers and its frame; None where it answers no
    remembered keyframe. corrected_ms: from that frame's arrival to now; None but for the first correction of
    a keyframe, and for keyframes resent to a restarted edge.
    """

    keyframe_id: int | None
    frame_index: int | None
    stamp_ns: int | None
    corrected_ms: float | None
    map_id: str
    revision: int
    jumps: bool


@dataclass(frozen=True)
class FrameDone:
    """One per frame, once it is known whether the frame is sent; for a candidate after `KeyframeMade`.

    is_keyframe: the tracker offered it as one. is_sent: it was given a keyframe id.
    """

    stamp_ns: int
    track_ms: float
    state: TrackState
    is_keyframe: bool
    is_sent: bool


@dataclass(frozen=True)
class StatusReport:
    """The agent's status, twice a second and on change. stamp_ns: of the newest frame; None before the first.
    is_stale: no frame was tracked recently, so no `FrameDone` carries the state."""

    status: Status
    stamp_ns: int | None
    is_stale: bool


@dataclass(frozen=True)
class CloseLink:
    """The run is over: close the link."""


AgentEffect = (
    SendToEdge
    | SendFrameToEdge
    | FrameTrackedRemotely
    | LocalisedPose
    | CorrectionApplied
    | FrameDone
    | StatusReport
    | PrintLine
    | FailRun
    | CloseLink
)
