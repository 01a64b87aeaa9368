"""A plain furnished room: axis-aligned boxes, each face with its own procedural gray texture.

World frame: z up, origin in a lower corner of the room, metres. Box 0 is the room itself, seen from inside;
the others are furniture. Face 6 b + 2 k + s is the lower (s = 0) or upper (s = 1) face of box b across axis
k; its picture is one patch of the atlas. Sizes of textures are (rows, columns) in texels, `per_m` is texels
per metre; they are float32 gray levels around 0..255, not clipped: shading and clipping come last.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np

from share.types import F32, F64, U8

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


# The room.

TEXELS_PER_M = 250.0
LEVELS = 6  # of the mip pyramid: level l has 2^-l of the resolution
_PATCH_PADDING = 1 << (
    LEVELS - 1
)  # texels repeated around a patch, so that levels do not bleed into neighbours
_ATLAS_WIDTH = 4096
_AXIS_SHADE = (0.92, 1.0, 1.06)  # brightness of faces by their axis


@dataclass(frozen=True, eq=False)
class Pyramid:
    """An atlas at all LEVELS side by side. pixels: (H, W', 2) uint8, channel 1 the next coarser level at the
    same size; corners: (LEVELS, 2) float32, where (column, row) each level begins."""

    pixels: U8
    corners: F32


@dataclass(frozen=True, eq=False)
class PlainRoom:
    """boxes: (B, 2, 3) m, lower and upper corners. atlas: (H, W) uint8. origin: (6 B, 2) float32, the
    texel (column, row) of world (0, 0) in each face's picture (see `face_axes`)."""

    boxes: F64
    atlas: U8
    origin: F32

    @property
    def size(self) -> F64:
        """Return the extent of the room (3,) m."""
        size: F64 = self.boxes[0, 1]
        return size

    @cached_property
    def pyramid(self) -> Pyramid:
        """Return the atlas with its mip levels."""
        return _make_pyramid(self.atlas)


def make_room(seed: int, size: tuple[float, float, float] = (9.0, 6.0, 3.0)) -> PlainRoom:
    """Return the room of `seed`. Furniture keeps to a strip of 0.75 m along the walls, except for a column in
    the middle."""
    rng = np.random.default_rng([seed, 1])
    boxes = _all_boxes(rng, size)
    pictures = [_face_picture(rng, boxes, face) for face in range(6 * len(boxes))]
    atlas, corners = _pack_atlas(pictures)
    return PlainRoom(boxes, atlas, _face_origins(boxes, corners))


def room_boxes(seed: int, size: tuple[float, float, float]) -> F64:
    """Return `make_room(seed, size).boxes` without drawing pictures."""
    return _all_boxes(np.random.default_rng([seed, 1]), size)


def _all_boxes(rng: np.random.Generator, size: tuple[float, float, float]) -> F64:
    return np.stack([np.array([(0, 0, 0), size]), _column_box(rng, size), *_furniture_boxes(rng, size)])


def face_axes(face: int) -> tuple[int, int, int]:
    """Return (axis across the face, axis along its picture's columns, axis along its rows)."""
    return ((0, 1, 2), (1, 0, 2), (2, 0, 1))[face % 6 // 2]


def _column_box(rng: np.random.Generator, size: tuple[float, float, float]) -> F64:
    half = rng.uniform(0.15, 0.22)
    x, y = np.array(size[:2]) / 2 + rng.uniform(-0.1, 0.1, 2)
    return np.array([(x - half, y - half, 0), (x + half, y + half, size[2])])


def _furniture_boxes(rng: np.random.Generator, size: tuple[float, float, float]) -> list[F64]:
    """Return shelves, cupboards and crates along the four walls, with gaps between them."""
    out = []
    for across, along in ((0, 1), (1, 0)):
        for side in (0, 1):
            at = rng.uniform(0.8, 1.4)
            while True:
                wide, deep = rng.uniform(0.5, 1.4), rng.uniform(0.25, 0.7)
                if at + wide > size[along] - 0.8:
                    break
                lo, hi = np.zeros(3), np.zeros(3)
                lo[along], hi[along] = at, at + wide
                lo[across], hi[across] = (0, deep) if side == 0 else (size[across] - deep, size[across])
                hi[2] = rng.choice([0.45, 0.75, 1.1, 2.0])
                out.append(np.stack([lo, hi]))
                at += wide + rng.uniform(0.3, 1.5)
    return out


def _face_picture(rng: np.random.Generator, boxes: F64, face: int) -> U8:
    box, (across, along, up) = boxes[face // 6], face_axes(face)
    extent = (box[1] - box[0]) * TEXELS_PER_M
    size = (max(int(np.ceil(extent[up])), 8) + 1, max(int(np.ceil(extent[along])), 8) + 1)
    if face < 6:
        draw = wall_texture if across < 2 else (floor_texture, ceiling_texture)[face % 2]
    else:
        draw = shelf_texture if across < 2 and box[1, 2] > 1.5 and face >= 12 else crate_texture
    picture = draw(rng, size, TEXELS_PER_M) * _AXIS_SHADE[across]
    if face < 6:
        picture *= _corner_shadow(size)
    if across < 2 and (across + face) % 2 == (face < 6):
        picture = picture[:, ::-1]  # columns rise with the world axis, so flip faces seen from the other side
    out: U8 = cv2.GaussianBlur(picture.clip(4, 250), (0, 0), 0.7).astype(np.uint8)
    return out


def _corner_shadow(size: tuple[int, int]) -> F32:
    """Return darkening (H, W) towards the corners of a room."""
    fall = [1 - 0.35 * np.exp(-np.minimum(np.arange(n), n - 1 - np.arange(n)) / 60) for n in size]
    return np.outer(*fall).astype(np.float32)


def _pack_atlas(pictures: list[U8]) -> tuple[U8, list[tuple[int, int]]]:
    """Return the atlas and the (column, row) of each picture in it: shelves, tallest first."""
    corners = [(0, 0)] * len(pictures)
    x = y = height = 0
    for i in sorted(range(len(pictures)), key=lambda i: -pictures[i].shape[0]):
        h, w = (
            (n + 2 * _PATCH_PADDING + _PATCH_PADDING - 1) // _PATCH_PADDING * _PATCH_PADDING
            for n in pictures[i].shape
        )
        if x + w > _ATLAS_WIDTH:
            x, y, height = 0, y + height, 0
        corners[i], x, height = (x + _PATCH_PADDING, y + _PATCH_PADDING), x + w, max(height, h)
    atlas = np.zeros((y + height, _ATLAS_WIDTH), np.uint8)
    for (cx, cy), picture in zip(corners, pictures, strict=True):
        framed = cv2.copyMakeBorder(
            picture, _PATCH_PADDING, _PATCH_PADDING, _PATCH_PADDING, _PATCH_PADDING, cv2.BORDER_REPLICATE
        )
        atlas[cy - _PATCH_PADDING :, cx - _PATCH_PADDING :][: framed.shape[0], : framed.shape[1]] = framed
    return atlas, corners


def _face_origins(boxes: F64, corners: list[tuple[int, int]]) -> F32:
    """Return the texel of world (0, 0) of each face's axes. Rows of upright faces run down."""
    out = np.zeros((len(corners), 2), np.float32)
    for face, (cx, cy) in enumerate(corners):
        across, along, up = face_axes(face)
        lo, hi = boxes[face // 6]
        top = -lo[up] if across == 2 else hi[up]
        out[face] = cx - lo[along] * TEXELS_PER_M, cy + top * TEXELS_PER_M
    return out


def _make_pyramid(atlas: U8) -> Pyramid:
    """Return the mip levels. Pixel x of level 0 is pixel x / 2 of level 1 (pyrDown keeps even pixels)."""
    levels = [atlas]
    for _ in range(LEVELS):
        levels.append(cv2.pyrDown(levels[-1]))
    width = sum(level.shape[1] for level in levels[:-1])
    pixels = np.zeros((atlas.shape[0], width, 2), np.uint8)
    corners, x = np.zeros((LEVELS, 2), np.float32), 0
    for i, (level, coarser) in enumerate(pairwise(levels)):
        h, w = level.shape
        pixels[:h, x : x + w, 0] = level
        pixels[:h, x : x + w, 1] = cv2.pyrUp(coarser, dstsize=(w, h))
        corners[i], x = (x, 0), x + w
    return Pyramid(pixels, corners)
