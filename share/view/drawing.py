"""Objects that a viewer draws. An object replaces an earlier one of the same name."""

from __future__ import annotations

from dataclasses import dataclass

from share.colours import Colour
from share.types import F32, F64, AgentKind


@dataclass(frozen=True, eq=False)
class Points:
    """A cloud of points (N, 3), m, around `origin` (3,)."""

    name: str
    origin: F64
    points: F32
    colour: Colour


@dataclass(frozen=True, eq=False)
class Lines:
    """Line segments (N, 2, 3), m, around `origin` (3,). width: pixels."""

    name: str
    origin: F64
    segments: F32
    colour: Colour
    width: float


@dataclass(frozen=True, eq=False)
class Marks:
    """Marks at positions (N, 3), m, that can be clicked."""

    name: str
    positions: F64
    colour: Colour


@dataclass(frozen=True, eq=False)
class Body:
    """An agent: T_room_body (4, 4). half_angles: as in `RunArrived`. is_current: its pose is current."""

    name: str
    label: str
    kind: AgentKind
    T_room_body: F64
    T_body_cam0: F64
    half_angles: tuple[float, float]
    colour: Colour
    is_current: bool


@dataclass(frozen=True)
class Picture:
    """What the agent `name` saw at its newest keyframe, a JPEG."""

    name: str
    jpeg: bytes


@dataclass(frozen=True, eq=False)
class Text:
    """A line of text at a place (3,) in the room."""

    name: str
    text: str
    position: F64


@dataclass(frozen=True)
class FloorGrid:
    """Floor at height z, m, from the corner `low` to the corner `high` (x, y), m."""

    z: float
    low: tuple[float, float]
    high: tuple[float, float]


@dataclass(frozen=True)
class Removed:
    """Remove the object of this name."""

    name: str


@dataclass(frozen=True)
class Announcement:
    """A line for people, shown for a while."""

    title: str
    text: str


Drawing = Points | Lines | Marks | Body | Picture | Text | FloorGrid | Removed | Announcement
