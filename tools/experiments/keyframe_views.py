"""What agents see at their keyframes: only those frames of a stage are drawn, as its recordings have them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from share.geometry.camera import Rig
from share.lab.emulate import drawing
from share.lab.emulate.chunks import EncodedPicture, encoded_image
from share.lab.emulate.progress import Progress
from share.lab.emulate.sensor.device import PictureTimes
from share.lab.emulate.sensor.exposure import ExposureSeries
from share.lab.emulate.stage import Actor, RoomStage
from share.runtime.pool import Pool
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.types import I64, Frame, View
from share.vision.orb import make_view

_STRIP = 12  # frames of a job


@dataclass(frozen=True, eq=False)
class Strip:
    """Pictures first .. last - 1 of actor number `who`, on a stage that has no others than keyframes. shots:
    how they are exposed, one a picture. rig: by which they are understood."""

    who: int
    first: int
    last: int
    shots: ExposureSeries
    rig: Rig


def views(
    stage: RoomStage, chosen: list[I64], images: str, workers: int, progress: Progress
) -> list[list[View]]:
    """Of each actor at the chosen (N,) of its pictures. All of its light is metered, as for a recording, so
    that the pictures are the recording's to the last bit. images: jpeg or png, by `Recipe.images`."""
    thinned = replace(stage, actors=tuple(map(_thinned, stage.actors, chosen)))
    with Pool(workers, drawing.start_worker, (thinned, images)) as pool:
        exposed = [_exposed(pool, who, actor, progress) for who, actor in enumerate(stage.actors)]
        strips = [
            Strip(who, k, min(k + _STRIP, len(at)), _of(exposed[who], at[k : k + _STRIP]), actor.rig)
            for who, (actor, at) in enumerate(zip(stage.actors, chosen, strict=True))
            for k in range(0, len(at), _STRIP)
        ]
        seen: dict[tuple[int, int], list[View]] = {}
        for strip, found in pool.run(see, strips):
            seen[strip.who, strip.first] = found
            progress("drawing keyframes", len(seen), len(strips))
    return [_of_one(seen, who) for who in range(len(chosen))]


def see(strip: Strip) -> list[View]:
    """What a worker does: draw, encode, decode, and look at it as a tracker does that knows no depths yet."""
    pictures = drawing.draw_pictures(strip.who, slice(strip.first, strip.last), strip.shots)
    frames = groupby(pictures, key=lambda picture: picture.stamp_ns)
    return [make_view(_frame(stamp_ns, of_one), strip.rig) for stamp_ns, of_one in frames]


def _of_one(seen: dict[tuple[int, int], list[View]], who: int) -> list[View]:
    return [view for key in sorted(seen) if key[0] == who for view in seen[key]]


def _frame(stamp_ns: int, pictures: Iterator[EncodedPicture]) -> Frame:
    images = {picture.stream: encoded_image(picture, "keyframe").load() for picture in pictures}
    return Frame(stamp_ns, 0, images[CAM0], images.get(CAM1), images.get(DEPTH))


def _exposed(pool: Pool, who: int, actor: Actor, progress: Progress) -> ExposureSeries:
    """Of all its pictures."""
    jobs, found = drawing.meter_jobs(who, actor), {}
    for job, brightness in pool.run(drawing.measure_brightness, jobs):
        found[int(job.true_ns[0])] = brightness
        progress(f"metering {actor.name}", len(found), len(jobs))
    return drawing.exposure_series(actor, jobs, np.concatenate([found[int(job.true_ns[0])] for job in jobs]))


def _thinned(actor: Actor, at: I64) -> Actor:
    p = actor.pictures
    return replace(actor, pictures=PictureTimes(p.index[at], p.true_ns[at], p.stamp_ns[at]))


def _of(shots: ExposureSeries, at: I64) -> ExposureSeries:
    return ExposureSeries(shots.exposure_ms[at], shots.gain[at], shots.light[at])
