"""The messages between agent and edge, as frozen dataclasses. `share.wire.codec` encodes them.

Stamps are nanoseconds of the sender's clock. The transport knows a peer by its run id, so messages do not
carry their sender.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from share.agent_names import checked_name
from share.checks import checked_id, checked_pose, checked_stamp
from share.geometry.camera import Camera, Rig
from share.types import F64, AgentKind, Correction, Frame, Keyframe, TrackState, WaitReason
from share.wire.room_messages import ClientDownlink, ClientUplink

MAX_RATE_HZ = 1000.0
MIN_POSE_HZ = 1.0
MAX_HOLD_MS = 10_000.0  # no edge silences an agent
MAX_BUFFERED = 256  # ids in one Ack: keyframes buffered at the edge
MAX_TEXT_LENGTH = 512  # characters of a text for a person
MAX_REASON_LENGTH = 120  # characters of `Status.reason`
MAX_POSE_AGE_MS = 1e9  # 11 days
MAX_SIGMA = 1e6  # m or rad: as good as unknown
MAX_IMAGE_SIDE = 8192  # px, of an image
MAX_IMU_SAMPLES = 20_000  # in one frame
MAX_DELAY_MS = 1e7  # three hours
MAX_ERROR_CM = 1e7  # 100 km, the limit of a pose
PEER_ID_BYTES = 8


def peer_id(run_id: int) -> bytes:
    """Return the PEER_ID_BYTES by which the edge's transport knows the agent of this run.

    They are the run's secret: a peer that knows them can send as this run."""
    return run_id.to_bytes(PEER_ID_BYTES, "big", signed=True)


def public_tag(run_id: int) -> str:
    """Return 16 hexadecimal digits that name a run publicly without revealing its `run_id`."""
    return peer_tag(peer_id(run_id))


def peer_tag(peer: bytes) -> str:
    """Return the `public_tag` of the run with this transport id."""
    return hashlib.sha256(peer).hexdigest()[:16]


def _check_image_size(camera: Camera) -> None:
    if max(camera.width, camera.height) > MAX_IMAGE_SIDE:
        raise ValueError(f"image: {camera.width}x{camera.height} px exceeds {MAX_IMAGE_SIDE} px a side")


def _check_age(name: str, ms: float) -> None:
    if not 0 <= ms <= MAX_POSE_AGE_MS:
        raise ValueError(f"{name}: {ms} is outside 0 .. {MAX_POSE_AGE_MS:g}")


def _check_sigma(name: str, sigma: float | None) -> None:
    if sigma is not None and not 0 <= sigma <= MAX_SIGMA:
        raise ValueError(f"{name}: {sigma} is outside 0 .. {MAX_SIGMA:g}")


# ---------------------------------------------------------------- up: agent -> edge


@dataclass(frozen=True, eq=False)
class Hello:
    """First message of a run, repeated until welcomed.

    run_id: 64 random bits, the run's secret and its `peer_id`; only the edge learns them. rig: the agent's
    calibration. streams_frames: it sends frames and the edge tracks them."""

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
    """Sent for every frame: the body's pose (4, 4) relative to the sent keyframe `keyframe`, or in odom if
    -1. age_ms: from the frame's arrival to this message. sigma_m, sigma_rad: of the pose in the map, of
    three axes together; None: not in a map, or not known."""

    stamp_ns: int
    state: TrackState
    keyframe: int
    T_keyframe_body: F64
    age_ms: float = 0.0
    sigma_m: float | None = None
    sigma_rad: float | None = None

    def __post_init__(self) -> None:
        checked_stamp("stamp_ns", self.stamp_ns)
        _check_age("age_ms", self.age_ms)
        for name in ("sigma_m", "sigma_rad"):
            _check_sigma(name, getattr(self, name))
        checked_id("keyframe", self.keyframe, minimum=-1)
        object.__setattr__(self, "T_keyframe_body", checked_pose("T_keyframe_body", self.T_keyframe_body))


@dataclass(frozen=True)
class Evaluation:
    """Sent with each keyframe, and once a second between them: how the agent is served.

    keyframe: which it goes with, -1 between them. delay_ms: from a frame to the correction that answers it,
    filtered. error_cm: expected error; None: unknown. track_ms: from a frame's arrival until its keyframe is
    made, filtered. rtt_ms: round trip of a small message, filtered. ack_ms: from sending a keyframe until it
    was acknowledged, the newest, or how long the oldest has been waiting, if longer. drift_cm: part of the
    error that grows between keyframes; 0: unknown."""

    keyframe: int
    delay_ms: float
    error_cm: float | None
    track_ms: float = 0.0
    rtt_ms: float = 0.0
    ack_ms: float = 0.0
    drift_cm: float = 0.0

    def __post_init__(self) -> None:
        checked_id("keyframe", self.keyframe, minimum=-1)
        for name in ("delay_ms", "track_ms", "rtt_ms", "ack_ms"):
            if not 0 <= (value := getattr(self, name)) <= MAX_DELAY_MS:
                raise ValueError(f"{name}: {value} is outside 0 .. {MAX_DELAY_MS:g}")
        if self.error_cm is not None and not 0 <= self.error_cm <= MAX_ERROR_CM:
            raise ValueError(f"error_cm: {self.error_cm} is outside 0 .. {MAX_ERROR_CM:g}")
        if not 0 <= self.drift_cm <= MAX_ERROR_CM:
            raise ValueError(f"drift_cm: {self.drift_cm} is outside 0 .. {MAX_ERROR_CM:g}")


