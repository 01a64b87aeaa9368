"""Seamless noise and marks: fields (P, P) float32 that continue over their borders."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np

from share.types import F32, U8

PICTURE_TEXELS = 512  # along each side of a picture
Rng = np.random.Generator


@lru_cache(maxsize=4)
def _frequency(size: int) -> F32:
    """Return cycles per picture (size, size // 2 + 1) of each entry of `rfft2`; 1 for the mean."""
    f = np.hypot(np.fft.fftfreq(size, 1 / size)[:, None], np.fft.rfftfreq(size, 1 / size)[None])
    f[0, 0] = 1
    return to_float32(f)


def to_float32(array: object) -> F32:
    """Return the array in single precision."""
    return np.asarray(array, np.float32)


def cloud(rng: Rng, slope: float = 1.0, low: float = 1, high: float = 1e9, size: int = PICTURE_TEXELS) -> F32:
    """Return noise of amplitude 1 / f^slope between `low` and `high` cycles per picture; mean 0, sigma 1.
    Photographs of rooms have a slope of about 1 (Field, JOSA A 4(12), 1987)."""
    f = _frequency(size)
    weight = f**-slope * (f >= low) * (f <= high)
    weight[0, 0] = 0
    out = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size), np.float32)) * weight, (size, size))
    return to_float32(out / out.std())


def grain(rng: Rng, across: float, along: float) -> F32:
    """Return noise stretched along the columns' axis: correlation of `across` and `along` texels; sigma 1."""
    fy, fx = np.fft.fftfreq(PICTURE_TEXELS)[:, None], np.fft.rfftfreq(PICTURE_TEXELS)[None]
    weight = np.exp(-2 * np.pi**2 * ((fy * across) ** 2 + (fx * along) ** 2))
    out = np.fft.irfft2(
        np.fft.rfft2(rng.standard_normal((PICTURE_TEXELS, PICTURE_TEXELS), np.float32)) * weight,
        (PICTURE_TEXELS, PICTURE_TEXELS),
    )
    return to_float32(out / out.std())


def scattered_marks(draw: Callable[[U8], None], sigma: float = 0.7) -> F32:
    """Return what `draw` paints in 128 + gray on a canvas 2 P wide, folded into one picture: a mark that
    leaves on one side comes back on the other. Deviation from 128, slightly softened."""
    canvas = np.full((2 * PICTURE_TEXELS, 2 * PICTURE_TEXELS), 128, np.uint8)
    draw(canvas)
    soft = cv2.GaussianBlur(canvas.astype(np.float32), (0, 0), sigma) - 128
    return to_float32(
        soft[:PICTURE_TEXELS, :PICTURE_TEXELS]
        + soft[PICTURE_TEXELS:, :PICTURE_TEXELS]
        + soft[:PICTURE_TEXELS, PICTURE_TEXELS:]
        + soft[PICTURE_TEXELS:, PICTURE_TEXELS:]
    )


def spots(
    rng: Rng, count: int, radius: tuple[float, float], gray: tuple[float, float], flat: float = 0.5
) -> F32:
    """Return `count` elliptic stains of `radius` texels (from, to) and deviation `gray` (sigma of both signs
    in between); `flat` is the least ratio of their axes."""

    def draw(canvas: U8) -> None:
        for _ in range(count):
            r = float(np.exp(rng.uniform(*np.log(radius))))
            at = rng.integers(PICTURE_TEXELS // 2, PICTURE_TEXELS + PICTURE_TEXELS // 2, 2).tolist()
            axes = (max(round(r), 1), max(round(r * rng.uniform(flat, 1)), 1))
            level = 128 + rng.uniform(*gray)
            cv2.ellipse(canvas, at, axes, float(rng.uniform(0, 180)), 0, 360, float(level), -1, cv2.LINE_AA)

    return scattered_marks(draw)


def scratches(rng: Rng, count: int, length: float, gray: tuple[float, float], turn: float = 180.0) -> F32:
    """Return `count` thin lines of about `length` texels at up to +-`turn` degrees from the rows."""

    def draw(canvas: U8) -> None:
        for _ in range(count):
            start = rng.uniform(PICTURE_TEXELS // 2, PICTURE_TEXELS + PICTURE_TEXELS // 2, 2)
            angle = np.radians(rng.uniform(-turn, turn))
            end = start + length * rng.uniform(0.2, 1) * np.array([np.cos(angle), np.sin(angle)])
            a, b = (v.round().astype(int).tolist() for v in (start, end))
            cv2.line(canvas, a, b, float(128 + rng.uniform(*gray)), 1, cv2.LINE_AA)

    return scattered_marks(draw, 0.5)


def brick_courses(
    rng: Rng, rows: int, columns: int, spread: float, joint: float, width: int = 2, offset: float = 0.5
) -> F32:
    """Return bricks, tiles or planks: `rows` x `columns` stones, each with its own gray (sigma `spread`),
    joints `width` texels wide that deviate by `joint`; `offset` of a stone from row to row, random if
    negative."""
    out = np.zeros((PICTURE_TEXELS, PICTURE_TEXELS), np.float32)
    tops = np.linspace(0, PICTURE_TEXELS, rows + 1).round().astype(int)
    for row, (top, foot) in enumerate(pairwise(tops)):
        cuts = np.linspace(0, PICTURE_TEXELS, columns + 1).round().astype(int)
        line = np.repeat(rng.normal(0, spread, columns), np.diff(cuts)).astype(np.float32)
        for k in range(width):
            line[(cuts[:-1] + k) % PICTURE_TEXELS] = joint
        shift = rng.integers(PICTURE_TEXELS) if offset < 0 else round(row * offset * PICTURE_TEXELS / columns)
        out[top:foot] = np.roll(line, shift)
        out[top : top + width] = joint
    return soften(out)


def soften(picture: F32, sigma: float = 0.6) -> F32:
    """Return a Gaussian blur across the borders."""
    pad = 4
    wide = np.pad(picture, pad, mode="wrap")
    return to_float32(cv2.GaussianBlur(wide, (0, 0), sigma)[pad:-pad, pad:-pad])
