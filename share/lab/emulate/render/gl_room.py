"""A room's OpenGL objects, and the passes over it: image, depth, and map of triangles.

Every pass has an undistorted camera and one sample a pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from share.geometry.camera import Camera
from share.geometry.se3 import inverse
from share.lab.emulate.render import context, shaders
from share.lab.emulate.render.surface import ChunkedSurface, chunked_surface
from share.lab.emulate.render.view import frustum_normals, projection_matrix
from share.lab.emulate.types import I32, DrawableRoom, Mesh, SceneInstant
from share.types import F32, F64, I64

_UNIT_LIGHT = 100.0  # in the light map
# direction and strength of the fixed shading of movers, world frame
_MOVER_LAMP = np.array([0.12, 0.08, 0.22])
# floats of each vertex attribute
_VERTEX_COLUMNS = {"position": 3, "normal": 3, "uv": 2, "layer": 1, "light_uv": 2}


class GlRoom:
    """The OpenGL objects of a room. Raises RenderError where this machine cannot draw."""

    def __init__(self, room: DrawableRoom) -> None:
        self._gl = gl = context.create_context()
        self._far_plane_m = (
            2.0 * float(np.linalg.norm(room.size)) + 10.0
        )  # far plane: from near the room to anything in it
        self._depth_program = gl.program(shaders.FACE_VERTEX, shaders.DEPTH_FRAGMENT)
        self._face_program = gl.program(shaders.FACE_VERTEX, shaders.FACE_FRAGMENT)
        self._room_program, self._mover_program = self._image_programs(room)
        self._room = self._make_piece(self._room_program, room.mesh, room.light_uv)
        self._movers = {
            name: _MovingBody([self._make_piece(self._mover_program, part) for part in parts])
            for name, parts in room.agent_parts.items()
        }
        self._textures = _textures(gl, room)
        self._targets: dict[tuple[int, int], Any] = {}
        gl.enable(gl.DEPTH_TEST)

    @property
    def device(self) -> str:
        """Return the name of the OpenGL device; other drivers give other bytes."""
        return f"{self._gl.info['GL_RENDERER']}, {self._gl.info['GL_VERSION']}"

    def image(self, camera: Camera, instant: SceneInstant) -> F32:
        """Return (H, W) gray levels, one sample a pixel: aliased on its own, see `shaders`."""
        lamp = _MOVER_LAMP @ instant.T_world_cam[:3, :3]
        with self._gl:
            target = self._cleared_target(camera)
            for piece, T, chunks in self._visible_pieces(camera, instant):
                program = self._room_program if piece is self._room else self._mover_program
                if program is self._mover_program:
                    program["lamp"] = tuple(T[:3, :3] @ lamp)
                self._draw(piece, program, camera, T, chunks)
            return _read_target(target, camera)

    def depth(self, camera: Camera, instant: SceneInstant) -> F32:
        """Return (H, W) m along the optical axis, 0 where there is nothing."""
        with self._gl:
            self._depth_program["focal"], self._depth_program["centre"] = (
                (camera.fx, camera.fy),
                (camera.cx, camera.cy),
            )
            target = self._cleared_target(camera)
            for piece, T, chunks in self._visible_pieces(camera, instant):
                piece.slopes.orphan()
                piece.slopes.write(np.pad(piece.surface.inverse_depth_slopes(chunks, T), ((0, 0), (0, 1))))
                piece.slopes.bind_to_storage_buffer(0)
                self._draw(piece, self._depth_program, camera, T, chunks)
            return _read_target(target, camera)

    def triangle_map(self, camera: Camera, instant: SceneInstant) -> tuple[I32, F64, F64]:
        """Return which triangle is seen (H, W), 0 for none; then of each triangle its slopes (T, 3), see
        `ChunkedSurface`, and corners (T, 3, 3) m in the camera frame."""
        slopes, corners, count = [np.zeros((1, 3))], [np.zeros((1, 3, 3))], 1
        with self._gl:
            target = self._cleared_target(camera)
            for piece, T, chunks in self._visible_pieces(camera, instant):
                self._face_program["first"] = float(count)
                self._draw(piece, self._face_program, camera, T, chunks)
                slopes.append(piece.surface.inverse_depth_slopes(chunks, T))
                corners.append((piece.surface.corners[chunks].reshape(-1, 3, 3) - T[:3, 3]) @ T[:3, :3])
                count += len(slopes[-1])
            triangle_ids = _read_target(target, camera).astype(np.int32)
        return triangle_ids, np.concatenate(slopes), np.concatenate(corners)

    def _visible_pieces(self, camera: Camera, instant: SceneInstant) -> Iterator[tuple[_GlPiece, F64, I64]]:
        """Yield what may be in the image, with T_piece_cam and its chunks."""
        planes = frustum_normals(camera)
        pieces = [(self._room, instant.T_world_cam)]
        for name, poses in instant.part_poses.items():
            pieces += self._movers[name].visible_parts(planes, instant.T_world_cam, poses)
        for piece, T in reversed(pieces):  # movers first: they hide the room
            chunks = piece.surface.visible_chunks(planes, T)
            if len(chunks):
                yield piece, T, chunks

    def _draw(self, piece: _GlPiece, program: Any, camera: Camera, T_piece_cam: F64, chunks: I64) -> None:
        faces = piece.surface.faces[chunks]
        piece.indices.orphan()
        piece.indices.write(faces)
        program["turn"].write(T_piece_cam[:3, :3].astype("f4").tobytes())  # column-major, so the transpose
        program["origin"] = tuple(T_piece_cam[:3, 3])
        program["projection"].write(projection_matrix(camera, self._far_plane_m).T.astype("f4").tobytes())
        piece.arrays[program].render(vertices=faces.size)

    def _cleared_target(self, camera: Camera) -> Any:
        """Return a target of one float a pixel, all 0."""
        size = camera.width, camera.height
        if size not in self._targets:
            color = self._gl.texture(size, 1, dtype="f4")
            self._targets[size] = self._gl.framebuffer([color], self._gl.depth_renderbuffer(size))
        target = self._targets[size]
        target.use()
        target.clear()
        return target

    def _image_programs(self, room: DrawableRoom) -> tuple[Any, Any]:
        """Return the programs for the room and for movers."""
        of_room = self._gl.program(shaders.ROOM_VERTEX, shaders.ROOM_FRAGMENT)
        of_room["pictures"], of_room["light_map"], of_room["gain"] = 0, 1, 255 * 255 / _UNIT_LIGHT
        of_mover = self._gl.program(shaders.MOVER_VERTEX, shaders.MOVER_FRAGMENT)
        of_mover["pictures"], of_mover["gain"], of_mover["light"] = 0, 255.0, room.mover_light
        return of_room, of_mover

    def _make_piece(self, program: Any, mesh: Mesh, light_uv: F32 | None = None) -> _GlPiece:
        return _GlPiece(self._gl, [self._depth_program, self._face_program, program], mesh, light_uv)


class _GlPiece:
    """The OpenGL buffers of a surface."""

    def __init__(self, gl: Any, programs: list[Any], mesh: Mesh, light_uv: F32 | None) -> None:
        self.surface: ChunkedSurface = chunked_surface(mesh)
        light = np.zeros((len(mesh.vertices), 2), np.float32) if light_uv is None else light_uv
        columns = (mesh.vertices, mesh.normals, mesh.uv, mesh.layer[:, None], light)
        vertices = gl.buffer(np.concatenate(columns, axis=1).astype("f4").tobytes())
        self.indices = gl.buffer(reserve=self.surface.faces.nbytes, dynamic=True)
        self.slopes = gl.buffer(reserve=self.surface.faces.nbytes // 3 * 8, dynamic=True)
        self.arrays = {program: _vertex_array(gl, program, vertices, self.indices) for program in programs}


class _MovingBody:
    """The parts of a moving body."""

    def __init__(self, parts: list[_GlPiece]) -> None:
        self._parts = parts
        spheres = [part.surface.bounding_sphere for part in parts]
        self._centres = np.array([[*centre, 1.0] for centre, _ in spheres])
        self._radii = np.array([radius for _, radius in spheres])

    def visible_parts(self, planes: F64, T_world_cam: F64, T_world_part: F64) -> list[tuple[_GlPiece, F64]]:
        """Return the parts that may be within `frustum_normals` (S, 3), with T_part_cam; T_world_part is (P,
        4, 4)."""
        centres = (T_world_part @ self._centres[:, :, None])[:, :3, 0] - T_world_cam[:3, 3]
        inside = (centres @ T_world_cam[:3, :3] @ planes.T > -self._radii[:, None]).all(axis=1)
        return [(self._parts[k], inverse(T_world_part[k]) @ T_world_cam) for k in np.flatnonzero(inside)]


def _vertex_array(gl: Any, program: Any, vertices: Any, indices: Any) -> Any:
    layout = " ".join(f"{n}f" if name in program else f"{4 * n}x" for name, n in _VERTEX_COLUMNS.items())
    names = [name for name in _VERTEX_COLUMNS if name in program]
    return gl.vertex_array(program, [(vertices, layout, *names)], indices)


def _textures(gl: Any, room: DrawableRoom) -> tuple[Any, Any]:
    """Return the pictures at unit 0, repeated and mip-mapped, trilinear (Williams 1983), and the light map at
    unit 1."""
    layers, height, width = room.pictures.shape
    pictures = gl.texture_array((width, height, layers), 1, np.ascontiguousarray(room.pictures), alignment=1)
    pictures.build_mipmaps()
    pictures.filter = (gl.LINEAR_MIPMAP_LINEAR, gl.LINEAR)
    light = gl.texture(room.light_map.shape[::-1], 1, np.ascontiguousarray(room.light_map), alignment=1)
    light.filter, light.repeat_x, light.repeat_y = (gl.LINEAR, gl.LINEAR), False, False
    pictures.use(0)
    light.use(1)
    return pictures, light


def _read_target(target: Any, camera: Camera) -> F32:
    out = np.empty((camera.height, camera.width), np.float32)
    target.read_into(out, components=1, dtype="f4", alignment=1)
    return out
