"""One actor's chunks and IMU to the recording and the truth that a session keeps."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from share.core.measurement import IMU, Measurement
from share.emulate.chunks import read_chunk
from share.emulate.stage import Actor
from share.io.files import atomic_write
from share.io.mcap.recorder import Recorder
from share.io.trajectory import Trajectory, format_tum


def write_recording(actor: Actor, chunks: list[Path], path: Path) -> None:
    """`path`.mcap with everything, in order of time. Raises ShareError where the disk is full."""
    with Recorder(path, actor.rig) as recorder:
        for measurement in heapq.merge(_inertial(actor), _pictures(chunks), key=lambda m: m.stamp_ns):
            recorder.write(measurement)


def write_truth(actor: Actor, path: Path) -> None:
    """Pose of the body in the world when the device's clock, which is the IMU's too, shows the stamp of
    each picture. (With a time offset the picture itself was taken a little before or after.)"""
    times, stamps = actor.device.truth_times(actor.pictures)
    known = (times >= actor.path.start_ns) & (times <= actor.path.end_ns) & ~actor.in_gap(times)
    atomic_write(path, format_tum(Trajectory(stamps[known], actor.path.poses(times[known]))))


def _inertial(actor: Actor) -> Iterator[Measurement]:
    if actor.rig.imu is None:
        return
    batch = actor.device.imu(actor.path).joined()
    values = np.concatenate([batch.gyro, batch.accel], axis=1)
    for stamp, row in zip(batch.stamps_ns.tolist(), values.tolist(), strict=True):
        yield Measurement(IMU, stamp, row)


def _pictures(chunks: list[Path]) -> Iterator[Measurement]:
    for path in chunks:
        yield from read_chunk(path)
