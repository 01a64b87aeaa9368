"""From materials to pictures: (P, P) uint8 albedo, another one for every seed and variant."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from share.lab.emulate.world.materials import KINDS, Given, Material
from share.lab.emulate.world.noise import P
from share.lab.emulate.world.prints import PRINTS
from share.lab.emulate.world.surfaces import SURFACES
from share.types import F32, U8

DARKEST, BRIGHTEST = 4, 250  # albedo; nothing is black or white


def draw(material: Material | Given, seed: int) -> U8:
    """The picture of one material in the room `seed`."""
    if isinstance(material, Given):
        return material.pixels
    rng = np.random.default_rng(
        (seed, zlib.crc32(material.kind.encode()), material.variant, len(material.text))
    )
    kind = KINDS[material.kind]
    mean = kind.gray + rng.normal(0, kind.spread) if material.gray is None else material.gray
    if material.fitted:
        sheet = _sheet(material, rng).astype(np.float32)
        own = float(sheet.mean())
        mean = own if material.gray is None else mean
        deviation = sheet - own
    else:
        deviation = SURFACES[material.kind](rng, material.extent)
    picture: U8 = (mean + material.contrast * deviation).clip(DARKEST, BRIGHTEST).round().astype(np.uint8)
    return picture


def draw_all(materials: Sequence[Material | Given], seed: int) -> U8:
    """Pictures (L, P, P), one for each material."""
    return np.stack([draw(material, seed) for material in materials])


def mean_albedo(pictures: U8) -> F32:
    """Share of light that each picture (L, P, P) throws back, (L,) 0..1, where 255 is all of it."""
    return np.asarray(pictures[:, ::4, ::4].mean((1, 2)) / 255, np.float32)


def _sheet(material: Material, rng: np.random.Generator) -> U8:
    """All prints of one picture."""
    n = material.cells
    rows = [[PRINTS[material.kind](rng, P // n, material.text) for _ in range(n)] for _ in range(n)]
    return np.block(rows)
