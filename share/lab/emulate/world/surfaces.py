"""Pictures of surfaces that repeat: deviation from the mean gray, (P, P) float32 gray levels.

Each recipe gets a generator and the metres that the picture covers. Contrast is that of real rooms seen by a
real camera: most of it soft and large, some of it fine; `Material.contrast` scales it.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from share.lab.emulate.world.noise import (
    PICTURE_TEXELS,
    brick_courses,
    cloud,
    grain,
    scattered_marks,
    scratches,
    soften,
    spots,
    to_float32,
)
from share.types import F32, U8

Rng = np.random.Generator
SurfacePainter = Callable[[Rng, float], F32]

_SPECKLE_GAIN = (
    1.3  # of all speckle, so that a warehouse has the corner counts of real halls (docs/understand/rooms.md)
)


def _mark_count(rng: Rng, metres: float, density: float) -> int:
    """Return the number of marks on a picture at `density` per square metre."""
    return int(rng.poisson(density * metres**2))


def _phase_ramp(cycles: float, along: int) -> F32:
    """Return a phase 0..1 that runs `cycles` times over the picture along axis `along`."""
    line = (np.arange(PICTURE_TEXELS, dtype=np.float32) + 0.5) / PICTURE_TEXELS * cycles % 1
    return np.tile(
        line[:, None] if along == 0 else line[None],
        (1, PICTURE_TEXELS) if along == 0 else (PICTURE_TEXELS, 1),
    )


def _wear_noise(rng: Rng, metres: float, large: float, fine: float) -> F32:
    """Soft 1/f variation and fine grain, part of every surface."""
    return large * cloud(rng, 1.4, high=80) + fine * cloud(rng, 0.4, low=40)


def _speckle(rng: Rng, metres: float, strength: float) -> F32:
    """Speckle of 1 to 4 cm with more strong specks than Gaussian noise: what a corner detector finds on a
    rough surface from across a room."""
    band = cloud(rng, 0.5, metres / 0.04, metres / 0.011)
    return to_float32(_SPECKLE_GAIN * strength * np.sign(band) * np.abs(band) ** 1.8)


def plaster(rng: Rng, m: float) -> F32:
    out = (
        _wear_noise(rng, m, 5, 2.5)
        + _speckle(rng, m, 3)
        + spots(rng, _mark_count(rng, m, 6), (1.5, 5), (-38, 14))
    )
    return out + scratches(rng, _mark_count(rng, m, 1.5), 90, (-28, 10))


def paint(rng: Rng, m: float) -> F32:
    return _wear_noise(rng, m, 3, 1.2) + spots(rng, _mark_count(rng, m, 0.7), (1, 3), (-24, 8))


def brick(rng: Rng, m: float) -> F32:
    rows, columns = 2 * round(m / 0.15), round(m / 0.25)
    return brick_courses(rng, rows, columns, 8, -15, 2) + _wear_noise(rng, m, 6, 4) + _speckle(rng, m, 5)


def block(rng: Rng, m: float) -> F32:
    rows, columns = 2 * round(m / 0.4), round(m / 0.4)
    out = brick_courses(rng, rows, columns, 3.5, -14, 2) + _wear_noise(rng, m, 5, 3) + _speckle(rng, m, 6)
    return out + spots(rng, _mark_count(rng, m, 12), (1, 3), (-40, 0))


def concrete(rng: Rng, m: float) -> F32:
    out = (
        _wear_noise(rng, m, 8, 3)
        + _speckle(rng, m, 6)
        + brick_courses(rng, round(m / 1.5), round(m / 1.5), 4, -16, 2, 0)
    )
    holes = spots(rng, _mark_count(rng, m, 25), (0.8, 3), (-55, -15), 0.7)
    return out + holes + scratches(rng, _mark_count(rng, m, 1), 160, (-30, -10))


def corrugated(rng: Rng, m: float) -> F32:
    phase = _phase_ramp(round(m / 0.25), 1)
    flank = np.clip(6 * np.abs(phase - 0.5) - 1.5, -1, 1)
    rivets = ((_phase_ramp(round(m / 0.25), 1) < 0.07) & (_phase_ramp(round(m / 0.5), 0) < 0.035)) * -35.0
    return to_float32(
        9 * flank + rivets + _wear_noise(rng, m, 4, 1.5) + 4 * grain(rng, 60, 2) + _speckle(rng, m, 4)
    )


def panel(rng: Rng, m: float) -> F32:
    out = brick_courses(rng, round(m / 1.2), round(m / 0.8), 4, -30, 2, 0)
    return (
        out
        + _wear_noise(rng, m, 3, 1.5)
        + _speckle(rng, m, 2.5)
        + spots(rng, _mark_count(rng, m, 1.5), (1, 3), (-40, 10))
    )


def ceiling(rng: Rng, m: float) -> F32:
    out = (
        brick_courses(rng, round(m / 0.6), round(m / 0.6), 3, -26, 2, 0)
        + _wear_noise(rng, m, 2, 2)
        + _speckle(rng, m, 1.5)
    )
    return out + spots(rng, _mark_count(rng, m, 60), (0.7, 1.6), (-40, -15))


def screed(rng: Rng, m: float) -> F32:
    out = _wear_noise(rng, m, 9, 3) + spots(rng, _mark_count(rng, m, 9), (1, 7), (-36, 30))
    arcs = scratches(rng, _mark_count(rng, m, 4), 140, (-26, 24))
    return out + arcs + _speckle(rng, m, 7)


def tiles(rng: Rng, m: float) -> F32:
    out = brick_courses(rng, round(m / 0.3333), round(m / 0.3333), 5, -24, 3, 0)
    return (
        out
        + _wear_noise(rng, m, 4, 2)
        + _speckle(rng, m, 2.5)
        + spots(rng, _mark_count(rng, m, 5), (1, 4), (-35, 20))
    )


def planks(rng: Rng, m: float) -> F32:
    return brick_courses(rng, 2 * round(m / 0.28), max(1, round(m / 1.0)), 8, -26, 2, -1) + _fibre(rng, m)


def _fibre(rng: Rng, m: float) -> F32:
    """Grain of wood, along the rows, with some knots."""
    out = 5 * grain(rng, 1.2, 60) + 4 * grain(rng, 5, 120)
    return (
        out
        + _wear_noise(rng, m, 3, 1.5)
        + _speckle(rng, m, 3)
        + spots(rng, _mark_count(rng, m, 3), (2, 5), (-50, -20))
    )


def carpet(rng: Rng, m: float) -> F32:
    return to_float32(
        _wear_noise(rng, m, 4, 7) + 3 * np.sin(2 * np.pi * _phase_ramp(round(m / 0.02), 0)).astype(np.float32)
    )


def wood(rng: Rng, m: float) -> F32:
    return brick_courses(rng, round(m / 0.125), 1, 10, -30, 2, -1) + 1.2 * _fibre(rng, m)


def plywood(rng: Rng, m: float) -> F32:
    return 0.8 * _fibre(rng, m) + 6 * grain(rng, 14, 60)


def _stencils(rng: Rng, m: float) -> F32:
    """Words, arrows and boxes printed on cardboard."""

    def draw(canvas: U8) -> None:
        for _ in range(_mark_count(rng, m, 14)):
            x, y = rng.integers(PICTURE_TEXELS // 2, PICTURE_TEXELS + PICTURE_TEXELS // 2, 2).tolist()
            size, ink = int(rng.uniform(0.04, 0.1) / m * PICTURE_TEXELS), float(128 - rng.uniform(30, 60))
            what = rng.integers(3)
            if what == 0:
                word = "".join(rng.choice(list("ABCDEFHKLMNPRSTUX2345789"), 5))
                cv2.putText(canvas, word, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size / 40, ink, 2, cv2.LINE_AA)
            elif what == 1:
                for k in (0, size):
                    cv2.arrowedLine(canvas, (x + k, y), (x + k, y - size), ink, 2, cv2.LINE_AA, 0, 0.4)
            else:
                cv2.rectangle(canvas, (x, y), (x + size, y + size), ink, 2)

    return scattered_marks(draw)


def cardboard(rng: Rng, m: float) -> F32:
    out = _wear_noise(rng, m, 6, 2) + _speckle(rng, m, 3) + 1.5 * grain(rng, 60, 1)
    seam = np.zeros((PICTURE_TEXELS, PICTURE_TEXELS), np.float32)
    tape = int(rng.integers(PICTURE_TEXELS)), int(0.05 / m * PICTURE_TEXELS)
    seam[(np.arange(tape[1]) + tape[0]) % PICTURE_TEXELS] = rng.uniform(10, 26)
    out += _stencils(rng, m)
    return out + seam + scratches(rng, _mark_count(rng, m, 9), 60, (-30, 15))


def steel(rng: Rng, m: float) -> F32:
    out = (
        _wear_noise(rng, m, 5, 1)
        + _speckle(rng, m, 2)
        + scratches(rng, _mark_count(rng, m, 18), 50, (-40, 40))
    )
    return out + spots(rng, _mark_count(rng, m, 14), (1, 4), (-50, 25))


def lacquer(rng: Rng, m: float) -> F32:
    return 4 * cloud(rng, 1.6, high=20) + 0.8 * cloud(rng, 0.3, low=40)


def galvanised(rng: Rng, m: float) -> F32:
    flakes = np.sign(cloud(rng, 0.3, 8, 60)) * 4 + np.sign(cloud(rng, 0.3, 8, 60)) * 3
    return to_float32(_wear_noise(rng, m, 4, 1.5) + soften(flakes, 0.8).astype(np.float32))


def grating(rng: Rng, m: float) -> F32:
    n = round(m / 0.0333)
    bars = np.maximum(_phase_ramp(n, 0) < 0.25, _phase_ramp(round(n / 3), 1) < 0.1).astype(np.float32)
    return to_float32(70 * (bars - bars.mean()) + _wear_noise(rng, m, 4, 2))


def fabric(rng: Rng, m: float) -> F32:
    weave = np.sin(2 * np.pi * _phase_ramp(round(m / 0.008), 0)) * np.sin(
        2 * np.pi * _phase_ramp(round(m / 0.008), 1)
    )
    return to_float32(7 * cloud(rng, 1.8, 2, 30) + 3 * weave + _wear_noise(rng, m, 3, 2))


def rubber(rng: Rng, m: float) -> F32:
    return _wear_noise(rng, m, 3, 2) + spots(rng, _mark_count(rng, m, 25), (1, 4), (0, 22))


def hose(rng: Rng, m: float) -> F32:
    weave = np.sin(2 * np.pi * (_phase_ramp(round(m / 0.02), 0) + _phase_ramp(round(m / 0.02), 1)))
    band = np.where(_phase_ramp(1, 0) < 0.06, -60.0, 0.0)
    return to_float32(9 * weave + band + _wear_noise(rng, m, 5, 3))


def plastic(rng: Rng, m: float) -> F32:
    out = _wear_noise(rng, m, 3, 1) + scratches(rng, _mark_count(rng, m, 12), 40, (-16, 24))
    ribs = np.where(_phase_ramp(round(m / 0.2), 1) < 0.06, -22.0, 0.0).astype(np.float32)
    return out + ribs


def glass(rng: Rng, m: float) -> F32:
    shine = 14 * cloud(rng, 2.0, 1, 6)
    return shine + _wear_noise(rng, m, 3, 0.6)


def stripes(rng: Rng, m: float) -> F32:
    phase = (_phase_ramp(round(m / 0.25), 0) + _phase_ramp(round(m / 0.25), 1)) % 1
    return np.where(phase < 0.5, -70.0, 70.0).astype(np.float32) + _chipped(rng, m)


def _chipped(rng: Rng, m: float) -> F32:
    """Worn paint."""
    return _wear_noise(rng, m, 6, 3) + np.where(cloud(rng, 0.7, 6, 90) > 1.9, -45.0, 0.0).astype(np.float32)


def marking(rng: Rng, m: float) -> F32:
    return _chipped(rng, m) + scratches(rng, _mark_count(rng, m, 20), 80, (-60, -20))


def foil(rng: Rng, m: float) -> F32:
    creases = scratches(rng, _mark_count(rng, m, 60), 90, (-30, 60), 40)
    return 12 * cloud(rng, 1.4, 1, 60) + creases + 3 * cloud(rng, 0.3, low=30)


def skin(rng: Rng, m: float) -> F32:
    return _wear_noise(rng, m, 4, 1)


def lamp(rng: Rng, m: float) -> F32:
    def bars(canvas: U8) -> None:
        for x in range(PICTURE_TEXELS // 2, 2 * PICTURE_TEXELS, PICTURE_TEXELS // 8):
            cv2.line(canvas, (x, 0), (x, 2 * PICTURE_TEXELS), 108.0, 3)

    return scattered_marks(bars) + _wear_noise(rng, m, 3, 1)


SURFACES: dict[str, SurfacePainter] = {
    f.__name__: f
    for f in (
        plaster, paint, brick, block, concrete, corrugated, panel, ceiling, screed, tiles, planks, 
        carpet, wood, plywood, cardboard, steel, lacquer, galvanised, grating, fabric,
        rubber, hose, plastic, glass, stripes, marking, foil, skin, lamp,
    )
}  # fmt: skip
