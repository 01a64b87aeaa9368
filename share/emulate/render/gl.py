"""A room drawn by OpenGL: picture times baked light, 2 x 2 samples a pixel; depth in a pass of its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np

from share.emulate.render import context, shaders
from share.emulate.render.surface import Surface, projection, upload
from share.emulate.types import Moment, Room
from share.geometry.camera import Camera
from share.geometry.se3 import inverse
from share.types import F32, F64

_SAMPLES = 2  # a side of a pixel
_STEPS = 64.0  # stored steps in a gray level: 16 bits hold up to 1023 gray levels
_LAMP = np.array([0.12, 0.08, 0.22])  # direction and strength of the movers' fixed shading, world frame


class GlRenderer:
    """Draws one room. Made once a process; not safe for threads. Raises RenderError where it cannot."""

    def __init__(self, room: Room) -> None:
        self._gl = gl = context.create()
        self._far = 2.0 * float(np.linalg.norm(room.size)) + 10.0
        self._light = room.mover_light
        self._room_program = gl.program(shaders.ROOM_VERTEX, shaders.ROOM_FRAGMENT)
        self._mover_program = gl.program(shaders.MOVER_VERTEX, shaders.MOVER_FRAGMENT)
        self._depth_program = gl.program(shaders.DEPTH_VERTEX, shaders.DEPTH_FRAGMENT)
        self._room = self._body(upload(gl, room.mesh, room.light_uv), self._room_program)
        self._movers = {
            name: [self._body(upload(gl, part), self._mover_program) for part in parts]
            for name, parts in room.movers.items()
        }
        self._planes = gl.buffer(reserve=16 * self._most_faces())
        self._bind_pictures(room)
        self._targets: dict[tuple[int, int, str], Any] = {}
        gl.enable(gl.DEPTH_TEST)

    def radiance(self, camera: Camera, moments: Sequence[Moment]) -> F32:
        """Image (H, W) in linear gray levels; see `Renderer`."""
        if not moments:
            raise ValueError("moments: an image needs at least one")
        if camera.distortion:
            raise ValueError("camera: lens distortion is not drawn yet")
        total = self._sampled(camera, moments[0])
        for moment in moments[1:]:
            total += self._sampled(camera, moment)
        total /= len(moments)
        return total

    def depth(self, camera: Camera, moment: Moment) -> F32:
        """Exact depth (H, W) m, 0 where nothing is; see `Renderer`."""
        target = self._target(camera.width, camera.height, "f4")
        program = self._depth_program
        program["focal"], program["centre"] = (camera.fx, camera.fy), (camera.cx, camera.cy)
        for body, T in self._bodies(moment):
            self._draw(body.depth, program, body.surface, camera, T, with_planes=True)
        return np.frombuffer(target.read(components=1, dtype="f4"), np.float32).reshape(
            camera.height, camera.width
        )

    def _sampled(self, camera: Camera, moment: Moment) -> F32:
        fine = scaled(camera, _SAMPLES)
        target = self._target(fine.width, fine.height, "nu2")
        for body, T in self._bodies(moment):
            program = body.program
            if program is self._mover_program:
                program["lamp"] = tuple(_LAMP @ (moment.T_world_cam[:3, :3] @ T[:3, :3].T))
            self._draw(body.image, program, body.surface, fine, T)
        raw = np.frombuffer(target.read(components=1, dtype="nu2", alignment=1), np.uint16)
        pixels = cv2.resize(
            raw.reshape(fine.height, fine.width).astype(np.float32),
            (camera.width, camera.height),
            interpolation=cv2.INTER_AREA,
        )
        pixels /= _STEPS
        return pixels

    def _draw(
        self, array: Any, program: Any, surface: Surface, camera: Camera, T: F64, with_planes: bool = False
    ) -> None:
        chunks = surface.visible(camera, T)
        if not len(chunks):
            return
        faces = surface.faces[chunks]
        surface.indices.orphan()
        surface.indices.write(faces)
        if with_planes:
            self._planes.orphan()
            self._planes.write(surface.planes_seen(chunks, T))
            self._planes.bind_to_storage_buffer(0)
        program["turn"].write(T[:3, :3].astype("f4").tobytes())  # transposed into columns: cam from surface
        program["origin"] = tuple(T[:3, 3])
        program["projection"].write(projection(camera, self._far).T.astype("f4").tobytes())
        array.render(vertices=faces.size)

    def _bodies(self, moment: Moment) -> Iterator[tuple[_Body, F64]]:
        """All that may be seen, with T_body_cam; movers first, for they are near."""
        for name, poses in moment.movers.items():
            for body, T_world_part in zip(self._movers[name], poses, strict=True):
                yield body, inverse(T_world_part) @ moment.T_world_cam
        yield self._room, moment.T_world_cam

    def _body(self, surface: Surface, program: Any) -> _Body:
        return _Body(self._gl, surface, program, self._depth_program)

    def _most_faces(self) -> int:
        bodies = [self._room, *(part for parts in self._movers.values() for part in parts)]
        return max(body.surface.faces.shape[0] * body.surface.faces.shape[1] for body in bodies)

    def _bind_pictures(self, room: Room) -> None:
        gl = self._gl
        layers, height, width = room.pictures.shape
        pictures = gl.texture_array((width, height, layers), 1, room.pictures.tobytes(), alignment=1)
        pictures.build_mipmaps()
        pictures.filter = (gl.LINEAR_MIPMAP_LINEAR, gl.LINEAR)
        light = gl.texture(room.light_map.shape[::-1], 1, room.light_map.tobytes(), alignment=1)
        light.filter, light.repeat_x, light.repeat_y = (gl.LINEAR, gl.LINEAR), False, False
        pictures.use(0)
        light.use(1)
        self._textures = pictures, light
        for program in (self._room_program, self._mover_program):
            program["pictures"], program["lod_bias"] = 0, 0.0
        self._room_program["light_map"] = 1
        full = 255 * _STEPS / 65535
        self._room_program["gain"] = full * 255 / 100
        self._mover_program["gain"], self._mover_program["light"] = full, self._light

    def _target(self, width: int, height: int, dtype: str) -> Any:
        key = width, height, dtype
        if key not in self._targets:
            gl = self._gl
            self._targets[key] = gl.framebuffer(
                [gl.texture((width, height), 1, dtype=dtype)], gl.depth_renderbuffer((width, height))
            )
        target = self._targets[key]
        target.use()
        target.clear()
        return target


class _Body:
    """A surface with its way into each pass."""

    def __init__(self, gl: Any, surface: Surface, program: Any, depth_program: Any) -> None:
        self.surface, self.program = surface, program
        self.image = _array(gl, program, surface)
        self.depth = _array(gl, depth_program, surface)


_COLUMNS = {"position": 3, "normal": 3, "uv": 2, "layer": 1, "light_uv": 2}


def _array(gl: Any, program: Any, surface: Surface) -> Any:
    layout = " ".join(f"{n}f" if name in program else f"{4 * n}x" for name, n in _COLUMNS.items())
    names = [name for name in _COLUMNS if name in program]
    return gl.vertex_array(program, [(surface.vertices, layout, *names)], surface.indices)


def scaled(camera: Camera, n: int) -> Camera:
    """The same view with n x n pixels for each."""
    return Camera(
        camera.width * n,
        camera.height * n,
        camera.fx * n,
        camera.fy * n,
        (camera.cx + 0.5) * n - 0.5,
        (camera.cy + 0.5) * n - 0.5,
    )
