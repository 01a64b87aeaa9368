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
        single samples when it looks between them, so it always has four.
        """
        if not moments:
            raise ValueError("moments: an image needs at least one")
        total = np.zeros((camera.height, camera.width), np.float32)
        spread = len(moments) >= _SIDE**2 and not camera.distortion
        for offset, moment in zip(_offsets(len(moments)), moments, strict=True):
            if spread:
                cv2.accumulate(self._stage.image(shifted(camera, offset), moment, FINER), total)
            else:
                cv2.accumulate(self._supersampled(camera, moment), total)
        total *= np.float32(1 / (STEPS * len(moments)))
        return total

    def depth(self, camera: Camera, moment: Moment) -> F32:
        """Exact depth (H, W) m, 0 where nothing is; see `Renderer`."""
        if not camera.distortion:
            return self._stage.depth(camera, moment)
        optics = _lens(camera, _DEPTH_ZOOM)
        return optics.depth(*self._stage.faces(optics.wide, moment))

    def _supersampled(self, camera: Camera, moment: Moment) -> U16:
        fine = finer(camera, _SIDE)
        if camera.distortion:
            optics: Lens = _lens(fine)
            samples = optics.image(self._stage.image(optics.wide, moment, 0.0))
        else:
            samples = self._stage.image(fine, moment, 0.0)
        out: U16 = cv2.resize(samples, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        return out


def _offsets(count: int) -> F64:
    """Where in its pixel each of `count` samples lies (count, 2) px, their mean being 0: the places of 2 x 2
    samples by turns, opposite ones after each other."""
    turns = np.array([(-0.25, -0.25), (0.25, 0.25), (0.25, -0.25), (-0.25, 0.25)])[np.arange(count) % 4]
    offsets: F64 = turns - turns.mean(axis=0)
    return offsets
