"""Save a room for other processes, and open the renderer that draws it."""

from __future__ import annotations

import json
from pathlib import Path

from share.files.json_file import own_format_errors, read_json
from share.files.writing import atomic_write
from share.lab.emulate.types import RoomRenderer
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.mesh import Shape

PLAIN = "plain"
_PLAIN_FILE = "plain.json"
_GL_FILE = "room.json"  # written by `share.lab.emulate.world.room_files`


def save_room_once(layout: Layout, movers: dict[str, tuple[Shape, ...]], folder: Path) -> None:
    """Draw pictures, bake light and write the room to the new folder `folder`, unless it exists."""
    if (folder / _PLAIN_FILE).exists() or (folder / _GL_FILE).exists():
        return
    if layout.name == PLAIN:
        folder.mkdir(parents=True, exist_ok=True)
        atomic_write(folder / _PLAIN_FILE, json.dumps({"seed": layout.seed, "size": layout.size}))
        return
    from share.lab.emulate.world.build import build_room
    from share.lab.emulate.world.room_files import save_room

    save_room(build_room(layout, movers), folder)


def open_renderer(folder: Path) -> RoomRenderer:
    """Return the renderer of a saved room. Raises RenderError where this machine cannot draw, DataError where
    the room is damaged."""
    plain = folder / _PLAIN_FILE
    if plain.exists():
        from share.lab.emulate.plain.scene import PlainRenderer

        data = read_json(plain)
        with own_format_errors(plain):
            x, y, z = (float(side) for side in data["size"])
            return PlainRenderer(int(data["seed"]), (x, y, z))
    from share.lab.emulate.render.gl import GlRenderer
    from share.lab.emulate.world.room_files import load_room

    return GlRenderer(load_room(folder))
