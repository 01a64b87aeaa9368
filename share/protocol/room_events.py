"""Events and effects of a client's state machine. It also has `Connected`, `EdgeMessageReceived`,
`SendToEdge`, `PrintLine` and `FailRun` of agents."""

from __future__ import annotations

from dataclasses import dataclass

from share.protocol.agent_events import Connected, EdgeMessageReceived, FailRun, PrintLine, SendToEdge
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
class RequestWanted:
    """Place or remove an object; `RequestAnswered` follows. Numbers of requests rise."""

    message: PutObject | RemoveObject


@dataclass(frozen=True)
class CommandWanted:
    """Send or stop a robot; `CommandChanged` follows, the last one final. Numbers of commands rise."""

    message: Goto | Cancel


@dataclass(frozen=True)
class BridgeSaid:
    """A bridge says what becomes of a command, or where its robot is."""

    message: CommandState | RobotPlace


@dataclass(frozen=True)
class ClientEnded:
    """The run is over."""


@dataclass(frozen=True)
class ClientTick:
    """Time has passed; every 50 ms suffices."""


ClientEvent = (
    Connected | EdgeMessageReceived | RequestWanted | CommandWanted | BridgeSaid | ClientEnded | ClientTick
)

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
    """What becomes of a command, of this client or another."""

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
