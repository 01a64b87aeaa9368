"""From a layout to a room that can be drawn: pictures and light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from share.lab.emulate.types import DrawableRoom, Mesh
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.light import UNIT_LIGHT, bake_light
from share.lab.emulate.world.materials import GivenMaterial, Material
from share.lab.emulate.world.mesh import Shape, concat_shapes
from share.lab.emulate.world.pictures import draw_materials, mean_albedo

Movers = Mapping[str, Sequence[Shape]]


def build_room(layout: Layout, movers: Movers | None = None) -> DrawableRoom:
    """Return the room of `layout` with the parts of agents by name, each in its own frame. Deterministic: the
    same layout and movers give the same bytes. Raises UsageError where the package for light is missing."""
    fixed = concat_shapes([piece.shape for piece in layout.all_pieces])
    parts = {name: tuple(shapes) for name, shapes in (movers or {}).items()}
    materials = tuple(
        dict.fromkeys([*fixed.materials, *(m for s in parts.values() for p in s for m in p.materials)])
    )
    pictures = draw_materials(materials, layout.seed)
    glows = np.array([m.is_glowing for m in materials])
    light_uv, light_map = bake_light(
        fixed.mesh, mean_albedo(pictures), glows, layout.lights, layout.ambient, layout.brightness
    )
    return DrawableRoom(
        name=layout.name,
        seed=layout.seed,
        size=np.asarray(layout.size, float),
        mesh=fixed.mesh,
        pictures=pictures,
        light_uv=light_uv,
        light_map=light_map,
        agent_parts={
            n: tuple(_with_layer_numbers(p, materials) for p in shapes) for n, shapes in parts.items()
        },
        mover_light=float(np.median(light_map[light_map > 0])) / UNIT_LIGHT,
    )


def _with_layer_numbers(shape: Shape, materials: tuple[Material | GivenMaterial, ...]) -> Mesh:
    """Return the mesh of a shape, with layers that index `materials`."""
    number = np.array([materials.index(m) for m in shape.materials], np.int32)
    return replace(shape.mesh, layer=number[shape.mesh.layer])
