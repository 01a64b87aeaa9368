"""The files of a session: chunks of frames while it is drawn, then recordings, ground truth and a plan.

Chunks are kept until the recording is written, so that an interrupted session can be resumed.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from share.colours import agent_colours
from share.errors import DataError, UsageError
from share.files.reading import MAX_ARRAYS_BYTES, read_bytes
from share.files.writing import atomic_write
from share.lab.emulate.recipe import Progress
from share.lab.emulate.stage import Actor, RoomStage
from share.lab.emulate.world.layout import Layout
from share.lab.evaluate.charts import agg_pyplot, save_png
from share.recordings.convert import stage_progress, to_euroc
from share.recordings.images import EncodedImage
from share.recordings.mcap.recorder import Recorder
from share.recordings.session import SESSION_FILE
from share.recordings.trajectory import Trajectory, format_tum
from share.runtime.source import open_source
from share.sensors.measurement import DEPTH, IMU, Measurement
from share.types import F64, I64

DEPTH_SCALE = 1000.0  # per metre: millimetres


class EncodedPicture(msgspec.Struct, frozen=True, array_like=True):
    """One image as recorded: JPEG or PNG."""

    stream: str
    stamp_ns: int
    width: int
    height: int
    data: bytes


def write_chunk(path: Path, pictures: list[EncodedPicture]) -> None:
    """Write the chunk atomically. Raises as `atomic_write`."""
    atomic_write(path, msgspec.msgpack.encode(pictures))


def read_chunk(path: Path) -> Iterator[Measurement]:
    """Yield the images in the order in which they were written. Raises DataError if the chunk is damaged."""
    try:
        pictures = msgspec.msgpack.decode(read_bytes(path, MAX_ARRAYS_BYTES), type=list[EncodedPicture])
    except (OSError, msgspec.DecodeError, msgspec.ValidationError) as error:
        raise DataError(f"{path}: is damaged ({error}); delete it and run the command again") from None
    for p in pictures:
        yield Measurement(p.stream, p.stamp_ns, encoded_image(p, str(path)))


def encoded_image(p: EncodedPicture, where: str) -> EncodedImage:
    """Return the image as a reader does. where: named in errors."""
    return EncodedImage(p.data, where, p.width, p.height, DEPTH_SCALE if p.stream == DEPTH else 0.0)


# Recordings and ground truth.


def write_recording(actor: Actor, chunks: list[Path], path: Path) -> None:
    """Write `path`.mcap with all streams in order of time. Raises ShareError where the disk is full."""
    clock = actor.device.clock
    first, period = int(clock.read(np.array([actor.path.start_ns]))[0]), clock.period_ns
    streams = (_unwrapped(s, first, period) for s in (_imu_measurements(actor), _image_measurements(chunks)))
    with Recorder(path, actor.rig) as recorder:
        for when, measurement in heapq.merge(*streams, key=lambda timed: timed[0]):
            recorder.write(measurement, when)


def _unwrapped(
    measurements: Iterator[Measurement], latest_ns: int, period_ns: int
) -> Iterator[tuple[int, Measurement]]:
    """Yield each measurement with its stamp, unwrapped."""
    for measurement in measurements:
        if period_ns:
            latest_ns = measurement.stamp_ns + period_ns * round(
                (latest_ns - measurement.stamp_ns) / period_ns
            )
        yield (latest_ns if period_ns else measurement.stamp_ns), measurement


def write_truth(actor: Actor, path: Path) -> None:
    """Write the body's pose in the world at the time when the device's clock shows the stamp of each picture.
    (With a time offset the picture itself was taken a little earlier or later.)"""
    atomic_write(path, format_tum(true_trajectory(actor)[1]))


def true_trajectory(actor: Actor) -> tuple[I64, Trajectory]:
    """Return the indices (N,) of pictures with ground truth, and their true poses, as in `write_truth`."""
    times, stamps = actor.device.truth_times(actor.pictures)
    known = (times >= actor.path.start_ns) & (times <= actor.path.end_ns) & ~actor.in_gap(times)
    return np.flatnonzero(known), Trajectory(stamps[known], actor.path.poses(times[known]))


def _imu_measurements(actor: Actor) -> Iterator[Measurement]:
    if actor.rig.imu is None:
        return
    batch = actor.device.imu_streams(actor.path).to_batch()
    values = np.concatenate([batch.gyro, batch.accel], axis=1)
    for stamp, row in zip(batch.stamps_ns.tolist(), values.tolist(), strict=True):
        yield Measurement(IMU, stamp, row)


def _image_measurements(chunks: list[Path]) -> Iterator[Measurement]:
    for path in chunks:
        yield from read_chunk(path)


# EuRoC/ASL folders, for other programs.


def check_asl(stage: RoomStage) -> None:
    """Raise UsageError where an agent has data that such a folder cannot hold."""
    for actor in stage.actors:
        if actor.device.clock.period_ns:
            raise UsageError("ASL folders cannot hold stamps that wrap; leave out --effect wrap=on")
        if actor.rig.depth is not None:
            raise UsageError(
                f"{actor.name}: an ASL folder has no place for depth; give --sensors {actor.name}=stereo"
            )


def to_asl(folder: Path, names: list[str], progress: Progress) -> None:
    """Convert each NAME.mcap of the session in `folder` to NAME/mav0, with the ground truth."""
    for name in names:
        source = open_source(str(folder / name))
        count = stage_progress(progress, f"writing {name}/mav0", source.images_count)
        to_euroc(source, folder / f"{name}.asl", count)
        (folder / f"{name}.asl").rename(folder / name)
        (folder / f"{name}.mcap").unlink()
        (folder / "truth" / f"{name}.tum").unlink()
    (folder / "truth").rmdir()
    (folder / SESSION_FILE).rename(folder / "emulation.yaml")


# The plan of a session: the room and the paths in it, seen from above.

_PLAN_STEP_NS = 50_000_000
_ARROW_S = 5.0  # between two arrows that show an agent's viewing direction


def draw_plan(path: Path, layout: Layout, actors: tuple[Actor, ...]) -> None:
    """Write a PNG: furniture by its height (darker is higher), paths, and an arrow every few seconds."""
    pyplot = agg_pyplot()
    length, width, height = layout.size
    figure, axes = pyplot.subplots(figsize=(10, 10 * (width + 1.2) / (length + 1)), layout="constrained")
    draw_room(axes, layout)
    for actor, colour in zip(actors, agent_colours(actor.name for actor in actors).values(), strict=True):
        p, ahead = _camera_path(actor)
        walked_m = np.linalg.norm(np.diff(p, axis=0), axis=1).sum()
        axes.plot(p[:, 0], p[:, 1], color=colour, linewidth=1.3, label=f"{actor.name}, {walked_m:.1f} m")
        axes.plot(*p[0, :2], "o", color=colour)
        every = slice(None, None, max(1, int(_ARROW_S * 1e9 / _PLAN_STEP_NS)))
        origins, arrows = p[every], 0.3 * ahead[every]
        axes.quiver(
            *origins[:, :2].T,
            *arrows[:, :2].T,
            color=colour,
            angles="xy",
            scale_units="xy",
            scale=1,
            width=3e-3,
        )
    axes.set_title(f"{layout.name}, seed {layout.seed}, {length:g} x {width:g} x {height:g} m")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=6, frameon=False)
    save_png(figure, path, 100)


def draw_room(axes: Any, layout: Layout) -> None:
    """Draw a room from above."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Rectangle

    length, width, height = layout.size
    triangles = _furniture_triangles(layout)
    tops = triangles[:, :, 2].mean(axis=1)
    shades = 0.93 - 0.6 * (tops / height).clip(0, 1)
    axes.add_collection(PolyCollection(list(triangles[:, :, :2]), facecolors=[str(s) for s in shades]))
    axes.add_patch(Rectangle((0, 0), length, width, fill=False, linewidth=2))
    axes.set(
        xlim=(-0.3, length + 0.3), ylim=(-0.3, width + 0.3), xlabel="x [m]", ylabel="y [m]", aspect="equal"
    )


def _furniture_triangles(layout: Layout) -> F64:
    """Return triangles (F, 3, 3) of the solid pieces, lowest first."""
    meshes = [piece.shape.mesh.triangles for piece in layout.pieces if piece.solid]
    triangles = np.concatenate([np.zeros((0, 3, 3)), *meshes]).astype(float)
    return triangles[np.argsort(triangles[:, :, 2].max(axis=1), kind="stable")]


def _camera_path(actor: Actor) -> tuple[F64, F64]:
    """Return positions (N, 3) and viewing directions (N, 3) of cam0 along the path."""
    stamps = np.arange(actor.path.start_ns, actor.path.end_ns + 1, _PLAN_STEP_NS)
    T = actor.path.poses(stamps) @ actor.rig.T_body_cam0
    return T[:, :3, 3], T[:, :3, 2]
