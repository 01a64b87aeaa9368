"""The renderer on OpenGL: samples over the pixel and over time, and the lens, over the passes of `Stage`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.stats import qmc

from share.geometry.camera import Camera
from share.lab.emulate.render.fisheye import Face, faces
from share.lab.emulate.render.lens import Lens, lens
from share.lab.emulate.render.stage import Stage
from share.lab.emulate.render.view import shifted
from share.lab.emulate.types import Moment, Room
from share.types import F32, F64

_SAMPLES = 3  # of a pixel, at least
_DEPTH_ZOOM = 3.0  # of the view in which a lens finds its triangles: fewer slivers are missed
_lens = lru_cache(maxsize=16)(lens)
_faces = lru_cache(maxsize=16)(faces)


class GlRenderer:
    """Draws one room. Made once a process; not safe for threads. Raises RenderError where it cannot."""

    def __init__(self, room: Room) -> None:
        self._stage = Stage(room)
        self.device = self._stage.device

    def radiance(self, camera: Camera, moments: Sequence[Moment]) -> F32:
        """Image (H, W) in linear gray levels; see `Renderer`.

        Samples over time and over the pixel are one sum (Cook, Porter & Carpenter 1984): every moment
        has one sample of each pixel, at another place in it, or more where there are fewer than _SAMPLES.
        """
        if not moments:
            raise ValueError("moments: an image needs at least one")
        if camera.fisheye:
            return self._by_faces(camera, moments)
        count = max(_SAMPLES, len(moments))
        optics: Lens | None = _lens(camera) if camera.distortion else None
        view = optics.wide if optics else camera
        total = np.zeros((view.height, view.width), np.float32)
        for k, place in enumerate(_places(count)):
            total += self._stage.image(shifted(view, place), moments[k * len(moments) // count])
        total /= count
        return optics.image(total) if optics else total

    def depth(self, camera: Camera, moment: Moment) -> F32:
        """Exact depth (H, W) m, 0 where nothing is; see `Renderer`."""
        if not camera.distortion:
            return self._stage.depth(camera, moment)
        if camera.fisheye:
            return self._depth_by_faces(camera, moment)
        optics = _lens(camera, _DEPTH_ZOOM)
        return optics.depth(*self._stage.faces(optics.wide, moment))

    def _by_faces(self, camera: Camera, moments: Sequence[Moment]) -> F32:
        """`radiance` of a fisheye lens. Dark where the lens shows nothing."""
        out = np.zeros((camera.height, camera.width), np.float32)
        for face in _faces(camera):
            turned = [_turned(moment, face) for moment in moments]
            image = face.lens.image(self.radiance(face.lens.wide, turned))
            out[face.shown] = image[face.shown]
        return out

    def _depth_by_faces(self, camera: Camera, moment: Moment) -> F32:
        """`depth` of a fisheye lens; 0 also of what is not ahead of it."""
        out = np.zeros((camera.height, camera.width), np.float32)
        for face in _faces(camera, _DEPTH_ZOOM):
            z = face.lens.depth(*self._stage.faces(face.lens.wide, _turned(moment, face)))
            out[face.shown] = np.maximum(z * face.axial(), 0)[face.shown]
        return out


def _turned(moment: Moment, face: Face) -> Moment:
    """What the face's own camera sees."""
    return replace(moment, T_world_cam=moment.T_world_cam @ face.T_cam_face)


@lru_cache
def _places(count: int) -> F64:
    """Where in its pixel each of `count` samples lies (count, 2) px: a row and a column for each, which edges
    along either need, as the Halton sequence (1960) orders them. It begins at the third point: so few points
    lie on no line and go back and forth, and motion in between neither shrinks nor stretches them."""
    points = qmc.Halton(2, scramble=False).fast_forward(2).random(count)
    ranks = points.argsort(axis=0).argsort(axis=0)
    out: F64 = (ranks + 0.5) / count - 0.5
    return out
