"""The plain room as a scene; it needs neither OpenGL nor a ray caster, only numpy and OpenCV."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from share.errors import UsageError
from share.geometry.camera import Camera
from share.lab.emulate.plain.render import PlainRoomRenderer as Caster
from share.lab.emulate.plain.room import make_room, room_boxes
from share.lab.emulate.types import SceneInstant
from share.lab.emulate.world.layout import Layout, Piece
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import box
from share.types import F32, F64

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
        self._room_renderers: dict[Camera, Caster] = {}

    def radiance(self, camera: Camera, instants: Sequence[SceneInstant]) -> F32:
        caster = self._room_renderer(camera)
        images = [caster.render(instant.T_world_cam)[0] for instant in instants]
        out: F32 = np.mean(images, axis=0, dtype=np.float32)
        return out

    def depth(self, camera: Camera, instant: SceneInstant) -> F32:
        return self._room_renderer(camera).render(instant.T_world_cam)[1]

    def _room_renderer(self, camera: Camera) -> Caster:
        if camera.distortion:
            raise UsageError(
                "scene 'plain' has no lens distortion; take a profile without (d435i) or another scene"
            )
        if camera not in self._room_renderers:
            self._room_renderers[camera] = Caster(self._room, camera)
        return self._room_renderers[camera]
