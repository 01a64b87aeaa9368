"""A finished room as a folder of plain arrays, which other processes map into memory instead of building it.

`open_renderer` opens the renderer that draws it.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.errors import DataError, UsageError
from share.files.json_file import own_format_errors, read_json
from share.files.reading import open_regular
from share.files.writing import atomic_write
from share.lab.emulate.types import DrawableRoom, Mesh, RoomRenderer
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.mesh import Shape

PLAIN = "plain"
_PLAIN_FILE = "plain.json"
_GL_FILE = "room.json"  # written last


def save_room_once(layout: Layout, movers: dict[str, tuple[Shape, ...]], folder: Path) -> None:
    """Draw pictures, bake light and write the room to the new folder `folder`, unless it exists."""
    if (folder / _PLAIN_FILE).exists() or (folder / _GL_FILE).exists():
        return
    if layout.name == PLAIN:
        folder.mkdir(parents=True, exist_ok=True)
        atomic_write(folder / _PLAIN_FILE, json.dumps({"seed": layout.seed, "size": layout.size}))
        return
    from share.lab.emulate.world.build import build_room

    save_room(build_room(layout, movers), folder)


def open_renderer(folder: Path) -> RoomRenderer:
    """Return the renderer of a saved room. Raises RenderError where this machine cannot draw, DataError where
    the room is damaged."""
    plain = folder / _PLAIN_FILE
    if plain.exists():
        from share.lab.emulate.plain.render import PlainRenderer

        data = read_json(plain)
        with own_format_errors(plain):
            x, y, z = (float(side) for side in data["size"])
            return PlainRenderer(int(data["seed"]), (x, y, z))
    from share.lab.emulate.render.gl import GlRenderer

    return GlRenderer(load_room(folder))


_VERSION = 1
_MESH_ARRAYS = ("vertices", "normals", "uv", "layer", "faces")
_ROOM_ARRAYS = ("size", "pictures", "light_uv", "light_map")


def save_room(room: DrawableRoom, folder: Path) -> None:
    """Write `room` to `folder` atomically. An existing room is kept if another process was quicker. Raises
    UsageError where it cannot be written."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        try:
            _write(room, part)
            _publish_folder(part, folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise UsageError(f"{folder}: the room cannot be written: {error.strerror or error}") from None


def load_room(folder: Path) -> DrawableRoom:
    """Return the room saved in `folder`, its arrays mapped read-only. Raises DataError where it is
    incomplete."""
    try:
        head = read_json(folder / _GL_FILE)
        if head["version"] != _VERSION:
            raise ValueError(f"version {head['version']}, expected {_VERSION}")
        movers = {
            name: tuple(_load_mesh(folder, f"mover{i}-{k}") for k in range(count))
            for i, (name, count) in enumerate(head["movers"])
        }
        return DrawableRoom(
            name=str(head["name"]),
            seed=int(head["seed"]),
            mesh=_load_mesh(folder, "mesh"),
            agent_parts=movers,
            mover_light=float(head["mover_light"]),
            **{key: _load(folder, key) for key in _ROOM_ARRAYS},
        )
    except (DataError, OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{folder}: not a complete room ({error}); delete it and it will be built again"
        ) from None


def _write(room: DrawableRoom, folder: Path) -> None:
    meshes = {"mesh": room.mesh}
    for i, parts in enumerate(room.agent_parts.values()):
        meshes |= {f"mover{i}-{k}": mesh for k, mesh in enumerate(parts)}
    for name, mesh in meshes.items():
        for key in _MESH_ARRAYS:
            np.save(folder / f"{name}.{key}.npy", getattr(mesh, key), allow_pickle=False)
    for key in _ROOM_ARRAYS:
        np.save(folder / f"{key}.npy", getattr(room, key), allow_pickle=False)
    head = {
        "version": _VERSION,
        "name": room.name,
        "seed": room.seed,
        "mover_light": room.mover_light,
        "movers": [[name, len(parts)] for name, parts in room.agent_parts.items()],
    }
    (folder / _GL_FILE).write_text(json.dumps(head, indent=1))


def _publish_folder(part: Path, folder: Path) -> None:
    try:
        os.rename(part, folder)
    except OSError:
        if not (folder / _GL_FILE).is_file():
            raise


def _load(folder: Path, name: str) -> NDArray[Any]:
    path = folder / f"{name}.npy"
    with open_regular(path):  # a pipe would block; mapped files are read on access
        return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))


def _load_mesh(folder: Path, name: str) -> Mesh:
    return Mesh(**{key: _load(folder, f"{name}.{key}") for key in _MESH_ARRAYS})
