"""Shapes of the live room: lines and frusta, moved into the room."""

from __future__ import annotations

import numpy as np

from share.colours import Colour
from share.types import F32, F64, AgentKind
from share.view import drawing as dr
from share.view import events as ev

_FRUSTUM_M = 0.12  # size of a keyframe
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def shifted(T: F64, offset: F64) -> F64:
    """Return a pose (4, 4) moved by an offset (3,)."""
    out = T.copy()
    out[:3, 3] += offset
    return out


def lines(ends: F64, colour: Colour, width: float) -> dr.Lines:
    """Return lines, without a name, between ends (N, 2, 3)."""
    origin = ends.reshape(-1, 3).mean(axis=0)
    return dr.Lines("", origin, (ends - origin).astype(np.float32), colour, width)


def named(thing: dr.Lines | dr.Text, name: str) -> dr.Lines | dr.Text:
    """Return the thing under another name."""
    if isinstance(thing, dr.Text):
        return dr.Text(name, thing.text, thing.position)
    return dr.Lines(name, thing.origin, thing.segments, thing.colour, thing.width)


def frusta(T: F64, shown: ev.RunArrived) -> F32:
    """Return the edges (8 N, 2, 3) of N frusta of bodies T (N, 4, 4)."""
    size = _FRUSTUM_M * (1.0 if shown.kind is AgentKind.AR else 0.8)
    in_camera = np.vstack([np.zeros(3), np.column_stack([_CORNERS * shown.half_angles, np.ones(4)]) * size])
    in_body = in_camera @ shown.T_body_cam0[:3, :3].T + shown.T_body_cam0[:3, 3]
    points = np.einsum("nij,kj->nki", T[:, :3, :3], in_body) + T[:, None, :3, 3]
    edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
    return np.asarray(points[:, edges].reshape(-1, 2, 3), np.float32)
