"""Make a session folder: session.yaml, plan.png, NAME.mcap and truth/NAME.tum per agent.

recipe -> stage (nothing is written) -> exposure of each frame -> chunks of frames -> recordings, truth

It is made in a work folder, so that a session of a given name is always complete:

.NAME.partial/DIGEST/    room, brightness, chunks of frames: reused by the next attempt
.NAME.partial/session/   made again in each attempt, and renamed at the end
"""

from __future__ import annotations

import os
import shutil
from io import BytesIO
from pathlib import Path
from types import TracebackType

import numpy as np

from share import __version__
from share.errors import ShareError, UsageError
from share.files.arrays import read_array
from share.files.locks import folder_locked, lock_folder
from share.files.writing import atomic_write, sync_folder, writable_dir, write_errors, xdg_folder
from share.lab.calibrate.target import T_WORLD_TARGET, TARGET, target_mapping
from share.lab.emulate import drawing
from share.lab.emulate.drawing import ChunkJob
from share.lab.emulate.recipe import Progress, SessionRecipe, no_progress
from share.lab.emulate.recordings import check_asl, draw_plan, to_asl, write_recording, write_truth
from share.lab.emulate.sensor.imager import ExposureSeries
from share.lab.emulate.stage import Actor, PreparedSession, RoomStage, keep_room, prepare_session
from share.lab.emulate.types import START_NS
from share.lab.pool import Pool
from share.recordings.calibration import to_kalibr
from share.recordings.session import SCHEMA, SESSION_FILE
from share.types import F64

PLAN_FILE = "plan.png"
_CHUNK_FRAMES = 24  # in a chunk: the most that an interruption costs a process
_IMAGE_BYTES = {"jpeg": 130_000, "png": 330_000}  # estimated, to check the disk beforehand


def make_session(
    recipe: SessionRecipe, out: Path, workers: int = 2, progress: Progress = no_progress, asl: bool = False
) -> Path:
    """Make a session in the new folder `out` with `workers` processes; with `asl`, an EuRoC/ASL folder
    NAME/mav0 per agent instead. Another attempt at the same recipe resumes an interrupted one.

    Raises UsageError where `out` exists or the recipe is invalid; ShareError where the disk is full.
    """
    partial = PartialSession(out, recipe.digest)
    partial.check_new()
    prepared = prepare_session(recipe, partial.room, progress)
    if asl:
        check_asl(prepared.stage)
    with partial, write_errors(out):
        _check_space(partial, prepared.stage, recipe, copies=3 if asl else 2)
        _fill_session(recipe, prepared, partial, workers, progress)
        if asl:
            to_asl(partial.session, [actor.name for actor in prepared.stage.actors], progress)
        partial.finish()
    return out


def make_cached_session(
    recipe: SessionRecipe, cache: Path | None = None, workers: int = 2, progress: Progress = no_progress
) -> Path:
    """Return the session of this recipe in `cache` (default: the user's); make it if it is not there."""
    out = (default_cache() if cache is None else cache) / f"session-{recipe.digest}"
    if not out.exists():
        with folder_locked(writable_dir(out.parent)):
            if not out.exists():  # another process may have made it while this one waited
                make_session(recipe, out, workers, progress)
    return out


def default_cache() -> Path:
    """Return $XDG_CACHE_HOME/share, or ~/.cache/share (XDG Base Directory Specification)."""
    return xdg_folder("XDG_CACHE_HOME", ".cache") / "share"


def _fill_session(
    recipe: SessionRecipe,
    prepared: PreparedSession,
    partial: PartialSession,
    workers: int,
    progress: Progress,
) -> None:
    actors, folder = prepared.stage.actors, partial.session
    keep_room(prepared, progress)
    with Pool(workers, drawing.start_worker, (prepared.stage, recipe.images)) as pool:
        exposures = [_metered_exposures(pool, actor, k, partial, progress) for k, actor in enumerate(actors)]
        jobs = [_chunk_jobs(actor, k, exposures[k], partial) for k, actor in enumerate(actors)]
        _draw_chunks(pool, [job for actor_jobs in jobs for job in actor_jobs], progress)
    progress("writing recordings", 0, len(actors))
    for k, actor in enumerate(actors):
        write_recording(actor, [job.file for job in jobs[k]], folder / f"{actor.name}.mcap")
        write_truth(actor, folder / "truth" / f"{actor.name}.tum")
        progress("writing recordings", k + 1, len(actors))
    draw_plan(folder / PLAN_FILE, prepared.layout, actors)
    atomic_write(folder / SESSION_FILE, _session_yaml(recipe, prepared))


def _metered_exposures(
    pool: Pool, actor: Actor, actor_index: int, partial: PartialSession, progress: Progress
) -> ExposureSeries:
    """Return the exposure of each frame of the actor, from metering a part of them, once per session."""
    file = partial.work / f"{actor.name}.brightness.npy"
    jobs = drawing.meter_jobs(actor_index, actor)
    if file.exists():
        return drawing.exposure_series(actor, jobs, read_array(file))
    values: dict[int, F64] = {}
    for job, brightness in pool.run(drawing.measure_brightness, jobs):
        values[int(job.true_ns[0])] = brightness
        progress(f"setting the exposure of {actor.name}", len(values), len(jobs))
    whole = np.concatenate([values[key] for key in sorted(values)])
    data = BytesIO()
    np.save(data, whole)
    atomic_write(file, data.getvalue())
    return drawing.exposure_series(actor, jobs, whole)


