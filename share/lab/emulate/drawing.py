"""The work of a drawing process: open the room once, then draw frames as asked.

First the light of each actor is metered at an eighth of the image size; from that the device decides the
exposure of each frame; then frames are drawn, developed and encoded.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from share.lab.emulate.recordings import EncodedPicture, write_chunk
from share.lab.emulate.sensor.imager import Exposure, ExposureSeries
from share.lab.emulate.stage import Actor, ActorView, RoomStage, T_body_camera, downsized
from share.lab.emulate.types import RoomRenderer
from share.lab.emulate.world.room_files import open_renderer
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.types import F64, I64, U8

_METER_FACTOR = 8  # times smaller than the images
_METER_INTERVAL_NS = 125_000_000
_METER_BATCH = 50  # measurements a job
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_DEPTH_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]


@dataclass(frozen=True, eq=False)
class ChunkJob:
    """Frames first .. last - 1 (indices into `pictures`) of actor number `actor_index`. file: the chunk to
    write; shots: exposure of each frame."""

    actor_index: int
    first: int
    last: int
    file: Path
    shots: ExposureSeries


@dataclass(frozen=True, eq=False)
class MeterJob:
    """Meter the light of actor number `actor_index` at true times (N,)."""

    actor_index: int
    true_ns: I64


class _DrawingWorker:
    def __init__(self, stage: RoomStage, images: str) -> None:
        cv2.setNumThreads(1)
        self.stage, self.images = stage, images
        self.renderer: RoomRenderer = open_renderer(stage.room)


_worker: _DrawingWorker | None = None


def start_worker(stage: RoomStage, images: str) -> None:
    """Open the room in this worker process. images: jpeg or png."""
    global _worker
    _worker = _DrawingWorker(stage, images)


def meter_jobs(actor_index: int, actor: Actor) -> list[MeterJob]:
    """Return jobs that make the measurements for `exposure_series`."""
    true_ns = actor.pictures.true_ns
    times = np.append(np.arange(true_ns[0], true_ns[-1], _METER_INTERVAL_NS), true_ns[-1])
    return [MeterJob(actor_index, times[k : k + _METER_BATCH]) for k in range(0, len(times), _METER_BATCH)]


def exposure_series(actor: Actor, jobs: Sequence[MeterJob], brightness: F64) -> ExposureSeries:
    """Return the exposure of each of the actor's frames; brightness (N,): of all measurements of `jobs`."""
    true_ns, times = actor.pictures.true_ns, np.concatenate([job.true_ns for job in jobs])
    return actor.device.exposures(true_ns, np.interp(true_ns - times[0], times - times[0], brightness))


def measure_brightness(job: MeterJob) -> F64:
    """Return the mean radiance of each (N,) image of cam0."""
    w = _current_worker()
    rig = w.stage.actors[job.actor_index].rig
    camera, T_body_cam = downsized(rig.cam0, _METER_FACTOR), T_body_camera(rig, CAM0)
    views = w.stage.views(job.actor_index, job.true_ns)
    return np.array(
        [float(w.renderer.radiance(camera, [view.camera_view(T_body_cam)]).mean()) for view in views]
    )


def draw_chunk(job: ChunkJob) -> None:
    """Draw the frames and write the chunk."""
    write_chunk(job.file, list(draw_pictures(job.actor_index, slice(job.first, job.last), job.shots)))


def draw_pictures(actor_index: int, rows: slice, shots: ExposureSeries) -> Iterator[EncodedPicture]:
    """Yield the images of some of an actor's `pictures`, frame by frame; shots: exposure of each frame."""
    w = _current_worker()
    for frame in _frame_jobs(w, actor_index, rows, shots):
        yield from _develop_frame(w, w.stage.actors[actor_index], frame)


@dataclass(frozen=True, eq=False)
class _FrameJob:
    """One frame to draw: views over its exposure, and the view in the middle of it."""

    index: int
    stamp_ns: int
    shot: Exposure
    exposed: list[ActorView]
    middle: ActorView


def _frame_jobs(
    w: _DrawingWorker, actor_index: int, rows: slice, series: ExposureSeries
) -> Iterator[_FrameJob]:
    actor = w.stage.actors[actor_index]
    index, stamps, true = (
        a[rows] for a in (actor.pictures.index, actor.pictures.stamp_ns, actor.pictures.true_ns)
    )
    motion_px = w.stage.motion_px(actor_index, true, series.exposure_ms)
    shots = [series[k] for k in range(len(true))]
    offsets = [
        actor.device.blur_offsets(shot, px) for shot, px in zip(shots, motion_px.tolist(), strict=True)
    ]
    times = [t + np.rint(dt * 1e9).astype(np.int64) for t, dt in zip(true, offsets, strict=True)]
    exposed = iter(w.stage.views(actor_index, np.concatenate(times)))
    for k, middle in enumerate(w.stage.views(actor_index, true)):
        yield _FrameJob(int(index[k]), int(stamps[k]), shots[k], list(islice(exposed, len(times[k]))), middle)


def _develop_frame(w: _DrawingWorker, actor: Actor, frame: _FrameJob) -> Iterator[EncodedPicture]:
    grays: dict[str, U8] = {}
    for number, (stream, camera) in enumerate(((CAM0, actor.rig.cam0), (CAM1, actor.rig.cam1))):
        if camera is not None:
            T_body_cam = T_body_camera(actor.rig, stream)
            radiance = w.renderer.radiance(camera, [view.camera_view(T_body_cam) for view in frame.exposed])
            grays[stream] = actor.device.develop_image(radiance, frame.index, number, frame.shot)
            yield _encode_picture(stream, frame.stamp_ns, grays[stream], w.images)
    if actor.rig.depth is not None:
        exact = w.renderer.depth(actor.rig.depth, frame.middle.camera_view(T_body_camera(actor.rig, DEPTH)))
        measured = actor.device.depth_mm(exact, grays[CAM0], frame.index, frame.shot)
        yield _encode_picture(DEPTH, frame.stamp_ns, measured, "depth")


def _encode_picture(stream: str, stamp_ns: int, pixels: np.ndarray, kind: str) -> EncodedPicture:
    suffix, options = {"jpeg": (".jpg", _JPEG), "png": (".png", _PNG), "depth": (".png", _DEPTH_PNG)}[kind]
    height, width = pixels.shape
    return EncodedPicture(stream, stamp_ns, width, height, cv2.imencode(suffix, pixels, options)[1].tobytes())


def _current_worker() -> _DrawingWorker:
    assert _worker is not None, "begin() comes first"
    return _worker
