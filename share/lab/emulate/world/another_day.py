"""The same room on another day: other light, loose things moved, a third of the cartons gone.

Walls, doors, racks, signs and what else is built in stay where they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from share.lab.emulate.world.layout import Layout, Light, Piece
from share.lab.emulate.world.mesh import Rng, Shape, with_faces
from share.types import F64, I64

CARTONS_GONE = 1 / 3  # share of the cartons that are taken away
_STEP_M, _TURN_RAD = 0.5, 0.6  # largest motion of a loose thing
_PARKED_M, _PARKED_RAD = 0.15, 0.02  # largest motion of a vehicle: it stands in its lane again
_TRIES = 12  # of a place where it overlaps nothing
_LAMP_OFF = 0.2  # probability
_LAMP_POWER, _WINDOW_POWER = (0.7, 1.3), (0.1, 2.5)  # factors
_AMBIENT, _BRIGHTNESS = (0.7, 1.3), (0.55, 1.15)  # factors

_LOOSE = (
    *("bench", "bin", "cartons", "chair", "cones", "crate", "drums", "hand truck", "loaded pallet"),
    *("pallet truck", "pallets", "step ladder", "table", "tool box"),
)
_VEHICLES = ("fire engine", "forklift", "van")

_CARTON = "cardboard"  # the material that only cartons have
_ON_CARTON_M = 0.006  # more than tape and labels stand off a carton
_STANDS_ON_M = 0.01
_SAME_CORNER_M = 1e-4


def another_day(layout: Layout, day: int) -> Layout:
    """Return the room `day` days later; day 0 is the room as it was furnished. Deterministic."""
    if not day:
        return layout
    rng = np.random.default_rng((layout.seed, 13, day))
    pieces = tuple(replace(piece, shape=_without_cartons(piece.shape, rng)) for piece in layout.pieces)
    return replace(
        layout,
        pieces=_moved(pieces, layout.size, rng),
        lights=tuple(_other_power(light, rng) for light in layout.lights),
        ambient=layout.ambient * rng.uniform(*_AMBIENT),
        brightness=layout.brightness * rng.uniform(*_BRIGHTNESS),
    )


def _other_power(light: Light, rng: Rng) -> Light:
    if light.facing[2] > -0.5:  # a window: the sun has moved, or it is overcast
        return replace(light, power=light.power * rng.uniform(*_WINDOW_POWER))
    factor = 1e-3 if rng.random() < _LAMP_OFF else rng.uniform(*_LAMP_POWER)
    return replace(light, power=light.power * factor)


# ---- Loose things


def _moved(pieces: Sequence[Piece], size: Sequence[float], rng: Rng) -> tuple[Piece, ...]:
    """Return the pieces with loose things and vehicles at other places, where they overlap nothing."""
    out = list(pieces)
    boxes = np.array([piece.bounding_box for piece in pieces])
    for k, piece in enumerate(pieces):
        if (reach := _reach(piece)) is None:
            continue
        others = np.delete(boxes, k, axis=0)
        for _ in range(_TRIES):
            shape = _nudged(piece.shape, *reach, rng)
            if _is_free(shape.bounding_box, others, boxes[k], size):
                out[k], boxes[k] = replace(piece, shape=shape), shape.bounding_box
                break
    return tuple(out)


def _reach(piece: Piece) -> tuple[float, float] | None:
    """Return how far (m, rad) a piece moves; None: it is not loose."""
    name = piece.name.rpartition(" ")[0]
    if name in _VEHICLES:
        return _PARKED_M, _PARKED_RAD
    return (_STEP_M, _TURN_RAD) if name in _LOOSE else None


def _nudged(shape: Shape, step_m: float, turn_rad: float, rng: Rng) -> Shape:
    """Return the shape turned about its own middle, and shifted."""
    x, y, _ = shape.bounding_box.mean(0)
    dx, dy = rng.uniform(-step_m, step_m, 2)
    return shape.placed_at(-x, -y).placed_at(x + dx, y + dy, 0.0, rng.uniform(-turn_rad, turn_rad))


def _is_free(box: F64, others: F64, before: F64, size: Sequence[float]) -> bool:
    """Return whether a box (2, 3) m lies in the room and overlaps none of `others` (N, 2, 3) that the piece
    did not overlap `before`, as the paint under it."""
    inside = (box[0] >= 0).all() and (box[1] <= np.array(size)).all()
    return bool(inside and not (_overlaps(box, others) & ~_overlaps(before, others)).any())


def _overlaps(box: F64, others: F64) -> NDArray[np.bool_]:
    apart = (others[:, 1] <= box[0]) | (others[:, 0] >= box[1])
    return np.asarray(~apart.any(axis=1))


# ---- Cartons


def _without_cartons(shape: Shape, rng: Rng) -> Shape:
    """Return the shape without a third of its cartons: never one on which another stands."""
    parts = _parts(shape)
    cartons = np.array([part.box for part in parts if part.is_carton])
    count = round(CARTONS_GONE * len(cartons))
    if not count:
        return shape
    taken = _taken_cartons(cartons, count, rng)
    low, high = taken[:, 0] - _ON_CARTON_M, taken[:, 1] + _ON_CARTON_M
    stays = [part for part in parts if not ((part.box[0] >= low) & (part.box[1] <= high)).all(axis=1).any()]
    return with_faces(shape, np.concatenate([part.faces for part in stays]))


def _taken_cartons(boxes: F64, count: int, rng: Rng) -> F64:
    """Return `count` of the cartons' boxes (N, 2, 3) m, taken one by one from the top."""
    is_left = np.ones(len(boxes), bool)
    above = np.abs(boxes[:, None, 0, 2] - boxes[None, :, 1, 2]) < _STANDS_ON_M  # (upper, lower)
    stands_on = above & np.array([_overlaps(box[:, :2], boxes[:, :, :2]) for box in boxes])
    for _ in range(count):
        is_free = is_left & ~stands_on[is_left].any(axis=0)
        is_left[rng.choice(np.flatnonzero(is_free))] = False
    return np.asarray(boxes[~is_left])


@dataclass(frozen=True, eq=False)
class _Part:
    """Triangles that corners connect: indices `faces` (F,), bounding box (2, 3) m."""

    faces: I64
    box: F64
    is_carton: bool


def _parts(shape: Shape) -> list[_Part]:
    mesh = shape.mesh
    places = np.unique(np.round(mesh.vertices / _SAME_CORNER_M), axis=0, return_inverse=True)[1].reshape(-1)
    steps = np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]])
    links = coo_matrix((np.ones(len(steps)), places[steps].T), (places.max() + 1,) * 2)
    number = connected_components(links, directed=False)[1][places][mesh.faces[:, 0]]
    is_cardboard = np.array([getattr(material, "kind", "") == _CARTON for material in shape.materials])
    out = []
    for k in range(number.max() + 1):
        faces = np.flatnonzero(number == k)
        corners = mesh.vertices[mesh.faces[faces]].reshape(-1, 3).astype(float)
        is_carton = bool(is_cardboard[mesh.layer[mesh.faces[faces, 0]]].any())
        out.append(_Part(faces, np.stack([corners.min(0), corners.max(0)]), is_carton))
    return out
