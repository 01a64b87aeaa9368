"""Events and effects of a client's state machine. What agents have too is in
`share.protocol.common_events`."""

from __future__ import annotations

from dataclasses import dataclass

from share.protocol.common_events import (
    Connected,
    EdgeMessageReceived,
    FailRun,
    PrintLine,
    SendToEdge,
    Tick,
)
from share.wire.room_messages import (
    Cancel,
    CommandState,
    Goto,
    PutObject,
    RemoveObject,
    RobotPlace,
    RoomObject,
)

# ---------------------------------------------------------------- events


@dataclass(frozen=True)
class MessageWanted:
    """A message for the edge. `PutObject` and `RemoveObject`: `RequestAnswered` follows. `Goto` and `Cancel`:
    `CommandChanged` follows, the last one final. Numbers of requests and of commands rise. What a bridge says
    of a command or of its robot's place is sent once."""

    message: PutObject | RemoveObject | Goto | Cancel | CommandState | RobotPlace


@dataclass(frozen=True)
class LinkTroubled:
    """Why the link does not reach the edge, as far as it knows; empty: no more."""

    text: str


@dataclass(frozen=True)
class ClientEnded:
    """The run is over."""


ClientEvent = Connected | EdgeMessageReceived | MessageWanted | LinkTroubled | ClientEnded | Tick

# ---------------------------------------------------------------- effects


@dataclass(frozen=True)
class RequestAnswered:
    """reason: why the request is refused, for a person; empty: it holds."""

    request: int
    reason: str


@dataclass(frozen=True)
class ObjectChanged:
    """An object came, moved, or is gone (`removed`)."""

    changed: RoomObject


@dataclass(frozen=True)
class CommandChanged:
    """Progress of a command, of this client or another."""

    state: CommandState


@dataclass(frozen=True)
class RobotSeen:
    place: RobotPlace


@dataclass(frozen=True)
class RobotCommanded:
    """To a bridge: somebody commands its robot, for the first time or again."""

    command: Goto | Cancel


ClientEffect = (
    SendToEdge
    | PrintLine
    | FailRun
    | RequestAnswered
    | ObjectChanged
    | CommandChanged
    | RobotSeen
    | RobotCommanded
)
