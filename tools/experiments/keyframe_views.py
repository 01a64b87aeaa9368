"""Views of agents at their keyframes: draw only those frames of a stage, exactly as in its recordings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from share.geometry.camera import Rig
from share.lab.emulate import drawing
from share.lab.emulate.recipe import Progress
from share.lab.emulate.recordings import EncodedPicture, encoded_image
from share.lab.emulate.sensor.device import PictureTimes
from share.lab.emulate.sensor.imager import ExposureSeries
from share.lab.emulate.stage import Actor, RoomStage
from share.runtime.pool import Pool
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.types import I64, Frame, View
from share.vision.orb import make_view

_STRIP = 12  # frames a job


@dataclass(frozen=True, eq=False)
class Strip:
    """Pictures first .. last - 1 of actor number `actor_index`, on a stage with keyframes only. shots:
    exposure of each picture. rig: for making views."""

    actor_index: int
    first: int
    last: int
    shots: ExposureSeries
    rig: Rig


def views(
    stage: RoomStage, chosen: list[I64], images: str, workers: int, progress: Progress
) -> list[list[View]]:
    """Return the views of each actor at the chosen (N,) of its pictures. The light is metered over all
    pictures, as for a recording, so that images are equal to the recording's byte by byte. images: jpeg or
    png, as in `SessionRecipe.images`."""
    thinned = replace(stage, actors=tuple(map(_thinned, stage.actors, chosen)))
    with Pool(workers, drawing.start_worker, (thinned, images)) as pool:
        exposed = [
            _exposed(pool, actor_index, actor, progress) for actor_index, actor in enumerate(stage.actors)
        ]
        strips = [
            Strip(
                actor_index,
                k,
                min(k + _STRIP, len(at)),
                _of(exposed[actor_index], at[k : k + _STRIP]),
                actor.rig,
            )
            for actor_index, (actor, at) in enumerate(zip(stage.actors, chosen, strict=True))
            for k in range(0, len(at), _STRIP)
        ]
        seen: dict[tuple[int, int], list[View]] = {}
        for strip, found in pool.run(see, strips):
            seen[strip.actor_index, strip.first] = found
            progress("drawing keyframes", len(seen), len(strips))
    return [_of_one(seen, actor_index) for actor_index in range(len(chosen))]


def see(strip: Strip) -> list[View]:
    """Draw, encode, decode, and make views as a tracker without depth estimates does, in a worker process."""
    pictures = drawing.draw_pictures(strip.actor_index, slice(strip.first, strip.last), strip.shots)
    frames = groupby(pictures, key=lambda picture: picture.stamp_ns)
    return [make_view(_frame(stamp_ns, of_one), strip.rig) for stamp_ns, of_one in frames]


def _of_one(seen: dict[tuple[int, int], list[View]], actor_index: int) -> list[View]:
    return [view for key in sorted(seen) if key[0] == actor_index for view in seen[key]]


def _frame(stamp_ns: int, pictures: Iterator[EncodedPicture]) -> Frame:
    images = {picture.stream: encoded_image(picture, "keyframe").load() for picture in pictures}
    return Frame(stamp_ns, 0, images[CAM0], images.get(CAM1), images.get(DEPTH))


def _exposed(pool: Pool, actor_index: int, actor: Actor, progress: Progress) -> ExposureSeries:
    """Return the exposures of all pictures of an actor."""
    jobs, found = drawing.meter_jobs(actor_index, actor), {}
    for job, brightness in pool.run(drawing.measure_brightness, jobs):
        found[int(job.true_ns[0])] = brightness
        progress(f"metering {actor.name}", len(found), len(jobs))
    return drawing.exposure_series(actor, jobs, np.concatenate([found[int(job.true_ns[0])] for job in jobs]))


def _thinned(actor: Actor, at: I64) -> Actor:
    p = actor.pictures
    return replace(actor, pictures=PictureTimes(p.index[at], p.true_ns[at], p.stamp_ns[at]))


def _of(shots: ExposureSeries, at: I64) -> ExposureSeries:
    return ExposureSeries(shots.exposure_ms[at], shots.gain[at], shots.light[at])
