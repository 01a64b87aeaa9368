"""From a layout to a room that can be drawn: pictures and light."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from share.lab.emulate.types import DrawableRoom, Mesh
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.light import UNIT_LIGHT, bake_light
from share.lab.emulate.world.materials import MATERIAL_KINDS, GivenMaterial, Material
from share.lab.emulate.world.mesh import Shape, concat_shapes
from share.lab.emulate.world.noise import PICTURE_TEXELS
from share.lab.emulate.world.prints import PRINTS
from share.lab.emulate.world.surfaces import SURFACES
from share.types import F32, U8

MIN_ALBEDO, MAX_ALBEDO = 4, 250  # nothing is black or white


def draw_material(material: Material | GivenMaterial, seed: int) -> U8:
    """Return the picture of one material in the room `seed`."""
    if isinstance(material, GivenMaterial):
        return material.pixels
    rng = np.random.default_rng((seed, zlib.crc32(material.kind.encode()), material.variant, 0))
    kind = MATERIAL_KINDS[material.kind]
    mean = kind.gray + rng.normal(0, kind.gray_sigma) if material.gray is None else material.gray
    if material.is_fitted:
        sheet = _print_sheet(material, rng).astype(np.float32)
        own = float(sheet.mean())
        mean = own if material.gray is None else mean
        deviation = sheet - own
    else:
        deviation = SURFACES[material.kind](rng, material.extent)
    picture: U8 = (mean + material.contrast * deviation).clip(MIN_ALBEDO, MAX_ALBEDO).round().astype(np.uint8)
    return picture


def draw_materials(materials: Sequence[Material | GivenMaterial], seed: int) -> U8:
    """Return pictures (L, P, P), one for each material."""
    return np.stack([draw_material(material, seed) for material in materials])


def mean_albedo(pictures: U8) -> F32:
    """Return the share of light that each picture (L, P, P) reflects, (L,) 0..1."""
    return np.asarray(pictures[:, ::4, ::4].mean((1, 2)) / 255, np.float32)


def _print_sheet(material: Material, rng: np.random.Generator) -> U8:
    """Return all prints of one picture."""
    n = material.cells
    rows = [[PRINTS[material.kind](rng, PICTURE_TEXELS // n) for _ in range(n)] for _ in range(n)]
    return np.block(rows)


Movers = Mapping[str, Sequence[Shape]]


def build_room(layout: Layout, movers: Movers | None = None) -> DrawableRoom:
    """Return the room of `layout` with the parts of agents by name, each in its own frame. Deterministic: the
    same layout and movers give the same bytes. Raises UsageError where the package for light is missing."""
    fixed = concat_shapes(*[piece.shape for piece in layout.all_pieces])
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
