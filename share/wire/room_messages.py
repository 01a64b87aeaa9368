"""Messages of clients: peers of the edge without a camera. They place objects in the shared room, command
robots, and drive them (docs/lookup/wire.md#clients).

Poses are in the map that `map_id` names: metres, z up. Ids and numbers are the sender's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from numbers import Integral, Real

from share.agent_names import checked_name
from share.checks import checked_id, checked_map_id, checked_pose
from share.types import F64

MAX_PLACE_M = 1000.0  # of an object or a robot's goal from the map's origin, along each axis
MAX_ANSWER_LENGTH = 200  # characters of a text for a person
MAX_LISTED = 128  # objects in one list, removed ones included
_MAX_NUMBER = 2**62  # of commands and requests


class ObjectKind(StrEnum):
    """How an object is drawn."""

    CUBE = "cube"
    MARKER = "marker"


class Permission(StrEnum):
    """Rights of a client beyond seeing the room: send robots; place, move and remove objects."""

    COMMANDS = "commands"
    OBJECTS = "objects"


def no_object_text(object_id: int) -> str:
    """Return the reason of a `Receipt` for an object that is not there."""
    return f"there is no object {object_id}"


def _check_number(name: str, value: int) -> None:
    _check_whole(name, value)
    if not 0 <= value <= _MAX_NUMBER:
        raise ValueError(f"{name}: {value} is outside 0 .. {_MAX_NUMBER}")


def _check_whole(name: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise ValueError(f"{name}: has to be a whole number (int), not {type(value).__name__}")


def _check_object(object_id: int) -> None:
    _check_whole("object_id", object_id)
    checked_id("object_id", object_id)


def _number(name: str, value: object) -> float:
    """Raises ValueError for what is no real number, such as text or True."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ValueError(f"{name}: has to be a number, not {type(value).__name__}")
    return float(value)


def _check_map(map_id: str | None) -> None:
    if map_id is not None:
        checked_map_id(map_id)


def _check_text(name: str, text: str) -> None:
    if len(text) > MAX_ANSWER_LENGTH or not text.isprintable():
        raise ValueError(f"{name}: at most {MAX_ANSWER_LENGTH} printable characters")


def _check_place(x: float, y: float, yaw: float | None) -> None:
    """Raises ValueError for a place on the floor that no room has."""
    if not (abs(x) <= MAX_PLACE_M and abs(y) <= MAX_PLACE_M):
        raise ValueError(f"x, y: are more than {MAX_PLACE_M:g} m away, or not finite")
    if yaw is not None and not abs(yaw) <= 2 * math.pi:
        raise ValueError("yaw: is beyond a turn, or not finite")


# ---------------------------------------------------------------- up: client -> edge


@dataclass(frozen=True)
class ClientHello:
    """First message of a client, repeated until welcomed. run_id: as in `Hello`.

    drives_robot: it is the bridge of the robot of this name. wants_objects, wants_robots: it is sent
    objects; robots and what becomes of all commands.
    """

    name: str
    run_id: int
    drives_robot: bool = False
    wants_objects: bool = False
    wants_robots: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", checked_name(self.name))


@dataclass(frozen=True, eq=False)
class PutObject:
    """Place an object, or move it; repeated until a `Receipt`. Requests of a run rise: of two about one
    object the higher counts. map_id: None: the map of the sender's agent, or the only one of the room.
    T_map_object (4, 4)."""

    request: int
    object_id: int
    kind: ObjectKind
    map_id: str | None
    T_map_object: F64

    def __post_init__(self) -> None:
        _check_number("request", self.request)
        _check_object(self.object_id)
        _check_map(self.map_id)
        T = checked_pose("T_map_object", self.T_map_object, MAX_PLACE_M)
        object.__setattr__(self, "T_map_object", T)


@dataclass(frozen=True)
class RemoveObject:
    """Remove an object; as `PutObject`."""

    request: int
    object_id: int

    def __post_init__(self) -> None:
        _check_number("request", self.request)
        _check_object(self.object_id)


@dataclass(frozen=True)
class ObjectsSeen:
    """The client has all changes of objects up to this revision."""

    session: int
    revision: int

    def __post_init__(self) -> None:
        _check_number("revision", self.revision)


# ---------------------------------------------------------------- both ways


