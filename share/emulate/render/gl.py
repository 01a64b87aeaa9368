"""The renderer on OpenGL: samples, filters and the lens, over the passes of `Stage`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np

from share.emulate.render.lens import Lens, lens
from share.emulate.render.stage import FINER, STEPS, Stage
from share.emulate.render.view import U16, finer, shifted
from share.emulate.types import Moment, Room
from share.geometry.camera import Camera
from share.types import F32, F64

_SIDE = 2  # samples a side of a pixel
_DEPTH_ZOOM = 3.0  # of the view in which a lens finds its triangles: fewer slivers are missed
_lens = lru_cache(maxsize=16)(lens)


class GlRenderer:
    """Draws one room. Made once a process; not safe for threads. Raises RenderError where it cannot."""

    def __init__(self, room: Room) -> None:
        self._stage = Stage(room)
        self.device = self._stage.device

    def radiance(self, camera: Camera, moments: Sequence[Moment]) -> F32:
        """Image (H, W) in linear gray levels; see `Renderer`.

        A moment has 2 x 2 samples a pixel. Of four moments or more each has one of these only: samples
        over time and over the pixel are one sum (Cook, Porter & Carpenter 1984). A lens would blur
        single samples when it looks between them, so with one they are always four.
        """
        if not moments:
            raise ValueError("moments: an image needs at least one")
        fine = finer(camera, _SIDE)
        if camera.distortion:
            optics: Lens = _lens(fine)
            samples = optics.image(self._sum([(optics.wide, 0.0)] * len(moments), moments))
        elif len(moments) < _SIDE**2:
            samples = self._sum([(fine, 0.0)] * len(moments), moments)
        else:
            places = [(shifted(camera, offset), FINER) for offset in _offsets(len(moments))]
            samples = self._sum(places, moments)
        total = cv2.resize(samples, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        out: F32 = np.multiply(total, np.float32(1 / (STEPS * len(moments))), dtype=np.float32)
        return out

    def depth(self, camera: Camera, moment: Moment) -> F32:
        """Exact depth (H, W) m, 0 where nothing is; see `Renderer`."""
        if not camera.distortion:
            return self._stage.depth(camera, moment)
        optics = _lens(camera, _DEPTH_ZOOM)
        return optics.depth(*self._stage.faces(optics.wide, moment))

    def _sum(self, views: Sequence[tuple[Camera, float]], moments: Sequence[Moment]) -> U16 | F32:
        """All moments, each by its camera and level of detail, added up."""
        images = (self._stage.image(c, m, lod) for (c, lod), m in zip(views, moments, strict=True))
        first = next(images)
        if len(moments) == 1:
            return first
        total: F32 = first.astype(np.float32)
        for image in images:
            cv2.accumulate(image, total)
        return total


def _offsets(count: int) -> F64:
    """Where in its pixel each of `count` samples lies (count, 2) px, their mean being 0: the places of 2 x 2
    samples by turns, opposite ones after each other."""
    turns = np.array([(-0.25, -0.25), (0.25, 0.25), (0.25, -0.25), (-0.25, 0.25)])[np.arange(count) % 4]
    offsets: F64 = turns - turns.mean(axis=0)
    return offsets
