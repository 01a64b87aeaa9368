"""Makes a session folder: session.yaml, plan.png, NAME.mcap and truth/NAME.tum per agent.

recipe -> stage (nothing is written) -> how frames are exposed -> chunks of frames -> recordings, truth
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np

from share import __version__
from share.errors import ShareError
from share.files.arrays import read_array
from share.files.writing import atomic_write, writable_dir, writing, xdg_folder
from share.lab.calibrate.target import T_WORLD_TARGET, TARGET, to_plain
from share.lab.emulate import shooting
from share.lab.emulate.asl import check_asl, to_asl
from share.lab.emulate.growth import Growth
from share.lab.emulate.plan_picture import draw_plan
from share.lab.emulate.preparation import Prepared, keep_room, prepare
from share.lab.emulate.progress import Progress, silent
from share.lab.emulate.recipe import Recipe
from share.lab.emulate.sensor.exposure import Shots
from share.lab.emulate.shooting import Take
from share.lab.emulate.stage import Actor, Stage
from share.lab.emulate.takes import write_recording, write_truth
from share.lab.emulate.types import START_NS
from share.recordings.calibration import to_kalibr
from share.recordings.session import SCHEMA, SESSION
from share.runtime.pool import Pool
from share.types import F64

PLAN = "plan.png"
_FRAMES = 24  # of a chunk: what a break costs a process
_BYTES = {"jpeg": 130_000, "png": 330_000}  # of an image, about; to see beforehand whether the disk will do


def make_session(
    recipe: Recipe, out: Path, workers: int = 2, progress: Progress = silent, asl: bool = False
) -> Path:
    """Make a session in the new folder `out` with `workers` processes; with `asl`, an EuRoC/ASL folder
    NAME/mav0 of each agent instead. What a break leaves is used by the next attempt at the same recipe.

    Raises UsageError where `out` exists, or for what cannot be made; ShareError where the disk is full.
    """
    growth = Growth(out, recipe.digest)
    growth.check_new()
    prepared = prepare(recipe, growth.room, progress)
    if asl:
        check_asl(prepared.stage)
    with growth, writing(out):
        _check_space(growth, prepared.stage, recipe, copies=3 if asl else 2)
        _make(recipe, prepared, growth, workers, progress)
        if asl:
            to_asl(growth.session, [actor.name for actor in prepared.stage.actors], progress)
        growth.finish()
    return out


def cached_session(
    recipe: Recipe, cache: Path | None = None, workers: int = 2, progress: Progress = silent
) -> Path:
    """The session of this recipe in `cache` (default: the user's), made if it is not there yet."""
    out = (default_cache() if cache is None else cache) / f"session-{recipe.digest}"
    if not out.exists():
        with _lock(out.parent):
            if not out.exists():  # nobody else made it while we waited
                make_session(recipe, out, workers, progress)
    return out


def default_cache() -> Path:
    """$XDG_CACHE_HOME/share, or ~/.cache/share (XDG Base Directory Specification)."""
    return xdg_folder("XDG_CACHE_HOME", ".cache") / "share"


def _make(recipe: Recipe, prepared: Prepared, growth: Growth, workers: int, progress: Progress) -> None:
    stage, folder = prepared.stage, growth.session
    keep_room(prepared, progress)
    with Pool(workers, shooting.begin, (stage, recipe.images)) as pool:
        exposures = [_exposures(pool, stage, who, growth.work, progress) for who in range(len(stage.actors))]
        chunks = _shoot(pool, stage, exposures, growth, progress)
    progress("writing recordings", 0, len(stage.actors))
    for k, (actor, files) in enumerate(zip(stage.actors, chunks, strict=True)):
        write_recording(actor, files, folder / f"{actor.name}.mcap")
        write_truth(actor, folder / "truth" / f"{actor.name}.tum")
        progress("writing recordings", k + 1, len(stage.actors))
    draw_plan(folder / PLAN, prepared.layout, stage.actors)
    atomic_write(folder / SESSION, _description(recipe, prepared))


def _exposures(pool: Pool, stage: Stage, who: int, work: Path, progress: Progress) -> Shots:
    """How each of the actor's frames is exposed, from a quick look at some of them."""
    actor, kept = stage.actors[who], work / f"{stage.actors[who].name}.brightness.npy"
    jobs = shooting.looks(who, actor)
    if kept.exists():
        brightness = read_array(kept)
    else:
        values: dict[int, F64] = {}
        for job, seen in pool.run(shooting.meter, jobs):
            values[int(job.true_ns[0])] = seen
            progress(f"metering {actor.name}", len(values), len(jobs))
        brightness = np.concatenate([values[key] for key in sorted(values)])
        atomic_write(kept, _npy(brightness))
    return shooting.exposed(actor, jobs, brightness)


def _npy(values: F64) -> bytes:
    file = BytesIO()
    np.save(file, values)
    return file.getvalue()


def _shoot(
    pool: Pool, stage: Stage, exposures: list[Shots], growth: Growth, progress: Progress
) -> list[list[Path]]:
    """The chunks of each actor, in order; those that are there already are not drawn again."""
    takes = [
        _takes(actor, who, exposures[who], growth.frames(actor.name))
        for who, actor in enumerate(stage.actors)
    ]
    todo = [take for them in takes for take in them if not take.file.exists()]
    total = sum(len(actor.pictures) for actor in stage.actors)
    done = total - sum(take.last - take.first for take in todo)
    progress("drawing images", done, total)
    for take, _ in pool.run(shooting.shoot, todo):
        done += take.last - take.first
        progress("drawing images", done, total)
    return [[take.file for take in them] for them in takes]


def _takes(actor: Actor, who: int, shots: Shots, folder: Path) -> list[Take]:
    folder.mkdir(parents=True, exist_ok=True)
    count = len(actor.pictures)
    spans = [(k, min(k + _FRAMES, count)) for k in range(0, count, _FRAMES)]
    return [Take(who, a, b, folder / f"{a:06d}.chunk", shots.part(a, b)) for a, b in spans]


def _check_space(growth: Growth, stage: Stage, recipe: Recipe, copies: int) -> None:
    """Before hours are spent: so many copies of the images are there side by side at the end."""
    images = sum(2 * len(actor.pictures) for actor in stage.actors)
    there = sum(chunk.stat().st_size for chunk in growth.drawn())
    need, free = copies * images * _BYTES[recipe.images] - there, shutil.disk_usage(growth.work).free
    if need > free:
        raise ShareError(
            f"{growth.out}: about {need / 1e9:.2f} GB are needed and {free / 1e9:.2f} GB are free; "
            "make room, or give fewer --seconds"
        )


def _first_shown_ns(actor: Actor) -> int:
    """What the device's clock shows at the session's first instant."""
    clock = actor.device.clock
    shown = actor.path.start_ns + clock.offset_ns
    return shown % clock.period_ns if clock.period_ns else shown


def _description(recipe: Recipe, prepared: Prepared) -> str:
    """session.yaml. A stamp in an agent's files is session time + clock_offset_ns."""
    import yaml

    agents = {
        actor.name: {
            "kind": actor.kind.value,
            "sensors": actor.rig.kind,
            "rate_hz": actor.device.profile.rate_hz,
            "clock_offset_ns": _first_shown_ns(actor) - START_NS,
            "calibration": to_kalibr(actor.rig),
        }
        for actor in prepared.stage.actors
    }
    provenance = {
        "generator": "share emulate",
        "share_version": __version__,
        **recipe.plain(),
        "notes": list(prepared.notes),
    }
    data = {"schema": SCHEMA, "provenance": provenance, "agents": agents}
    if (placed := prepared.layout.target) is not None:
        data[TARGET] = to_plain(placed.target) | {T_WORLD_TARGET: placed.T_world_target.tolist()}
    return str(yaml.safe_dump(data, sort_keys=False, default_flow_style=None))


@contextmanager
def _lock(cache: Path) -> Iterator[None]:
    """Only one process at a time makes what is to be kept there; others wait. The lock is on the folder
    itself, so nothing is left behind, and the system releases it if we are killed."""
    import fcntl

    handle = os.open(writable_dir(cache), os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
