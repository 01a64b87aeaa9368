"""From materials to pictures: (P, P) uint8 albedo, different for every seed and variant."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from share.lab.emulate.world.materials import MATERIAL_KINDS, GivenMaterial, Material
from share.lab.emulate.world.noise import PICTURE_TEXELS
from share.lab.emulate.world.prints import PRINTS
from share.lab.emulate.world.surfaces import SURFACES
from share.types import F32, U8

MIN_ALBEDO, MAX_ALBEDO = 4, 250  # nothing is black or white


def draw_material(material: Material | GivenMaterial, seed: int) -> U8:
    """Return the picture of one material in the room `seed`."""
    if isinstance(material, GivenMaterial):
        return material.pixels
    rng = np.random.default_rng(
        (seed, zlib.crc32(material.kind.encode()), material.variant, len(material.text))
    )
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
    rows = [
        [PRINTS[material.kind](rng, PICTURE_TEXELS // n, material.text) for _ in range(n)] for _ in range(n)
    ]
    return np.block(rows)
