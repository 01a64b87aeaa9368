"""What a worker process does: it opens the room once, and then draws the frames that it is given.

First every actor's light is metered, at an eighth of the size; from that the device decides how each
frame is exposed; then they are drawn, developed and encoded.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from share.lab.emulate.chunks import Picture, write_chunk
from share.lab.emulate.room_file import open_renderer
from share.lab.emulate.sensor.exposure import Shot, Shots
from share.lab.emulate.stage import Actor, Sight, Stage, T_body, smaller
from share.lab.emulate.types import Renderer
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.types import F64, I64, U8

_METER = 8  # times smaller than the picture
_METERED_NS, _METERED = 125_000_000, 50  # light is metered so often, by so many looks a job
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_DEPTH_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]


@dataclass(frozen=True, eq=False)
class Take:
    """Frames first .. last - 1 (places in the actor's `pictures`) of actor number `who`. file: the chunk
    to write; shots: how they are exposed, one a frame."""

    who: int
    first: int
    last: int
    file: Path
    shots: Shots


@dataclass(frozen=True, eq=False)
class Look:
    """Actor number `who` looks about at true times (N,)."""

    who: int
    true_ns: I64


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


def looks(who: int, actor: Actor) -> list[Look]:
    """Where to meter, so that `exposed` can say how each of the actor's frames is taken."""
    true_ns = actor.pictures.true_ns
    times = np.append(np.arange(true_ns[0], true_ns[-1], _METERED_NS), true_ns[-1])
    return [Look(who, times[k : k + _METERED]) for k in range(0, len(times), _METERED)]


def exposed(actor: Actor, looked: Sequence[Look], brightness: F64) -> Shots:
    """How each of the actor's frames is taken; brightness (N,): what `meter` found by all the looks."""
    true_ns, times = actor.pictures.true_ns, np.concatenate([look.true_ns for look in looked])
    return actor.device.shots(true_ns, np.interp(true_ns - times[0], times - times[0], brightness))


def meter(look: Look) -> F64:
    """Mean radiance of each (N,) image of cam0."""
    w = _ready()
    rig = w.stage.actors[look.who].rig
    camera, T_body_cam = smaller(rig.cam0, _METER), T_body(rig, CAM0)
    sights = w.stage.sights(look.who, look.true_ns)
    return np.array([float(w.renderer.radiance(camera, [sight.by(T_body_cam)]).mean()) for sight in sights])


def shoot(take: Take) -> None:
    """Draw the frames and write the chunk."""
    write_chunk(take.file, list(draw(take.who, slice(take.first, take.last), take.shots)))


def draw(who: int, here: slice, shots: Shots) -> Iterator[Picture]:
    """The images of some of an actor's `pictures`, frame by frame; shots: how each frame is exposed."""
    w = _ready()
    for frame in _frames(w, who, here, shots):
        yield from _developed(w, w.stage.actors[who], frame)


@dataclass(frozen=True, eq=False)
class _Frame:
    """One frame to be drawn: the sights over its exposure, and the one in the middle of it."""

    index: int
    stamp_ns: int
    shot: Shot
    exposed: list[Sight]
    middle: Sight


def _frames(w: _Worker, who: int, here: slice, series: Shots) -> Iterator[_Frame]:
    actor = w.stage.actors[who]
    index, stamps, true = (
        a[here] for a in (actor.pictures.index, actor.pictures.stamp_ns, actor.pictures.true_ns)
    )
    moved = w.stage.motion_px(who, true, series.exposure_ms)
    shots = [series[k] for k in range(len(true))]
    offsets = [actor.device.blur_offsets(shot, px) for shot, px in zip(shots, moved.tolist(), strict=True)]
    times = [t + np.rint(dt * 1e9).astype(np.int64) for t, dt in zip(true, offsets, strict=True)]
    exposed = iter(w.stage.sights(who, np.concatenate(times)))
    for k, middle in enumerate(w.stage.sights(who, true)):
        yield _Frame(int(index[k]), int(stamps[k]), shots[k], list(islice(exposed, len(times[k]))), middle)


def _developed(w: _Worker, actor: Actor, frame: _Frame) -> Iterator[Picture]:
    grays: dict[str, U8] = {}
    for number, (stream, camera) in enumerate(((CAM0, actor.rig.cam0), (CAM1, actor.rig.cam1))):
        if camera is not None:
            T_body_cam = T_body(actor.rig, stream)
            radiance = w.renderer.radiance(camera, [sight.by(T_body_cam) for sight in frame.exposed])
            grays[stream] = actor.device.develop(radiance, frame.index, number, frame.shot)
            yield _picture(stream, frame.stamp_ns, grays[stream], w.images)
    if actor.rig.depth is not None:
        exact = w.renderer.depth(actor.rig.depth, frame.middle.by(T_body(actor.rig, DEPTH)))
        measured = actor.device.depth_mm(exact, grays[CAM0], frame.index, frame.shot)
        yield _picture(DEPTH, frame.stamp_ns, measured, "depth")


def _picture(stream: str, stamp_ns: int, pixels: np.ndarray, how: str) -> Picture:
    suffix, options = {"jpeg": (".jpg", _JPEG), "png": (".png", _PNG), "depth": (".png", _DEPTH_PNG)}[how]
    height, width = pixels.shape
    return Picture(stream, stamp_ns, width, height, cv2.imencode(suffix, pixels, options)[1].tobytes())


def _ready() -> _Worker:
    assert _worker is not None, "begin() comes first"
    return _worker
