"""Point clouds as PLY files (Turk, *The PLY Polygon File Format*, 1994): binary, little-endian."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from share.io.files import fresh, writing
from share.types import F64

Colour = tuple[int, int, int]

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
_NAMES = {"<f4": "float", "|u1": "uchar"}


def write_ply(path: Path, clouds: Iterable[tuple[F64, Colour]]) -> int:
    """All points (N, 3) of all clouds, each cloud in its colour; how many. Raises ShareError.

    The clouds are written as they come, their number into the header in the end.
    """
    with writing(path), fresh(path) as file:
        file.write(_header(0))
        count = 0
        for points, colour in clouds:
            vertices = np.empty(len(points), _VERTEX)
            for axis, name in enumerate("xyz"):
                vertices[name] = points[:, axis]
            vertices["red"], vertices["green"], vertices["blue"] = colour
            file.write(vertices.tobytes())
            count += len(points)
        file.seek(0)
        file.write(_header(count))
    return count


def _header(count: int) -> bytes:
    """Of the same length for every count."""
    assert _VERTEX.fields is not None
    properties = [f"property {_NAMES[kind.str]} {name}" for name, (kind, *_) in _VERTEX.fields.items()]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {count:<12}",
        *properties,
        "end_header",
    ]
    return "".join(line + "\n" for line in lines).encode()
