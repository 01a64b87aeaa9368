"""Bodies of agents as others see them: rigid parts of a person, a robot and a drone, as shapes with
materials.

Each part has a frame of its own: x ahead, y left, z up, its origin where it hangs (a limb's upper joint, the
middle of the hips, the middle of the head; the floor under a robot; the middle of a drone). A person is made
for a height of 1 m and scaled: segment lengths by Drillis & Contini (1966), as in Winter, *Biomechanics and
Motor Control of Human Movement*.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Shape, box, concat_shapes, cylinder, prism

Rng = np.random.Generator

THIGH, SHIN, ANKLE, HIP = 0.245, 0.246, 0.039, 0.53  # lengths, and height of the hip, over the body's height
UPPER_ARM, FOREARM, SHOULDER = 0.186, 0.200, 0.285  # the shoulder over the hip
SHOULDERS, HIPS = 0.110, 0.055  # half widths
EYE = 0.936  # height of the eyes
HEADSET_M = 0.10  # from the middle of the head to the headset's IMU


def person(rng: Rng, height: float) -> tuple[Shape, ...]:
    """Return head, torso, upper arms, forearms, thighs, shins, feet; the left one of each pair first. height:
    m."""
    h = height
    skin = Material("skin", gray=float(rng.uniform(90, 175)))
    shirt, trousers = (
        Material("fabric", int(rng.integers(1000)), float(rng.uniform(*gray)), contrast=1.4, metres=0.5)
        for gray in ((70, 190), (45, 110))
    )
    shoes = Material("rubber", int(rng.integers(1000)))
    arm = [_limb(UPPER_ARM * h, 0.050, 0.040, shirt, rng) for _ in range(2)]
    fore = [
        concat_shapes([_limb(FOREARM * h, 0.040, 0.030, skin, rng), _hand(FOREARM * h, skin)])
        for _ in range(2)
    ]
    thigh = [_limb(THIGH * h, 0.082, 0.060, trousers, rng) for _ in range(2)]
    shin = [_limb(SHIN * h, 0.060, 0.045, trousers, rng) for _ in range(2)]
    foot = [box((-0.07, -0.045, -ANKLE * h), (0.19, 0.045, 0.02), shoes, rng) for _ in range(2)]
    return (_head(skin, rng), _torso(h, shirt, trousers, rng), *arm, *fore, *thigh, *shin, *foot)


def robot(rng: Rng, height: float) -> tuple[Shape, ...]:
    """Return a body like a TurtleBot 4: a round base of 34 cm, a plate above it, a mast with a camera at
    `height` m."""
    dark = Material("plastic", int(rng.integers(1000)), gray=60, contrast=1.2)
    light = Material("plastic", int(rng.integers(1000)), gray=170)
    metal = Material("galvanised", int(rng.integers(1000)))
    label = Material("label", int(rng.integers(1000)))
    top = height - 0.03
    posts = [
        cylinder((x, y, 0.09), 0.008, 0.11, metal, axis="z", sides=8)
        for x in (-0.1, 0.1)
        for y in (-0.1, 0.1)
    ]
    return (
        concat_shapes(
            [
                cylinder((0, 0, 0.015), 0.170, 0.075, dark, dark, sides=24, rng=rng),
                cylinder((0, 0, 0.090), 0.150, 0.012, light, light, sides=24, rng=rng),
                *posts,
                cylinder((0, 0, 0.195), 0.160, 0.008, light, light, sides=24, rng=rng),
                box((-0.06, -0.06, 0.105), (0.06, 0.06, 0.165), {"all": dark, "side": label}, rng),
                box((-0.10, -0.015, 0.203), (-0.07, 0.015, top), metal, rng),
                box((-0.10, -0.012, top - 0.02), (0.0, 0.012, top), metal, rng),
                box(
                    (-0.015, -0.045, top),
                    (0.010, 0.045, top + 0.05),
                    {"all": metal, "+x": Material("screen")},
                    rng,
                ),
                cylinder((0.06, 0, 0.203), 0.035, 0.04, dark, dark, sides=16, rng=rng),
            ]
        ),
    )


def drone(rng: Rng, height: float) -> tuple[Shape, ...]:
    """Return a small multicopter; its rotors are discs. height: unused."""
    dark = Material("plastic", int(rng.integers(1000)), gray=50)
    metal = Material("steel", int(rng.integers(1000)))
    parts = [
        box((-0.10, -0.06, -0.03), (0.10, 0.06, 0.04), {"all": dark, "side": Material("label")}, rng),
        box((0.10, -0.07, -0.02), (0.12, 0.07, 0.01), dark, rng),
    ]
    for k in range(6):
        a = np.pi / 6 + k * np.pi / 3
        arm = box((0.05, -0.012, 0.0), (0.25, 0.012, 0.018), metal, rng)
        rotor = cylinder((0.25, 0, 0.035), 0.095, 0.004, dark, dark, sides=16, rng=rng)
        parts += [part.placed_at(0, 0, 0, a) for part in (arm, rotor)]
    legs = [cylinder((x, y, -0.14), 0.006, 0.12, dark, sides=6) for x in (-0.07, 0.07) for y in (-0.06, 0.06)]
    return (concat_shapes(parts + legs),)


BODY_SHAPES: dict[str, Callable[[Rng, float], tuple[Shape, ...]]] = {
    "person": person,
    "robot": robot,
    "drone": drone,
}


def _limb(length: float, upper: float, lower: float, skin: Material, rng: Rng) -> Shape:
    """Return a limb that hangs down from its joint."""
    round_end = cylinder((0, 0, -0.01), upper, 0.03, skin, skin, sides=10, rng=rng, top=0.6 * upper)
    return concat_shapes(
        [cylinder((0, 0, -length), lower, length, skin, skin, sides=10, rng=rng, top=upper), round_end]
    )


def _hand(forearm: float, skin: Material) -> Shape:
    return box((-0.03, -0.014, -forearm - 0.10), (0.035, 0.014, -forearm), skin)


def _torso(h: float, shirt: Material, trousers: Material, rng: Rng) -> Shape:
    """Return the torso from the hips up: slices of elliptic outline (half depth, half width, low, high in
    m)."""
    up = SHOULDER * h
    slices = [
        (0.115, 0.165, -0.08, 0.06, trousers),
        (0.105, 0.150, 0.06, 0.45 * up, shirt),
        (0.115, 0.165, 0.45 * up, 0.75 * up, shirt),
        (0.115, 0.180, 0.75 * up, up, shirt),
        (0.085, 0.120, up, up + 0.035, shirt),
        (0.050, 0.052, up + 0.035, up + 0.12, Material("skin")),
    ]
    angle = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    rings = [(np.column_stack([d * np.cos(angle), w * np.sin(angle)]), a, b, m) for d, w, a, b, m in slices]
    return concat_shapes([prism(ring, low, high, m, m, rng) for ring, low, high, m in rings])


def _head(skin: Material, rng: Rng) -> Shape:
    """Return a rounded head with hair and a headset before the eyes."""
    hair = Material("carpet", int(rng.integers(1000)), gray=float(rng.uniform(35, 120)))
    shell = Material("plastic", int(rng.integers(1000)), gray=45)
    levels = [(-0.12, 0.050), (-0.09, 0.072), (-0.03, 0.086), (0.04, 0.090), (0.09, 0.070), (0.12, 0.030)]
    parts = [
        cylinder((0, 0, low), r, high - low, skin if high < 0.05 else hair, None, sides=14, rng=rng, top=r2)
        for (low, r), (high, r2) in pairwise(levels)
    ]
    parts.append(cylinder((0, 0, 0.12), 0.030, 0.003, hair, hair, sides=14, rng=rng))
    goggles = box(
        (0.055, -0.085, -0.03), (0.125, 0.085, 0.045), {"all": shell, "+x": Material("screen")}, rng
    )
    camera = box((0.105, -0.045, 0.05), (0.130, 0.045, 0.075), Material("galvanised"), rng)
    strap = cylinder((0, 0, 0.0), 0.093, 0.03, shell, None, sides=14, rng=rng)
    return concat_shapes([*parts, goggles, camera, strap])
