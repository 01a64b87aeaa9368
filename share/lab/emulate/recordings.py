"""Write an actor's recording and ground truth from its chunks and IMU."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from share.files.writing import atomic_write
from share.lab.emulate.chunks import read_chunk
from share.lab.emulate.stage import Actor
from share.recordings.mcap.recorder import Recorder
from share.recordings.trajectory import Trajectory, format_tum
from share.sensors.measurement import IMU, Measurement
from share.types import I64


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
