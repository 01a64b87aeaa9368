"""What the agent is told (events) and what it wants done (effects). All times are host monotonic ns
unless they are called `stamp_ns`: those are the frame's, in the sensor's clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from share.errors import ShareError
from share.types import F64, Frame, KeyframeCandidate, TrackState, WaitReason
from share.wire.codec import Bytes
from share.wire.messages import Status

# ---------------------------------------------------------------- events


@dataclass(frozen=True, eq=False)
class FrameTracked:
    """The tracker has a frame's pose. T_odom_body (4, 4) where the state has one.

    arrived_ns, done_ns: when the frame came in and its pose was known. keyframe: it is to become one, and
    `KeyframeMade` follows; new_stretch: odometry broke before it. error_cm: expected position error,
    where somebody estimates it. waits: for what the tracker waits before it tells a pose.
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

    @property
    def track_ms(self) -> float:
        return (self.done_ns - self.arrived_ns) / 1e6


@dataclass(frozen=True, eq=False)
class KeyframeMade:
    """What a tracked frame shows to others: made after its pose was out. candidate: None if that failed."""

    frame: FrameTracked
    candidate: KeyframeCandidate | None


@dataclass(frozen=True, eq=False)
class FrameArrived:
    """A frame for the edge to track, with the IMU samples since the one before; when it came in."""

    frame: Frame
    arrived_ns: int


@dataclass(frozen=True, eq=False)
class SendFailed:
    """The link could not take this message or frame: nothing of it is sent."""

    effect: SendToEdge | SendFrameToEdge


@dataclass(frozen=True, eq=False)
class EdgeMessageReceived:
    """A message from the edge, undecoded."""

    frames: Sequence[Bytes]


@dataclass(frozen=True)
class Connected:
    """The link has reached an edge, perhaps another life of it."""


@dataclass(frozen=True)
class AgentTick:
    """Time has passed; every 50 ms is often enough. image_ns: when the newest image came that is not tracked
    yet, None where none waits. trouble: what is wrong with the sensors, for a person; empty: nothing."""

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
class SendToEdge:
    """Hand these frames to the link; if it does not take them, `SendFailed` is the answer. keyframe: the id,
    if they are one."""

    frames: Sequence[Bytes]
    keyframe_id: int | None = None


@dataclass(frozen=True, eq=False)
class SendFrameToEdge:
    """The same for a frame to be tracked."""

    index: int
    frames: Sequence[Bytes]


@dataclass(frozen=True, eq=False)
class FrameTrackedRemotely:
    """The edge has tracked a frame; `FrameDone` follows. frame: as for one that is tracked here."""

    frame: FrameTracked
    is_consistent: bool
    waiting_for: WaitReason | None


@dataclass(frozen=True, eq=False)
class LocalisedPose:
    """Where the agent is. arrived_ns: when its frame came in. stretch: grows where odometry begins anew.
    T_map_odom: in force at this moment (blended), None before a correction."""

    index: int
    stamp_ns: int
    arrived_ns: int
    segment: int
    T_odom_body: F64
    T_map_odom: F64 | None
    map_id: str | None
    state: TrackState


@dataclass(frozen=True)
class CorrectionApplied:
    """A correction is in force, or being blended in, from now on.

    keyframe, frame, stamp_ns: the keyframe that it answers and its frame, None where it answers none that is
    remembered. corrected_ms: from that frame's arrival to now, for the first correction only, and
    not for keyframes that a restarted edge was given again.
    """

    keyframe_id: int | None
    frame_index: int | None
    stamp_ns: int | None
    corrected_ms: float | None
    map_id: str
    revision: int
    new_map: bool


@dataclass(frozen=True)
class FrameDone:
    """One per frame, once it is known whether it is sent; so a candidate's comes once its keyframe is made,
    or that has failed.

    keyframe: the tracker offered it as one. sent: it was given a keyframe id.
    """

    stamp_ns: int
    track_ms: float
    state: TrackState
    is_keyframe: bool
    is_sent: bool


@dataclass(frozen=True)
class StatusReport:
    """What the agent says of its own state now, twice a second and where it changes. stamp_ns: of the newest
    frame, None before the first. idle: no frame was tracked of late, so no FrameDone says so."""

    status: Status
    stamp_ns: int | None
    is_stale: bool


@dataclass(frozen=True)
class PrintLine:
    """One line for a person."""

    text: str


@dataclass(frozen=True)
class FailRun:
    """The run cannot go on; `error` says why."""

    error: ShareError


@dataclass(frozen=True)
class CloseLink:
    """Everything is done: close the link."""


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
