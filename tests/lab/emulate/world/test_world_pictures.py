"""Pictures: seamless, seeded, at the gray and contrast asked for."""

from __future__ import annotations

import zlib
from functools import cache

import numpy as np
import pytest

from share.lab.emulate.world.build import MAX_ALBEDO, MIN_ALBEDO, draw_material, mean_albedo
from share.lab.emulate.world.materials import MATERIAL_KINDS, Material
from share.lab.emulate.world.noise import PICTURE_TEXELS, cloud
from share.lab.emulate.world.prints import PRINTS
from share.lab.emulate.world.surfaces import SURFACES
from share.types import U8

ALL = [Material(kind) for kind in MATERIAL_KINDS]


@cache
def drawn(material: Material) -> U8:
    return draw_material(material, 5)


def test_every_kind_has_one_recipe() -> None:
    assert set(MATERIAL_KINDS) == set(SURFACES) | set(PRINTS) and not set(SURFACES) & set(PRINTS)
    assert {k for k, v in MATERIAL_KINDS.items() if v.is_fitted} == set(PRINTS)


@pytest.mark.parametrize("material", ALL, ids=lambda m: m.kind)
def test_same_seed_same_bytes_other_seed_or_variant_another_picture(material: Material) -> None:
    first = drawn(material)
    assert first.shape == (PICTURE_TEXELS, PICTURE_TEXELS) and first.dtype == np.uint8
    assert first.min() >= MIN_ALBEDO and first.max() <= MAX_ALBEDO
    assert zlib.crc32(first.tobytes()) == zlib.crc32(draw_material(material, 5).tobytes())
    for other in (
        draw_material(material, 6),
        draw_material(Material(material.kind, 1), 5),
    ):  # noise, not just a mark
        assert (other != first).mean() > 0.02


@pytest.mark.parametrize("material", [m for m in ALL if not m.is_fitted], ids=lambda m: m.kind)
def test_surfaces_are_seamless(material: Material) -> None:
    """Steps over the border are no larger than the largest steps within the picture."""
    picture = drawn(material).astype(float)
    for image in (picture, picture.T):
        inside = np.abs(np.diff(image, axis=0)).mean(1)
        seam = np.abs(image[0] - image[-1]).mean()
        assert seam <= 1.05 * inside.max() + 0.5


def test_gray_and_contrast_are_as_asked() -> None:
    plain, strong = (
        draw_material(Material("plaster", gray=140, contrast=c), 1).astype(float) for c in (0.5, 1.5)
    )
    assert plain.mean() == pytest.approx(140, abs=1.5) and strong.mean() == pytest.approx(140, abs=1.5)
    assert strong.std() == pytest.approx(3 * plain.std(), rel=0.1)
    assert draw_material(Material("plaster", gray=140, contrast=0), 1).std() == 0


def test_prints_of_a_picture_differ() -> None:
    sheet = draw_material(Material("label"), 2)
    n = PICTURE_TEXELS // 4
    cells = {
        sheet[r : r + n, c : c + n].tobytes()
        for r in range(0, PICTURE_TEXELS, n)
        for c in range(0, PICTURE_TEXELS, n)
    }
    assert len(cells) == 16


def test_noise_has_the_slope_asked_for() -> None:
    noise = cloud(np.random.default_rng(1), slope=1.0)
    amplitude = np.abs(np.fft.fft2(noise))
    f = np.hypot(*np.meshgrid(*[np.fft.fftfreq(PICTURE_TEXELS, 1 / PICTURE_TEXELS)] * 2))
    low, high = (amplitude[(f > a) & (f < 1.2 * a)].mean() for a in (8, 64))
    assert low / high == pytest.approx(8, rel=0.1)
    assert noise.std() == pytest.approx(1, rel=1e-5)


def test_albedo_is_the_mean_gray() -> None:
    pictures = np.stack(
        [
            np.full((PICTURE_TEXELS, PICTURE_TEXELS), 51, np.uint8),
            np.full((PICTURE_TEXELS, PICTURE_TEXELS), 204, np.uint8),
        ]
    )
    assert mean_albedo(pictures) == pytest.approx([0.2, 0.8])
