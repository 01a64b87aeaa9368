"""A room kept for other processes to open, and the renderer that can draw it."""

from __future__ import annotations

import json
from pathlib import Path

from share.files.json_file import as_we_write_it, read_json
from share.files.writing import atomic_write
from share.lab.emulate.types import Renderer
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.mesh import Shape

PLAIN = "plain"
_PLAIN_FILE = "plain.json"
_GL_FILE = "room.json"  # of `share.lab.emulate.world.files`


def keep(layout: Layout, movers: dict[str, tuple[Shape, ...]], folder: Path) -> None:
    """Draw pictures, bake light and write it all as the new folder `folder`, unless that was done before."""
    if (folder / _PLAIN_FILE).exists() or (folder / _GL_FILE).exists():
        return
    if layout.name == PLAIN:
        folder.mkdir(parents=True, exist_ok=True)
        atomic_write(folder / _PLAIN_FILE, json.dumps({"seed": layout.seed, "size": layout.size}))
        return
    from share.lab.emulate.world.build import build
    from share.lab.emulate.world.files import save_room

    save_room(build(layout, movers), folder)


def open_renderer(folder: Path) -> Renderer:
    """Raises RenderError where nothing can be drawn here, DataError where what was kept is damaged."""
    plain = folder / _PLAIN_FILE
    if plain.exists():
        from share.lab.emulate.plain.scene import PlainRenderer

        data = read_json(plain)
        with as_we_write_it(plain):
            x, y, z = (float(side) for side in data["size"])
            return PlainRenderer(int(data["seed"]), (x, y, z))
    from share.lab.emulate.render.gl import GlRenderer
    from share.lab.emulate.world.files import load_room

    return GlRenderer(load_room(folder))