def _chunk_jobs(
    actor: Actor, actor_index: int, shots: ExposureSeries, partial: PartialSession
) -> list[ChunkJob]:
    """Return a job for each chunk of the actor, in order."""
    folder, count = partial.frames(actor.name), len(actor.pictures)
    folder.mkdir(parents=True, exist_ok=True)
    spans = [(k, min(k + _CHUNK_FRAMES, count)) for k in range(0, count, _CHUNK_FRAMES)]
    return [ChunkJob(actor_index, a, b, folder / f"{a:06d}.chunk", shots.part(a, b)) for a, b in spans]


def _draw_chunks(pool: Pool, jobs: list[ChunkJob], progress: Progress) -> None:
    """Draw the chunks that are not there yet."""
    missing = [job for job in jobs if not job.file.exists()]
    total = sum(job.last - job.first for job in jobs)
    done = total - sum(job.last - job.first for job in missing)
    progress("drawing images", done, total)
    for job, _ in pool.run(drawing.draw_chunk, missing):
        done += job.last - job.first
        progress("drawing images", done, total)


def _check_space(partial: PartialSession, stage: RoomStage, recipe: SessionRecipe, copies: int) -> None:
    """Raise ShareError early if the disk cannot hold `copies` of the images at the same time."""
    images = sum(2 * len(actor.pictures) for actor in stage.actors)
    existing = sum(chunk.stat().st_size for chunk in partial.drawn_chunks())
    need, free = (
        copies * images * _IMAGE_BYTES[recipe.images] - existing,
        shutil.disk_usage(partial.work).free,
    )
    if need > free:
        raise ShareError(
            f"{partial.out}: about {need / 1e9:.2f} GB are needed and {free / 1e9:.2f} GB are free; "
            "make room, or give fewer --seconds"
        )


def _first_stamp_ns(actor: Actor) -> int:
    """Return the device clock's reading at the session's first instant."""
    clock = actor.device.clock
    stamp = actor.path.start_ns + clock.offset_ns
    return stamp % clock.period_ns if clock.period_ns else stamp


def _session_yaml(recipe: SessionRecipe, prepared: PreparedSession) -> str:
    """Return session.yaml. A stamp in an agent's files is session time + clock_offset_ns."""
    import yaml

    agents = {
        actor.name: {
            "kind": actor.kind.value,
            "sensors": actor.rig.kind,
            "rate_hz": actor.device.profile.rate_hz,
            "clock_offset_ns": _first_stamp_ns(actor) - START_NS,
            "calibration": to_kalibr(actor.rig),
        }
        for actor in prepared.stage.actors
    }
    provenance = {
        "generator": "share emulate",
        "share_version": __version__,
        **recipe.to_mapping(),
        "notes": list(prepared.notes),
    }
    data = {"schema": SCHEMA, "provenance": provenance, "agents": agents}
    if (placed_target := prepared.layout.target) is not None:
        data[TARGET] = target_mapping(placed_target.target) | {
            T_WORLD_TARGET: placed_target.T_world_target.tolist()
        }
    return str(yaml.safe_dump(data, sort_keys=False, default_flow_style=None))


class PartialSession:
    """Work folder of the session `out`, with an exclusive lock as a context manager. Work of other digests is
    removed. After an error drawn frames are kept, and the error says so."""

    def __init__(self, out: Path, digest: str) -> None:
        self.out = out
        place = Path(os.path.abspath(out))  # `.` has no name
        self._folder = place.parent / f".{place.name}.partial"
        self.work, self.session = self._folder / digest, self._folder / "session"

    @property
    def room(self) -> Path:
        """Return the folder of the finished room."""
        return self.work / "room"

    def frames(self, name: str) -> Path:
        """Return the folder of the chunks of agent `name`."""
        return self.work / "frames" / name

    def drawn_chunks(self) -> list[Path]:
        """Return all chunks drawn so far."""
        return sorted(self.work.glob("frames/*/*.chunk"))

    def check_new(self) -> None:
        """Raise UsageError where `out` exists or cannot be created."""
        if self.out.exists() or self.out.is_symlink():
            raise UsageError(f"{self.out}: exists already; give the name of a new folder")
        parent = next(folder for folder in self.out.absolute().parents if folder.exists())
        if not parent.is_dir():
            raise UsageError(f"{self.out}: its parent {parent} is a file; give another --out")

    def finish(self) -> None:
        """Give the session its name and remove the work folder."""
        shutil.rmtree(self.work)
        self.session.rename(self.out)
        sync_folder(self.out.parent)
        shutil.rmtree(self._folder)

    def __enter__(self) -> PartialSession:
        self._created_folders = _missing_parents(self._folder)
        self._handle = lock_folder(self._folder)
        self.check_new()  # another process may have finished it since
        for leftover in self._folder.iterdir():
            if leftover != self.work:
                shutil.rmtree(leftover)
        self.work.mkdir(exist_ok=True)
        (self.session / "truth").mkdir(parents=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if isinstance(error, ShareError) and self._folder.exists():
                self._keep_or_remove(error)
        finally:
            os.close(self._handle)

    def _keep_or_remove(self, error: ShareError) -> None:
        if self.drawn_chunks():
            raise type(error)(f"{error}; run the same command again to resume") from None
        shutil.rmtree(self._folder)
        for folder in self._created_folders:
            folder.rmdir()


def _missing_parents(folder: Path) -> list[Path]:
    """Return the parents that do not exist yet, innermost first."""
    return [parent for parent in folder.parents if not parent.exists()]
