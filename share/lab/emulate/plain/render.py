"""The plain room as a scene that needs only numpy and OpenCV: a ray is cast through every pixel centre.

All in inverse depth q = 1/z: where a ray r (world frame, camera z = 1) from c meets the plane x_k = p, q =
r_k / (p - c_k), a multiple of an image that is affine in the pixel. A box is the q-interval between its exit
and entry planes (the slab method of Kay & Kajiya 1986). Textures are mip-mapped, trilinear (Williams 1983):
the room's pyramid holds two levels in a pixel, so one remap fetches both.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from share.errors import UsageError
from share.geometry.camera import Camera
from share.geometry.se3 import inverse, transform
from share.lab.emulate.plain.room import LEVELS, TEXELS_PER_M, PlainRoom, make_room, room_boxes
from share.lab.emulate.types import SceneInstant
from share.lab.emulate.world.layout import Layout, Piece
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import box
from share.types import F32, F64, U8

_MIN_DEPTH_M = 0.05  # least depth
_ANISOTROPY = 0.6  # blur on slanted faces: 0 by the short side of a pixel's footprint, 1 by the long side
_MAX_FACES = 256  # a face index is a byte


class PlainRoomRenderer:
    """Draws one room for one undistorted camera. Not thread-safe: it reuses its buffers."""

    def __init__(self, room: PlainRoom, camera: Camera) -> None:
        if camera.distortion:
            raise ValueError("camera: the plain renderer has no lens distortion")
        if len(room.origin) > _MAX_FACES:
            raise ValueError(f"room: {len(room.origin)} faces, at most {_MAX_FACES}")
        self._room, self._camera = room, camera
        self._pyramid = room.pyramid.pixels
        self._corner, self._origin = _lookup_table(room.pyramid.corners), _lookup_table(room.origin)
        shape = (camera.height, camera.width)
        self._q, self._face = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)

    def render(self, T_world_cam: F64) -> tuple[U8, F32]:
        """Return image (H, W) uint8 and depth (H, W) float32 m along the optical axis; the camera must be
        inside the room and outside all boxes."""
        centre = T_world_cam[:3, 3]
        rays = self._rays(T_world_cam[:3, :3])
        self._cast_room(rays, centre)
        for b in range(1, len(self._room.boxes)):
            window = self._window(self._room.boxes[b], T_world_cam)
            if window is not None:
                self._cast_box(b, [r[window] for r in rays], centre, window)
        depth: F32 = np.reciprocal(self._q)
        return self._texture(rays, depth, centre), depth

    def _rays(self, R: F64) -> list[F32]:
        c = self._camera
        u = (np.arange(c.width) - c.cx) / c.fx
        v = (np.arange(c.height) - c.cy) / c.fy
        return [
            np.add.outer((R[k, 1] * v + R[k, 2]).astype(np.float32), (R[k, 0] * u).astype(np.float32))
            for k in range(3)
        ]

    def _cast_room(self, rays: list[F32], centre: F64) -> None:
        """Draw the room: from inside, the nearest of the six planes ahead is visible."""
        slopes = 1 / (self._room.boxes[0] - centre)
        self._q.fill(0)
        for k, ray in enumerate(rays):
            for side in (0, 1):
                _update_nearest(self._q, self._face, ray * np.float32(slopes[side, k]), 2 * k + side)

    def _cast_box(self, b: int, rays: list[F32], centre: F64, window: tuple[slice, slice]) -> None:
        box = self._room.boxes[b]
        q, face = self._q[window], self._face[window]
        entry = np.full(q.shape, np.inf, np.float32)
        entered = np.zeros(q.shape, np.uint8)
        behind = q  # a hit must lie before everything drawn, and before the ray leaves the box
        for k, ray in enumerate(rays):
            slopes = (1 / (box[:, k] - centre[k])).astype(np.float32)
            near = 0 if centre[k] < box[0, k] else 1 if centre[k] > box[1, k] else None
            if near is None:
                behind = np.maximum(behind, np.maximum(ray * slopes[0], ray * slopes[1]))
                continue
            plane = ray * slopes[near]
            closer = plane < entry
            np.copyto(entry, plane, where=closer)
            np.copyto(entered, np.uint8(6 * b + 2 * k + near), where=closer)
            behind = np.maximum(behind, ray * slopes[1 - near])
        hit = entry > behind
        np.copyto(q, entry, where=hit)
        np.copyto(face, entered, where=hit)

    def _window(self, box: F64, T_world_cam: F64) -> tuple[slice, slice] | None:
        """Return the part of the image that may show the box, or None."""
        c = self._camera
        corners = np.array(
            [[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        )
        corners_in_camera = transform(inverse(T_world_cam), corners)
        if (corners_in_camera[:, 2] < _MIN_DEPTH_M).all():
            return None
        if (corners_in_camera[:, 2] < _MIN_DEPTH_M).any():
            return slice(0, c.height), slice(0, c.width)
        px = c.project(corners_in_camera)
        (left, top), (right, bottom) = np.floor(px.min(0)).astype(int), np.ceil(px.max(0)).astype(int) + 1
        rows, columns = slice(max(top, 0), min(bottom, c.height)), slice(max(left, 0), min(right, c.width))
        return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None

    def _texture(self, rays: list[F32], depth: F32, centre: F64) -> U8:
        hit = [ray * depth + np.float32(x) for ray, x in zip(rays, centre, strict=True)]
        axis = cv2.LUT(self._face, _FACE_AXIS)
        column, row = hit[0], -hit[2]
        np.copyto(column, hit[1], where=axis == 0)
        np.copyto(row, hit[1], where=axis == 2)
        level = self._level(depth, centre)
        whole = level.astype(np.uint8)
        shrink = cv2.LUT(whole, _LEVEL_SCALE)
        for k, at in enumerate((column, row)):
            at *= np.float32(TEXELS_PER_M)
            at += cv2.LUT(self._face, self._origin[k])
            at *= shrink
            at += cv2.LUT(whole, self._corner[k])
        fine, coarse = cv2.split(cv2.remap(self._pyramid, column, row, cv2.INTER_LINEAR))
        level -= whole
        out: U8 = cv2.blendLinear(fine, coarse, 1 - level, level)
        return out

    def _level(self, depth: F32, centre: F64) -> F32:
        """Return log2 of a pixel's footprint in texels: z / f by z^2 / (f d) on a plane at distance d."""
        room = self._room
        away = np.abs(room.boxes.swapaxes(1, 2) - centre[:, None]).reshape(-1).clip(_MIN_DEPTH_M)
        scale = np.log2(TEXELS_PER_M / self._camera.fx) - _ANISOTROPY * np.log2(away)
        level = np.log2(depth)
        level *= np.float32(1 + _ANISOTROPY)
        level += cv2.LUT(self._face, _lookup_table(scale[:, None].astype(np.float32))[0])
        return np.clip(level, 0, LEVELS - 1.001, out=level)


