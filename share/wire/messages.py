"""The messages between agent and edge, as frozen dataclasses. `share.wire.codec` gives them bytes.

Stamps are nanoseconds of the sender's own clock. A peer is known to the transport by its run id,
so no message repeats who sent it.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from share.agent_names import checked_name
from share.geometry.camera import Camera, Rig
from share.types import (
    F64,
    AgentKind,
    Correction,
    Frame,
    Keyframe,
    TrackState,
    WaitReason,
    checked_id,
    checked_pose,
    checked_stamp,
)

MAX_RATE_HZ = 1000.0
MAX_BUFFERED = 256  # ids in one Ack: the most keyframes that may wait at the edge for a gap to close
MAX_TEXT_LENGTH = 512  # characters of anything a person reads
MAX_REASON_LENGTH = 120  # characters of why an agent is in its state
MAX_POSE_AGE_MS = 1e9  # 11 days
MAX_IMAGE_SIDE = 8192  # px, of an image
MAX_IMU_SAMPLES = 20_000  # of an IMU, in one frame
MAX_DELAY_MS = 1e7  # three hours
MAX_ERROR_CM = 1e7  # 100 km, as far as a pose may be
PEER_ID_BYTES = 8


def peer_id(run_id: int) -> bytes:
    """The PEER_BYTES by which the transport of the edge knows the agent of this run.

    Whoever knows them can speak for the run, so they are random and shown to nobody but the edge."""
    return run_id.to_bytes(PEER_ID_BYTES, "big", signed=True)


def public_tag(run_id: int) -> str:
    """16 hexadecimal digits that name a run to everybody and do not tell its `run_id`."""
    return hashlib.sha256(peer_id(run_id)).hexdigest()[:16]


def _check_image_size(camera: Camera) -> None:
    if max(camera.width, camera.height) > MAX_IMAGE_SIDE:
        raise ValueError(f"image: {camera.width}x{camera.height} px is more than {MAX_IMAGE_SIDE} a side")


# ---------------------------------------------------------------- up: agent -> edge


@dataclass(frozen=True, eq=False)
class Hello:
    """First message of a run, repeated until welcomed.

    run_id: 64 random bits, the run's secret: they are its `peer_id` too, and only the edge learns them.
    rig: the agent's calibration, by which the edge knows what it sees. streams_frames: it does not track itself but
    sends what its sensors see."""

    name: str
    kind: AgentKind
    run_id: int
    rig: Rig
    streams_frames: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", checked_name(self.name))
        for camera in (self.rig.cam0, self.rig.cam1, self.rig.depth):
            if camera is not None:
                _check_image_size(camera)


@dataclass(frozen=True, eq=False)
class PoseUpdate:
    """Every frame: body in the body frame of sent keyframe `keyframe`, or in odom where it is -1."""

    stamp_ns: int
    state: TrackState
    keyframe: int
    T_keyframe_body: F64

    def __post_init__(self) -> None:
        checked_stamp("stamp_ns", self.stamp_ns)
        checked_id("keyframe", self.keyframe, minimum=-1)
        object.__setattr__(self, "T_keyframe_body", checked_pose("T_keyframe_body", self.T_keyframe_body))


@dataclass(frozen=True)
class Evaluation:
    """Per keyframe: the delay the agent sees (RTT + processing, ms) and its estimated error (cm)."""

    keyframe: int
    delay_ms: float
    error_cm: float | None

    def __post_init__(self) -> None:
        checked_id("keyframe", self.keyframe)
        if not 0 <= self.delay_ms <= MAX_DELAY_MS:
            raise ValueError(f"delay_ms: {self.delay_ms} is outside 0 .. {MAX_DELAY_MS:g}")
        if self.error_cm is not None and not 0 <= self.error_cm <= MAX_ERROR_CM:
            raise ValueError(f"error_cm: {self.error_cm} is outside 0 .. {MAX_ERROR_CM:g}")


@dataclass(frozen=True)
class Status:
    """Twice a second, and at once where it changes, also while no frame comes. pose_age_ms: since the newest
    frame with a pose arrived, or the run began. reason: why it is so, for a person; empty: all is well."""

    state: TrackState
    pose_age_ms: float
    reason: str = ""

    def __post_init__(self) -> None:
        if not 0 <= self.pose_age_ms <= MAX_POSE_AGE_MS:
            raise ValueError(f"pose_age_ms: {self.pose_age_ms} is outside 0 .. {MAX_POSE_AGE_MS:g}")
        if len(self.reason) > MAX_REASON_LENGTH or not self.reason.isprintable():
            raise ValueError(f"reason: at most {MAX_REASON_LENGTH} printable characters")


@dataclass(frozen=True)
class Ping:
    sequence: int
    sent_ns: int

    def __post_init__(self) -> None:
        checked_stamp("sent_ns", self.sent_ns)


@dataclass(frozen=True)
class Bye:
    """The agent ends its run in good order."""


# ---------------------------------------------------------------- down: edge -> agent


@dataclass(frozen=True)
class Welcome:
    """`session` names this life of the edge; the agent goes on at keyframe `next_keyframe`."""

    session: int
    next_keyframe: int

    def __post_init__(self) -> None:
        checked_id("next_keyframe", self.next_keyframe)


@dataclass(frozen=True)
class Refused:
    """The edge will not have this agent; `reason` is for a person."""

    reason: str

    def __post_init__(self) -> None:
        if len(self.reason) > MAX_TEXT_LENGTH:
            raise ValueError(f"reason: {len(self.reason)} characters, at most {MAX_TEXT_LENGTH}")


@dataclass(frozen=True)
class Ack:
    """Nothing below `next_keyframe` is wanted any more: it was applied, or dropped by the agent.

    Those in `buffered` have arrived and wait for a gap to close.
    """

    next_keyframe: int
    buffered: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for id_ in (self.next_keyframe, *self.buffered):
            checked_id("keyframe ids", id_)
        if len(self.buffered) > MAX_BUFFERED:
            raise ValueError(f"buffered: {len(self.buffered)} ids, at most {MAX_BUFFERED}")


@dataclass(frozen=True)
class Rate:
    """Keyframes per second that the agent may send."""

    hz: float

    def __post_init__(self) -> None:
        if not 0 <= self.hz <= MAX_RATE_HZ:
            raise ValueError(f"rate: {self.hz} Hz is outside 0 .. {MAX_RATE_HZ:g}")


@dataclass(frozen=True)
class Pong:
    """The four-stamp exchange of RFC 5905, section 8: sent by the agent, received and replied here.

    Every ping is answered, a stranger's too: `session` tells it that it must say hello again.
    """

    sequence: int
    sent_ns: int
    received_ns: int
    replied_ns: int
    session: int

    def __post_init__(self) -> None:
        for name in ("sent_ns", "received_ns", "replied_ns"):
            checked_stamp(name, getattr(self, name))


@dataclass(frozen=True, eq=False)
class RemoteTrackingResult:
    """What a streamed frame came to: its index and stamp, and of the tracker's result what an agent uses
    (`share.odometry.track_result`). T_odom_body (4, 4) where the state has a pose."""

    index: int
    stamp_ns: int
    state: TrackState
    T_odom_body: F64 | None
    is_keyframe: bool = False
    new_segment: bool = False
    is_consistent: bool = True
    waiting_for: WaitReason | None = None

    def __post_init__(self) -> None:
        checked_id("index", self.index)
        checked_stamp("stamp_ns", self.stamp_ns)
        if (self.T_odom_body is not None) != self.state.has_pose:
            raise ValueError(f"T_odom_body: goes with a state that has a pose, not with {self.state}")
        if self.T_odom_body is not None:
            object.__setattr__(self, "T_odom_body", checked_pose("T_odom_body", self.T_odom_body))


UplinkMessage = Hello | PoseUpdate | Keyframe | Evaluation | Status | Ping | Bye | Frame
DownlinkMessage = Welcome | Refused | Ack | Correction | Rate | Pong | RemoteTrackingResult
Message = UplinkMessage | DownlinkMessage