@dataclass(frozen=True)
class Status:
    """Sent twice a second and on change, also without frames. pose_age_ms: since the newest frame with a pose
    arrived, or since the run began. reason: cause of the state, for a person; empty if all is well.
    unacknowledged_ms: age of the oldest keyframe that the edge has not acknowledged; 0 without one.
    clock_error_ms: bound of the error of its estimate of the edge's clock; None: no estimate."""

    state: TrackState
    pose_age_ms: float
    reason: str = ""
    unacknowledged_ms: float = 0.0
    clock_error_ms: float | None = None

    def __post_init__(self) -> None:
        for name in ("pose_age_ms", "unacknowledged_ms"):
            _check_age(name, getattr(self, name))
        if self.clock_error_ms is not None:
            _check_age("clock_error_ms", self.clock_error_ms)
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
    """The edge accepts the run. session: this start of the edge; the agent continues at keyframe
    `next_keyframe`, after hold_ms (`share.scheduling.room_controller`)."""

    session: int
    next_keyframe: int
    hold_ms: float = 0.0

    def __post_init__(self) -> None:
        checked_id("next_keyframe", self.next_keyframe)
        if not 0 <= self.hold_ms <= MAX_HOLD_MS:
            raise ValueError(f"hold_ms: {self.hold_ms} is outside 0 .. {MAX_HOLD_MS:g}")


@dataclass(frozen=True)
class Refused:
    """The edge does not accept this agent. reason: for a person."""

    reason: str

    def __post_init__(self) -> None:
        if len(self.reason) > MAX_TEXT_LENGTH:
            raise ValueError(f"reason: {len(self.reason)} characters, at most {MAX_TEXT_LENGTH}")


@dataclass(frozen=True)
class Ack:
    """All keyframes below `next_keyframe` are done: applied and stored, or dropped by the agent.

    buffered: ids that have arrived and wait for a gap to close or for the disk.
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
    """Keyframes a second that the agent may send. is_windowed: and only while those that are not
    acknowledged are few (`share.protocol.keyframe_pace`). pose_hz: poses a second; None: every one.
    jpeg_quality: of the keyframes' pictures; None: as good as they are made."""

    hz: float
    is_windowed: bool = False
    pose_hz: float | None = None
    jpeg_quality: int | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.hz <= MAX_RATE_HZ:
            raise ValueError(f"rate: {self.hz} Hz is outside 0 .. {MAX_RATE_HZ:g}")
        if self.pose_hz is not None and not MIN_POSE_HZ <= self.pose_hz <= MAX_RATE_HZ:
            raise ValueError(f"pose_hz: {self.pose_hz} is outside {MIN_POSE_HZ:g} .. {MAX_RATE_HZ:g}")
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality: {self.jpeg_quality} is outside 1 .. 100")


NO_SESSION = 0  # of no edge


@dataclass(frozen=True)
class Pong:
    """Answer to a ping, with the four stamps of RFC 5905, section 8: `sent_ns` by the agent's clock, the
    others by the edge's.

    Every ping is answered, also of an unjoined peer: by `session`, NO_SESSION, it sees that it has to send a
    hello again.
    """

    sequence: int
    sent_ns: int
    received_ns: int
    replied_ns: int
    session: int

    @classmethod
    def answering(cls, ping: Ping, now_ns: int, session: int) -> Pong:
        """now_ns: the edge's clock."""
        return cls(ping.sequence, ping.sent_ns, now_ns, now_ns, session)

    def __post_init__(self) -> None:
        for name in ("sent_ns", "received_ns", "replied_ns"):
            checked_stamp(name, getattr(self, name))


@dataclass(frozen=True, eq=False)
class RemoteTrackingResult:
    """Tracking result of a streamed frame: fields as in `share.odometry.track_result.TrackResult`.
    T_odom_body (4, 4) if and only if the state has a pose. is_keyframe: the tracker would make it a
    keyframe."""

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
            raise ValueError(f"T_odom_body: required with a pose, not allowed without; state is {self.state}")
        if self.T_odom_body is not None:
            object.__setattr__(self, "T_odom_body", checked_pose("T_odom_body", self.T_odom_body))


UplinkMessage = Hello | PoseUpdate | Keyframe | Evaluation | Status | Ping | Bye | Frame
DownlinkMessage = Welcome | Refused | Ack | Correction | Rate | Pong | RemoteTrackingResult
# Goto, Cancel, CommandState and RobotPlace go both ways: the edge passes them on
Message = UplinkMessage | DownlinkMessage | ClientUplink | ClientDownlink
