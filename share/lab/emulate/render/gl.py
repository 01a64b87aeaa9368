"""The OpenGL renderer: combines passes of `GlRoom` over samples in the pixel and in time, and applies the
lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.stats import qmc

from share.geometry.camera import Camera
from share.lab.emulate.render.fisheye import FisheyeFace, fisheye_faces
from share.lab.emulate.render.gl_room import GlRoom
from share.lab.emulate.render.lens import LensResampler, make_lens
from share.lab.emulate.render.view import shifted_camera
from share.lab.emulate.types import DrawableRoom, SceneInstant
from share.types import F32, F64

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
