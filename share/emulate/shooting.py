"""What a worker process does: it opens the room once, and then draws the frames that it is given.

First every actor's frames are metered, at an eighth of the size; from that the device decides how each
is exposed; then they are drawn, developed and encoded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from share.core.measurement import CAM0, CAM1, DEPTH
from share.emulate.chunks import Picture, write_chunk
from share.emulate.room_file import open_renderer
from share.emulate.sensor.exposure import Shots
from share.emulate.stage import Stage, smaller
from share.emulate.types import Renderer
from share.types import F64, U8

_METER = 8  # times smaller than the picture
_STILL = np.zeros(1)
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_DEPTH_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]


@dataclass(frozen=True, eq=False)
class Take:
    """Frames first .. last - 1 (places in the actor's `pictures`) of actor number `who`. file: the chunk
    to write; shots: how they are exposed, one a frame. Both None where they are only metered."""

    who: int
    first: int
    last: int
    file: Path | None = None
    shots: Shots | None = None


class _Worker:
    def __init__(self, stage: Stage, images: str) -> None:
        cv2.setNumThreads(1)
        self.stage, self.images = stage, images
        self.renderer: Renderer = open_renderer(stage.room)


_worker: _Worker | None = None


def begin(stage: Stage, images: str) -> None:
    """Called once in each worker process. images: jpeg or png."""
    global _worker  # a process has one
    _worker = _Worker(stage, images)


def meter(take: Take) -> F64:
    """Mean radiance of each frame of cam0."""
    w = _ready()
    actor = w.stage.actors[take.who]
    camera = smaller(actor.rig.cam0, _METER)
    times = actor.pictures.true_ns[take.first : take.last].tolist()
    moments = (w.stage.moments(take.who, time, _STILL) for time in times)
    return np.array([float(w.renderer.radiance(camera, moment).mean()) for moment in moments])


def shoot(take: Take) -> int:
    """Draw the frames and write the chunk. How many bytes it has."""
    assert take.file is not None
    pictures = [picture for k in range(take.first, take.last) for picture in _frame(_ready(), take, k)]
    write_chunk(take.file, pictures)
    return sum(len(picture.data) for picture in pictures)


def _frame(w: _Worker, take: Take, k: int) -> Iterator[Picture]:
    assert take.shots is not None
    actor, shot = w.stage.actors[take.who], take.shots[k - take.first]
    frame, time = int(actor.pictures.index[k]), int(actor.pictures.true_ns[k])
    stamp = int(actor.pictures.stamp_ns[k])
    offsets = actor.device.blur_offsets(shot, w.stage.motion_px(take.who, time, shot))
    grays: dict[str, U8] = {}
    for number, (stream, camera) in enumerate(((CAM0, actor.rig.cam0), (CAM1, actor.rig.cam1))):
        if camera is not None:
            radiance = w.renderer.radiance(camera, w.stage.moments(take.who, time, offsets, stream))
            grays[stream] = actor.device.develop(radiance, frame, number, shot)
            yield _picture(stream, stamp, grays[stream], w.images)
    if actor.rig.depth is not None:
        (moment,) = w.stage.moments(take.who, time, _STILL, DEPTH)
        exact = w.renderer.depth(actor.rig.depth, moment)
        yield _picture(DEPTH, stamp, actor.device.depth_mm(exact, grays[CAM0], frame, shot), "depth")


def _picture(stream: str, stamp_ns: int, pixels: np.ndarray, how: str) -> Picture:
    suffix, options = {"jpeg": (".jpg", _JPEG), "png": (".png", _PNG), "depth": (".png", _DEPTH_PNG)}[how]
    height, width = pixels.shape
    return Picture(stream, stamp_ns, width, height, cv2.imencode(suffix, pixels, options)[1].tobytes())


def _ready() -> _Worker:
    assert _worker is not None, "begin() comes first"
    return _worker
