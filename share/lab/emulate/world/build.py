"""From a layout to a room that can be drawn: pictures and light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from share.lab.emulate.types import Mesh, Room
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.light import FULL, bake
from share.lab.emulate.world.materials import Given, Material
from share.lab.emulate.world.mesh import Shape, concat
from share.lab.emulate.world.pictures import draw_all, mean_albedo

Movers = Mapping[str, Sequence[Shape]]


def build(layout: Layout, movers: Movers | None = None) -> Room:
    """The room of `layout`, and by name the parts of agents that others may see, each in its own frame.
    The same layout and movers give the same bytes. Raises UsageError where a package for light is absent."""
    fixed = concat([piece.shape for piece in layout.everything])
    parts = {name: tuple(shapes) for name, shapes in (movers or {}).items()}
    materials = tuple(
        dict.fromkeys([*fixed.materials, *(m for s in parts.values() for p in s for m in p.materials)])
    )
    pictures = draw_all(materials, layout.seed)
    glows = np.array([m.glows for m in materials])
    light_uv, light_map = bake(
        fixed.mesh, mean_albedo(pictures), glows, layout.lights, layout.ambient, layout.brightness
    )
    return Room(
        name=layout.name,
        seed=layout.seed,
        size=np.asarray(layout.size, float),
        mesh=fixed.mesh,
        pictures=pictures,
        light_uv=light_uv,
        light_map=light_map,
        movers={n: tuple(_numbered(p, materials) for p in shapes) for n, shapes in parts.items()},
        mover_light=float(np.median(light_map[light_map > 0])) / FULL,
    )


def _numbered(shape: Shape, materials: tuple[Material | Given, ...]) -> Mesh:
    """The mesh of a shape, its layers counting into `materials`."""
    number = np.array([materials.index(m) for m in shape.materials], np.int32)
    return replace(shape.mesh, layer=number[shape.mesh.layer])
