"""Procedural gray textures, different at each call, so that no two places look alike.

Sizes are (rows, columns) in texels; `per_m` is texels per metre. Results are float32 gray levels around
0..255, not clipped: shading and clipping come last.
"""

from __future__ import annotations

import cv2
import numpy as np

from share.types import F32

Size = tuple[int, int]
Rng = np.random.Generator


def cloud_noise(rng: Rng, size: Size, amplitudes: dict[int, float]) -> F32:
    """Return the sum of smooth noises {cell size in texels: standard deviation in gray levels}."""
    out = np.zeros(size, np.float32)
    for cell, amplitude in amplitudes.items():
        coarse = rng.normal(0, amplitude, (size[0] // cell + 4, size[1] // cell + 4)).astype(np.float32)
        fine = cv2.resize(coarse, None, fx=cell, fy=cell, interpolation=cv2.INTER_CUBIC)
        out += fine[cell : cell + size[0], cell : cell + size[1]]
    return out


def brick_rows(rng: Rng, size: Size, height: int, width: int, contrast: float, joint: float) -> F32:
    """Return bricks, tiles or planks: rows of `height`, cut at lengths about `width`, each with its own gray
    and dark joints."""
    out = np.zeros(size, np.float32)
    for top in range(0, size[0], height):
        row = out[top : top + height]
        left = -int(rng.integers(width))
        while left < size[1]:
            right = left + int(width * rng.uniform(0.7, 1.3))
            row[:, max(left, 0) : max(right, 0)] = rng.normal(0, contrast)
            row[:, max(right - 2, 0) : max(right, 0)] = -joint
            left = right
        row[-2:] = -joint
    return out


def draw_marks(rng: Rng, surface: F32, per_m2: float, per_m: float) -> None:
    """Draw stains and scratches of 1-6 cm in place, so that a bare surface is not blank."""
    h, w = surface.shape
    for _ in range(int(per_m2 * h * w / per_m**2)):
        at = int(rng.integers(w)), int(rng.integers(h))
        half = int(rng.uniform(0.005, 0.03) * per_m), int(rng.uniform(0.003, 0.01) * per_m)
        gray = float(surface[at[1], at[0]]) + float(rng.choice([-55, -35, 35]))
        cv2.ellipse(surface, at, half, float(rng.uniform(0, 180)), 0, 360, gray, -1)


def poster_texture(rng: Rng, size: Size) -> F32:
    """Return a printed sheet: shapes, lines and letters on a plain ground, in a frame."""
    h, w = size
    ground = rng.uniform(60, 220) + cloud_noise(rng, size, {32: 18, 8: 6})
    sheet = ground.clip(0, 255).astype(np.uint8)  # OpenCV 5 writes text on bytes only
    for _ in range(int(rng.integers(6, 13))):
        x, y = int(rng.integers(w)), int(rng.integers(h))
        dx, dy = int(rng.integers(5, w // 3 + 6)), int(rng.integers(5, h // 3 + 6))
        gray, line = float(rng.uniform(20, 240)), int(rng.choice([-1, 2, 4]))
        shape = rng.integers(4)
        if shape == 0:
            cv2.rectangle(sheet, (x, y), (x + dx, y + dy), gray, line)
        elif shape == 1:
            turn = float(rng.uniform(0, 180))
            cv2.ellipse(sheet, (x, y), (dx // 2, dy // 2), turn, 0, 360, gray, line)
        elif shape == 2:
            corners = rng.integers(0, [w, h], (3, 2)).astype(np.int32)
            cv2.fillConvexPoly(sheet, corners, gray)
        else:
            text = "".join(rng.choice(list("ABCDEFGHKLMNPRSTUVXYZ2345789"), 6))
            scale = float(rng.uniform(0.4, 1.6))
            cv2.putText(
                sheet, text, (x - w // 4, y), cv2.FONT_HERSHEY_SIMPLEX, scale, gray, 1 + int(2 * scale)
            )
    cv2.rectangle(sheet, (1, 1), (w - 2, h - 2), float(rng.uniform(10, 80)), 3)
    return sheet.astype(np.float32)


def hang_posters(rng: Rng, wall: F32, count: int, smallest: float, largest: float, per_m: float) -> None:
    """Put `count` posters of random sizes (m) on a wall in place, later ones over earlier ones."""
    h, w = wall.shape
    for _ in range(count):
        ph, pw = (min(int(rng.uniform(smallest, largest) * per_m), n - 4) for n in (h, w))
        top, left = int(rng.integers(1, h - ph)), int(rng.integers(1, w - pw))
        wall[top : top + ph, left : left + pw] = poster_texture(rng, (ph, pw))


def wall_texture(rng: Rng, size: Size, per_m: float) -> F32:
    """Plaster or brick with pictures and notices."""
    out = rng.uniform(120, 170) + cloud_noise(rng, size, {256: 14, 64: 7, 16: 4, 4: 3})
    if rng.random() < 0.5:
        out += brick_rows(rng, size, int(0.16 * per_m), int(0.4 * per_m), 9, 14)
    draw_marks(rng, out, 12, per_m)
    hang_posters(rng, out, int(0.8 * size[0] * size[1] / per_m**2), 0.25, 0.95, per_m)
    return out


def floor_texture(rng: Rng, size: Size, per_m: float) -> F32:
    """Planks with grain."""
    out = rng.uniform(90, 130) + cloud_noise(rng, size, {256: 10, 32: 6, 8: 5, 4: 4})
    out += brick_rows(rng, size, int(0.22 * per_m), int(1.3 * per_m), 14, 18)
    draw_marks(rng, out, 15, per_m)
    return out


def ceiling_texture(rng: Rng, size: Size, per_m: float) -> F32:
    """Pale panels and lamps."""
    out = 175 + cloud_noise(rng, size, {256: 8, 32: 4, 8: 3})
    out += brick_rows(rng, size, int(0.6 * per_m), int(0.9 * per_m), 8, 30)
    draw_marks(rng, out, 8, per_m)
    hang_posters(rng, out, 12, 0.2, 0.5, per_m)
    return out


def shelf_texture(rng: Rng, size: Size, per_m: float) -> F32:
    """Boards with books and files of all widths between them."""
    out = np.full(size, 60, np.float32) + cloud_noise(rng, size, {16: 6, 4: 3})
    pitch, board = int(0.36 * per_m), max(int(0.03 * per_m), 2)
    for top in range(0, size[0], pitch):
        out[top : top + board] += 80
        foot, left = min(top + pitch, size[0]), 2
        while left < size[1] - 4:
            thick = int(rng.uniform(0.025, 0.09) * per_m)
            head = top + board + int(rng.uniform(0.02, 0.12) * per_m)
            if rng.random() < 0.85 and head < foot:
                out[head:foot, left : left + thick - 1] += rng.uniform(-20, 100)
                band = int(rng.integers(head, foot))
                out[band : band + int(0.04 * per_m), left : left + thick - 1] += rng.uniform(-40, 40)
            left += thick
    return out


def crate_texture(rng: Rng, size: Size, per_m: float) -> F32:
    """Boards with labels."""
    out = rng.uniform(80, 170) + cloud_noise(rng, size, {64: 12, 16: 6, 4: 4})
    out += brick_rows(rng, size, int(rng.uniform(0.1, 0.3) * per_m), int(0.7 * per_m), 14, 30)
    hang_posters(rng, out, max(1, int(2 * size[0] * size[1] / per_m**2)), 0.12, 0.35, per_m)
    return out
