"""A room of eight triangles as a glTF file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

CORNERS = np.array([(x, y, z) for x in (0, 4) for y in (0, 3) for z in (0, 5)], np.float32)  # of a room
FACES = np.array(
    [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6)], np.uint16
)
DATA = CORNERS.tobytes() + FACES.tobytes()


def tree() -> dict[str, Any]:
    """A room of eight triangles, whose numbers lie in room.bin."""
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "room.bin", "byteLength": len(DATA)}],
        "bufferViews": [
            {"buffer": 0, "byteLength": CORNERS.nbytes},
            {"buffer": 0, "byteOffset": CORNERS.nbytes, "byteLength": FACES.nbytes},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": FACES.size, "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }


def write(folder: Path, made: Any, data: bytes = DATA) -> Path:
    (folder / "room.bin").write_bytes(data)
    (folder / "room.gltf").write_text(made if isinstance(made, str) else json.dumps(made))
    return folder / "room.gltf"