def _update_nearest(q: F32, face: U8, candidate: F32, name: int) -> None:
    larger = candidate > q
    np.copyto(q, candidate, where=larger)
    np.copyto(face, np.uint8(name), where=larger)


def _lookup_table(values: F32) -> F32:
    """Return the columns of (N, C) as lookup tables by a byte: (C, 256)."""
    out = np.zeros((values.shape[1], 256), np.float32)
    out[:, : len(values)] = values.T
    return out


_FACE_AXIS = (np.arange(256) % 6 // 2).astype(np.uint8)
_LEVEL_SCALE = (0.5 ** np.arange(256)).astype(np.float32)


DEFAULT_SIZE = (9.0, 6.0, 3.0)
_WALL_M = 0.1  # thickness, outside
_MIN_SIZE, _MAX_SIZE = (5.0, 4.0, 2.2), (12.0, 9.0, 4.0)  # that its atlas holds


def plain_layout(seed: int, size: tuple[float, float, float] | None = None) -> Layout:
    """Return the layout of the plain room. Raises UsageError for an unsupported size."""
    size = size or DEFAULT_SIZE
    if not all(a <= x <= b for a, x, b in zip(_MIN_SIZE, size, _MAX_SIZE, strict=True)):
        low, high = (" x ".join(f"{x:g}" for x in s) for s in (_MIN_SIZE, _MAX_SIZE))
        raise UsageError(f"the plain room can be {low} to {high} m")
    boxes = room_boxes(seed, size)
    skin = Material("plaster")  # not drawn: the room has its own pictures
    walls = [
        Piece(f"wall {k}", box(corners[0], corners[1], skin))
        for k, corners in enumerate(_wall_boxes(boxes[0]))
    ]
    furniture = [Piece(f"box {k}", box(corners[0], corners[1], skin)) for k, corners in enumerate(boxes[1:])]
    return Layout("plain", seed, size, tuple(walls), tuple(furniture), lights=())


def _wall_boxes(room: F64) -> list[F64]:
    """Return boxes (2, 3) around the room."""
    out = []
    for axis in range(3):
        for side in (0, 1):
            wall = room + np.array([[-_WALL_M], [_WALL_M]])
            wall[1 - side, axis] = room[side, axis]
            out.append(wall)
    return out


class PlainRenderer:
    """A `share.lab.emulate.types.RoomRenderer`. It draws neither other agents nor lens distortion."""

    def __init__(self, seed: int, size: tuple[float, float, float]) -> None:
        self._room = make_room(seed, size)
        self._room_renderers: dict[Camera, PlainRoomRenderer] = {}

    def radiance(self, camera: Camera, instants: Sequence[SceneInstant]) -> F32:
        caster = self._room_renderer(camera)
        images = [caster.render(instant.T_world_cam)[0] for instant in instants]
        out: F32 = np.mean(images, axis=0, dtype=np.float32)
        return out

    def depth(self, camera: Camera, instant: SceneInstant) -> F32:
        return self._room_renderer(camera).render(instant.T_world_cam)[1]

    def _room_renderer(self, camera: Camera) -> PlainRoomRenderer:
        if camera not in self._room_renderers:
            self._room_renderers[camera] = PlainRoomRenderer(self._room, camera)
        return self._room_renderers[camera]