@dataclass(frozen=True)
class Goto:
    """Send a robot to x, y (m, in the map); passed on to its bridge.

    The commander repeats it every half second until it is final: where it ends, the robot stops. Commands of
    a run rise. robot: None: the only one. commander: its name, which the edge fills in. map_id: None: the
    robot's present one. yaw: rad; None: as it arrives. has_begun: a state of it has come, so a bridge that
    does not know it does not begin it.
    """

    command: int
    robot: str | None
    commander: str
    map_id: str | None
    x: float
    y: float
    yaw: float | None = None
    has_begun: bool = False

    def __post_init__(self) -> None:
        _check_number("command", self.command)
        _check_parties(self.robot, self.commander)
        _check_map(self.map_id)
        for name in ("x", "y") if self.yaw is None else ("x", "y", "yaw"):
            object.__setattr__(self, name, _number(name, getattr(self, name)))
        _check_place(self.x, self.y, self.yaw)


@dataclass(frozen=True)
class Cancel:
    """Stop a robot, whoever sent it; passed on to its bridge, and repeated until it is final. Fields as of
    `Goto`."""

    command: int
    robot: str | None
    commander: str = ""

    def __post_init__(self) -> None:
        _check_number("command", self.command)
        _check_parties(self.robot, self.commander)


@dataclass(frozen=True)
class CommandState:
    """Progress of a command, from the robot's bridge, or from an edge that does not forward it.

    robot: filled in by the edge. is_final: nothing follows. is_reached: it was done.
    """

    command: int
    robot: str | None
    commander: str
    text: str
    is_final: bool = False
    is_reached: bool = False

    def __post_init__(self) -> None:
        _check_number("command", self.command)
        _check_parties(self.robot, self.commander)
        _check_text("text", self.text)


@dataclass(frozen=True)
class RobotPlace:
    """Where a robot is, twice a second, five times with a goal: x, y (m), yaw (rad); map_id None: not known.
    robot: filled in by the edge. text: what it does, or why it takes no goals."""

    robot: str | None
    map_id: str | None
    x: float
    y: float
    yaw: float
    text: str

    def __post_init__(self) -> None:
        _check_parties(self.robot, "")
        _check_map(self.map_id)
        _check_place(self.x, self.y, self.yaw)
        _check_text("text", self.text)


def _check_parties(robot: str | None, commander: str) -> None:
    for name in filter(None, (robot, commander)):
        if checked_name(name) != name:
            raise ValueError("name: is not composed")
    if robot == "":
        raise ValueError("robot: is empty")


# ---------------------------------------------------------------- down: edge -> client


@dataclass(frozen=True)
class Receipt:
    """The answer to a request about an object. reason: why it is refused, for a person; empty: it holds, and
    survives an edge that keeps its map."""

    request: int
    reason: str = ""

    def __post_init__(self) -> None:
        _check_number("request", self.request)
        _check_text("reason", self.reason)


@dataclass(frozen=True, eq=False)
class RoomObject:
    """An object of the room as it is since `revision`. owner: who placed it first.

    removed: why it is gone, for a person; empty while it is there. T_map_object (4, 4)."""

    session: int
    revision: int
    object_id: int
    kind: ObjectKind
    owner: str
    map_id: str
    T_map_object: F64
    removed: str = ""

    def __post_init__(self) -> None:
        _check_number("revision", self.revision)
        checked_id("object_id", self.object_id)
        object.__setattr__(self, "owner", checked_name(self.owner))
        checked_map_id(self.map_id)
        _check_text("removed", self.removed)
        # after a join it may be further off than where one may be placed
        object.__setattr__(self, "T_map_object", checked_pose("T_map_object", self.T_map_object))


@dataclass(frozen=True)
class ObjectList:
    """All objects at `revision`, each with the revision of its newest change, ones lately removed included.
    What a client holds beyond them is gone."""

    session: int
    revision: int
    ids: tuple[int, ...] = ()
    revisions: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        _check_number("revision", self.revision)
        if len(self.ids) != len(self.revisions) or len(self.ids) > MAX_LISTED:
            raise ValueError(f"ids: at most {MAX_LISTED}, with a revision each")
        for object_id in self.ids:
            checked_id("ids", object_id)
        for revision in self.revisions:
            _check_number("revisions", revision)


ClientUplink = (
    ClientHello | PutObject | RemoveObject | ObjectsSeen | Goto | Cancel | CommandState | RobotPlace
)
ClientDownlink = Receipt | RoomObject | ObjectList
