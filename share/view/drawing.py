"""Objects that a viewer draws, and how lines and frusta are made.

An object replaces an earlier one of the same name.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.colours import Colour
from share.types import F32, F64, AgentKind
from share.view import events as ev


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
class AgentBody:
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
    """The picture of the newest keyframe of agent `name`, a JPEG."""

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
class RemoveDrawing:
    """Remove the object of this name."""

    name: str


ANNOUNCED_S = 6.0  # s, for which an announcement is shown


@dataclass(frozen=True)
class Announcement:
    """A line for people, shown for a while."""

    title: str
    text: str


Drawing = Points | Lines | Marks | AgentBody | Picture | Text | FloorGrid | RemoveDrawing | Announcement


_FRUSTUM_M = 0.12  # size of a keyframe
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def shifted(T: F64, offset: F64) -> F64:
    """Return a pose (4, 4) moved by an offset (3,)."""
    out = T.copy()
    out[:3, 3] += offset
    return out


def lines(ends: F64, colour: Colour, width: float) -> Lines:
    """Return lines, without a name, between ends (N, 2, 3)."""
    origin = ends.reshape(-1, 3).mean(axis=0)
    return Lines("", origin, (ends - origin).astype(np.float32), colour, width)


def named(drawing: Lines | Text, name: str) -> Lines | Text:
    """Return the drawing under another name."""
    if isinstance(drawing, Text):
        return Text(name, drawing.text, drawing.position)
    return Lines(name, drawing.origin, drawing.segments, drawing.colour, drawing.width)


def frusta(T: F64, run: ev.RunArrived) -> F32:
    """Return the edges (8 N, 2, 3) of N frusta of bodies T (N, 4, 4)."""
    size = _FRUSTUM_M * (1.0 if run.kind is AgentKind.AR else 0.8)
    in_camera = np.vstack([np.zeros(3), np.column_stack([_CORNERS * run.half_angles, np.ones(4)]) * size])
    in_body = in_camera @ run.T_body_cam0[:3, :3].T + run.T_body_cam0[:3, 3]
    points = np.einsum("nij,kj->nki", T[:, :3, :3], in_body) + T[:, None, :3, 3]
    edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
    return np.asarray(points[:, edges].reshape(-1, 2, 3), np.float32)
