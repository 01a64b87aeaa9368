"""The messages between agent and edge, as frozen dataclasses. `share.wire.codec` gives them bytes.

Stamps are nanoseconds of the sender's own clock. A peer is known to the transport by its run id,
so no message repeats who sent it.
"""

from __future__ import annotations

from dataclasses import dataclass

from share.types import F64, AgentKind, Correction, Keyframe, TrackState, checked_pose

# ---------------------------------------------------------------- up: agent -> edge


@dataclass(frozen=True, eq=False)
class Hello:
    """First message of a run, repeated until welcomed. T_body_cam0 (4, 4), focal of cam0 in px."""

    name: str
    kind: AgentKind
    run_id: int
    focal: float
    T_body_cam0: F64

    def __post_init__(self) -> None:
        if not (0 < len(self.name) <= 64 and self.name.isprintable() and "/" not in self.name):
            raise ValueError("name: 1 to 64 printable characters without '/'")
        if not 1.0 <= self.focal <= 1e5:
            raise ValueError(f"focal: {self.focal} px is outside 1 .. 1e5")
        object.__setattr__(self, "T_body_cam0", checked_pose("T_body_cam0", self.T_body_cam0))


@dataclass(frozen=True, eq=False)
class PoseUpdate:
    """Every frame: body in the body frame of sent keyframe `keyframe`, or in odom where it is -1."""

    stamp_ns: int
    state: TrackState
    keyframe: int
    T_keyframe_body: F64

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_keyframe_body", checked_pose("T_keyframe_body", self.T_keyframe_body))


@dataclass(frozen=True)
class Evaluation:
    """Per keyframe: the delay the agent sees (RTT + processing, ms) and its estimated error (cm)."""

    keyframe: int
    delay_ms: float
    error_cm: float | None


@dataclass(frozen=True)
class Ping:
    sequence: int
    sent_ns: int


@dataclass(frozen=True)
class Bye:
    """The agent ends its run in good order."""


# ---------------------------------------------------------------- down: edge -> agent


@dataclass(frozen=True)
class Welcome:
    """`session` names this life of the edge; the agent goes on at keyframe `next_keyframe`."""

    session: int
    next_keyframe: int


@dataclass(frozen=True)
class Refused:
    """The edge will not have this agent; `reason` is for a person."""

    reason: str


@dataclass(frozen=True)
class Ack:
    """Every keyframe below `next_keyframe` is applied; those in `held` wait for a gap to close."""

    next_keyframe: int
    held: tuple[int, ...] = ()


@dataclass(frozen=True)
class Rate:
    """Keyframes per second that the agent may send."""

    hz: float


@dataclass(frozen=True)
class Pong:
    """The four-stamp exchange of RFC 5905, section 8: sent by the agent, received and replied here."""

    sequence: int
    sent_ns: int
    received_ns: int
    replied_ns: int


Up = Hello | PoseUpdate | Keyframe | Evaluation | Ping | Bye
Down = Welcome | Refused | Ack | Correction | Rate | Pong
Message = Up | Down
