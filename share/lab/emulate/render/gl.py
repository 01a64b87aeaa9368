"""The OpenGL renderer: passes over a room's objects, combined over samples in the pixel and in time.

Every pass has an undistorted camera and one sample a pixel. Everything is drawn in the camera's frame: x
right, y down, z ahead, metres. In the shaders `origin` is the camera in the frame of what is drawn and `turn`
the rotation into the camera's frame, so that large coordinates cancel before they are rounded. Pictures are
low-passed to half a pixel (Williams 1983): an image is the mean of at least three samples, which does the
rest.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.stats import qmc

from share.geometry.camera import Camera
from share.geometry.se3 import inverse
from share.lab.emulate.render import context
from share.lab.emulate.render.lens import FisheyeFace, LensResampler, fisheye_faces, make_lens
from share.lab.emulate.render.surface import (
    ChunkedSurface,
    chunked_surface,
    frustum_normals,
    projection_matrix,
    shifted_camera,
)
from share.lab.emulate.types import I32, DrawableRoom, Mesh, SceneInstant
from share.types import F32, F64, I64

_MIP_BIAS = -1.0  # level of detail, relative to a sample as large as a pixel

_PLACE_GLSL = """
#version 430
uniform mat3 turn;
uniform vec3 origin;
uniform mat4 projection;
in vec3 position;
vec4 place() { return projection * vec4(turn * (position - origin), 1.0); }
"""

ROOM_VERTEX = f"""{_PLACE_GLSL}
in vec2 uv;
in float layer;
in vec2 light_uv;
out vec3 picture_at;
out vec2 light_at;
void main() {{ gl_Position = place(); picture_at = vec3(uv, layer); light_at = light_uv; }}
"""

MOVER_VERTEX = f"""{_PLACE_GLSL}
uniform vec3 lamp;
uniform float light;
in vec3 normal;
in vec2 uv;
in float layer;
out vec3 picture_at;
out float shade;
void main() {{
    gl_Position = place();
    picture_at = vec3(uv, layer);
    shade = light * (1.0 + dot(lamp, normal));
}}
"""

FACE_VERTEX = f"{_PLACE_GLSL}void main() {{ gl_Position = place(); }}"


# Picture times light.
ROOM_FRAGMENT = f"""
#version 430
uniform sampler2DArray pictures;
uniform sampler2D light_map;
uniform float gain;
in vec3 picture_at;
in vec2 light_at;
out float radiance;
void main() {{
    radiance = gain * texture(pictures, picture_at, {_MIP_BIAS}).r * texture(light_map, light_at).r;
}}
"""

# Picture times one light, shaded by the normal.
MOVER_FRAGMENT = f"""
#version 430
uniform sampler2DArray pictures;
uniform float gain;
in vec3 picture_at;
in float shade;
out float radiance;
void main() {{ radiance = gain * texture(pictures, picture_at, {_MIP_BIAS}).r * shade; }}
"""

# On a plane, inverse depth is affine in normalised coordinates, which is more exact than interpolated depth.
# Doubles, because on a surface seen almost edge-on the last bit of u and v is 1e-5 m.
DEPTH_FRAGMENT = """
#version 430
layout(std430, binding = 0) readonly buffer Slopes { dvec4 slopes[]; };
uniform dvec2 focal;
uniform dvec2 centre;
out float depth;
void main() {
    dvec2 uv = (dvec2(gl_FragCoord.xy) - 0.5 - centre) / focal;
    depth = float(1.0 / dot(slopes[gl_PrimitiveID].xyz, dvec3(uv, 1.0)));
}
"""

# Triangle numbers as floats: exact below 2^24.
FACE_FRAGMENT = """
#version 430
uniform float first;
out float face;
void main() { face = first + float(gl_PrimitiveID); }
"""


_UNIT_LIGHT = 100.0  # in the light map
# images kept: those of a stereo camera that stands, with its samples of a pixel
_RECENT = 8
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
        self._depth_program = gl.program(FACE_VERTEX, DEPTH_FRAGMENT)
        self._face_program = gl.program(FACE_VERTEX, FACE_FRAGMENT)
        self._room_program, self._mover_program = self._image_programs(room)
        self._room = self._make_piece(self._room_program, room.mesh, room.light_uv)
        self._movers = {
            name: _MovingBody([self._make_piece(self._mover_program, part) for part in parts])
            for name, parts in room.agent_parts.items()
        }
        self._textures = _textures(gl, room)
        self._targets: dict[tuple[int, int], Any] = {}
        self._recent = OrderedDict[tuple[Any, ...], F32]()  # images by all that OpenGL is given for them
        gl.enable(gl.DEPTH_TEST)

    @property
    def device(self) -> str:
        """Return the name of the OpenGL device; other drivers give other bytes."""
        return f"{self._gl.info['GL_RENDERER']}, {self._gl.info['GL_VERSION']}"

    def image(self, camera: Camera, instant: SceneInstant) -> F32:
        """Return (H, W) gray levels, one sample a pixel: aliased on its own, see above. Read-only."""
        views = list(self._visible_pieces(camera, instant))
        to_lamp = _MOVER_LAMP @ instant.T_world_cam[:3, :3]
        lamps = [None if piece is self._room else (T[:3, :3] @ to_lamp).astype("f4") for piece, T, _ in views]
        key = camera, *(_drawn_bytes(*view, lamp) for view, lamp in zip(views, lamps, strict=True))
        if key in self._recent:
            self._recent.move_to_end(key)
            return self._recent[key]
        with self._gl:
            target = self._cleared_target(camera)
            for (piece, T, chunks), lamp in zip(views, lamps, strict=True):
                program = self._room_program if lamp is None else self._mover_program
                if lamp is not None:
                    program["lamp"] = tuple(lamp.tolist())
                self._draw(piece, program, camera, T, chunks)
            image = _read_target(target, camera)
        image.flags.writeable = False
        self._recent[key] = image
        if len(self._recent) > _RECENT:
            self._recent.popitem(last=False)
        return image

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
        of_room = self._gl.program(ROOM_VERTEX, ROOM_FRAGMENT)
        of_room["pictures"], of_room["light_map"], of_room["gain"] = 0, 1, 255 * 255 / _UNIT_LIGHT
        of_mover = self._gl.program(MOVER_VERTEX, MOVER_FRAGMENT)
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


def _drawn_bytes(piece: _GlPiece, T_piece_cam: F64, chunks: I64, lamp: F32 | None) -> tuple[Any, ...]:
    """Return what OpenGL is given to draw a piece: the same bytes draw the same pixels."""
    place = T_piece_cam[:3].astype("f4").tobytes()
    return id(piece), place, chunks.tobytes(), None if lamp is None else lamp.tobytes()


def _read_target(target: Any, camera: Camera) -> F32:
    out = np.empty((camera.height, camera.width), np.float32)
    target.read_into(out, components=1, dtype="f4", alignment=1)
    return out


_MIN_SAMPLES = 3  # of a pixel
# magnification of the view in which a lens finds its triangles, so that fewer slivers are missed
_DEPTH_ZOOM = 3.0
_cached_lens = lru_cache(maxsize=16)(make_lens)
_cached_faces = lru_cache(maxsize=16)(fisheye_faces)


class GlRenderer:
    """Draws one room. Created once a process; not thread-safe. Raises RenderError where this machine cannot
    draw."""

    def __init__(self, room: DrawableRoom) -> None:
        self._stage = GlRoom(room)
        self.device = self._stage.device

    def radiance(self, camera: Camera, instants: Sequence[SceneInstant]) -> F32:
        """Return an image (H, W) in linear gray levels; see `RoomRenderer`.

        Samples over time and over the pixel are one sum (Cook, Porter & Carpenter 1984): each instant has one
        sample of each pixel, at another place in it, or more if there are fewer than _MIN_SAMPLES instants.
        """
        if not instants:
            raise ValueError("instants: an image needs at least one")
        if camera.is_fisheye:
            return self._fisheye_radiance(camera, instants)
        count = max(_MIN_SAMPLES, len(instants))
        optics: LensResampler | None = _cached_lens(camera) if camera.distortion else None
        view = optics.wide_camera if optics else camera
        total = np.zeros((view.height, view.width), np.float32)
        for k, offset in enumerate(_sample_offsets(count)):
            total += self._stage.image(shifted_camera(view, offset), instants[k * len(instants) // count])
        total /= count
        return optics.image(total) if optics else total

    def depth(self, camera: Camera, instant: SceneInstant) -> F32:
        """Return the exact depth (H, W) m, 0 where there is nothing; see `RoomRenderer`."""
        if not camera.distortion:
            return self._stage.depth(camera, instant)
        if camera.is_fisheye:
            return self._fisheye_depth(camera, instant)
        optics = _cached_lens(camera, _DEPTH_ZOOM)
        return optics.depth(*self._stage.triangle_map(optics.wide_camera, instant))

    def _fisheye_radiance(self, camera: Camera, instants: Sequence[SceneInstant]) -> F32:
        """Return `radiance` of a fisheye lens, 0 where the lens shows nothing."""
        out = np.zeros((camera.height, camera.width), np.float32)
        for face in _cached_faces(camera):
            face_instants = [_face_instant(moment, face) for moment in instants]
            image = face.lens.image(self.radiance(face.lens.wide_camera, face_instants))
            out[face.pixel_mask] = image[face.pixel_mask]
        return out

    def _fisheye_depth(self, camera: Camera, instant: SceneInstant) -> F32:
        """Return `depth` of a fisheye lens, 0 also behind the camera."""
        out = np.zeros((camera.height, camera.width), np.float32)
        for face in _cached_faces(camera, _DEPTH_ZOOM):
            z = face.lens.depth(
                *self._stage.triangle_map(face.lens.wide_camera, _face_instant(instant, face))
            )
            out[face.pixel_mask] = np.maximum(z * face.axis_depth_ratio(), 0)[face.pixel_mask]
        return out


def _face_instant(instant: SceneInstant, face: FisheyeFace) -> SceneInstant:
    """Return the instant as the face's camera sees it."""
    return replace(instant, T_world_cam=instant.T_world_cam @ face.T_cam_face)


@lru_cache
def _sample_offsets(count: int) -> F64:
    """Return the place (count, 2) px in its pixel of each of `count` samples. Rows and columns follow the
    Halton sequence (1960) from its third point on: so few points are on no line and go back and forth, so
    that motion between them neither shrinks nor stretches them."""
    points = qmc.Halton(2, scramble=False).fast_forward(2).random(count)
    ranks = points.argsort(axis=0).argsort(axis=0)
    out: F64 = (ranks + 0.5) / count - 0.5
    return out
