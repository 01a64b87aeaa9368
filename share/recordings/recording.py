"""The interface of all recordings and cameras: a rig, streams of measurements, perhaps ground truth.

A tracker reads a `Source`. A `Recording` is one on disk, of which a range of frames is read; a `FolderSource`
one of image files.
"""

from __future__ import annotations

import heapq
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from share.errors import DataError, UsageError
from share.geometry.camera import Rig
from share.recordings.losses import DataLosses
from share.recordings.trajectory import Trajectory
from share.sensors.imu_check import ImuRange
from share.sensors.measurement import CAM0, IMU, LazyImage, Measurement
from share.types import F64, I64


class Source(ABC):
    """One agent's recording, or its camera.

    rig: decides which streams there are. notes: lines to print. serial: of the device, None if unknown.
    """

    name: str
    rig: Rig
    notes: tuple[str, ...] = ()
    serial: str | None = None
    imu_range = ImuRange()  # by default that of the widest common sensor
    reports_silence = False  # whether the source itself reports a stream that has stopped

    @abstractmethod
    def stamps(self) -> dict[str, I64]:
        """Return the recorded stamps (N,) ns of every stream."""

    @abstractmethod
    def measurements(self) -> Iterator[Measurement]:
        """Yield all samples, roughly in order of time; `share.sensors.sequencer` merges them."""

    def truth(self) -> Trajectory | None:
        """Return the true poses of the body in the world, None if unknown."""
        return None

    def stop(self) -> None:  # noqa: B027 -- a recording ends by itself
        """Ask a live camera to end, from any thread or signal handler."""

    @cached_property
    def losses(self) -> DataLosses:
        """Unreadable items so far, which were skipped."""
        return DataLosses()

    def report(self) -> dict[str, Any]:
        """Return a live camera's events, for report.json."""
        return {}

    @property
    def images_count(self) -> int:
        return len(self.stamps()[CAM0])

    @cached_property
    def rate_hz(self) -> float:
        """Frame rate, Hz, from the median step of cam0; 0 with fewer than two images."""
        steps = np.diff(self.stamps()[CAM0])
        steps = steps[steps > 0]
        return float(1e9 / np.median(steps)) if len(steps) else 0.0


class TimeRange(NamedTuple):
    """A part of a recording, ns: images in (image_from, image_to], IMU samples in (imu_from, imu_to]."""

    image_from: int
    image_to: int
    imu_from: int
    imu_to: int

    def limits(self, stream: str) -> tuple[int, int]:
        return (self.imu_from, self.imu_to) if stream == IMU else (self.image_from, self.image_to)


UNBOUNDED_NS = 2**62  # limit of a time range without an end
WHOLE = TimeRange(-UNBOUNDED_NS, UNBOUNDED_NS, -UNBOUNDED_NS, UNBOUNDED_NS)


def select_time_range(cam0: I64, frames: slice | None, where: str, imu_shift_ns: int = 0) -> TimeRange:
    """Return the time range of cam0's images number `frames`, with the IMU samples since the image before.

    cam0 (N,): stamps of its images, ns. imu_shift_ns: IMU time minus camera time. Raises DataError without
    images, UsageError if nothing is left or the slice has a step.
    """
    if len(cam0) == 0:
        raise DataError(f"{where}: has no images")
    if frames is None:
        return WHOLE
    first, last, step = frames.indices(len(cam0))
    if step != 1 or first >= last:
        requested = ":".join("" if end is None else str(end) for end in (frames.start, frames.stop))
        raise UsageError(f"{where}: --frames {requested} selects nothing; it has {len(cam0)} frames")
    previous_ns = int(cam0[first - 1]) if first else -UNBOUNDED_NS
    last_ns = int(cam0[last - 1])
    return TimeRange(
        image_from=(previous_ns + int(cam0[first])) // 2 if first else -UNBOUNDED_NS,
        image_to=(last_ns + int(cam0[last])) // 2 if last < len(cam0) else UNBOUNDED_NS,
        imu_from=previous_ns + imu_shift_ns,
        imu_to=last_ns + imu_shift_ns if last < len(cam0) else UNBOUNDED_NS,
    )


class Recording(Source):
    """A recording on disk, of which `time_range` is read."""

    time_range: TimeRange = WHOLE

    @abstractmethod
    def all_stamps(self) -> dict[str, I64]:
        """Return the stamps (N,) ns of every stream, of the whole recording."""

    def stamps(self) -> dict[str, I64]:
        out = {}
        for stream, stamps in self.all_stamps().items():
            lo, hi = self.time_range.limits(stream)
            out[stream] = stamps[(stamps > lo) & (stamps <= hi)]
        return out

    def is_in_time_range(self, stream: str, stamp_ns: int) -> bool:
        lo, hi = self.time_range.limits(stream)
        return lo < stamp_ns <= hi


class FolderSource(Recording):
    """A recording in files.

    images: (stamp ns, image) of each stream. imu: stamps (N,) ns, values (N, 6). frames: the images of cam0
    to read. Raises DataError, UsageError as `select_time_range`.
    """

    def __init__(
        self,
        path: Path,
        rig: Rig,
        images: dict[str, list[tuple[int, LazyImage]]],
        losses: DataLosses,
        imu: tuple[I64, F64] | None = None,
        read_truth: Callable[[], Trajectory | None] = lambda: None,
        notes: tuple[str, ...] = (),
        frames: slice | None = None,
    ) -> None:
        self.name, self.rig, self.notes, self.losses = path.resolve().name, rig, notes, losses
        self.images, self.imu, self._read_truth = images, imu, read_truth
        self.time_range = select_time_range(self.all_stamps()[CAM0], frames, self.name, rig.timeshift_ns)

    def all_stamps(self) -> dict[str, I64]:
        stamps = {
            name: np.array([stamp for stamp, _ in items], np.int64) for name, items in self.images.items()
        }
        return stamps | ({} if self.imu is None else {IMU: self.imu[0]})

    def measurements(self) -> Iterator[Measurement]:
        streams = [self._stream(name, items) for name, items in self.images.items()]
        if self.imu is not None:  # first, so that samples precede an image of the same stamp
            stamps, values = self.imu
            streams.insert(0, self._stream(IMU, zip(stamps.tolist(), values.tolist(), strict=True)))
        return heapq.merge(*streams, key=lambda m: m.stamp_ns)

    def _stream(self, name: str, items: Any) -> Iterator[Measurement]:
        return (Measurement(name, stamp, one) for stamp, one in items if self.is_in_time_range(name, stamp))

    def truth(self) -> Trajectory | None:
        return self._read_truth()


def existing_images(folder: Path, names: list[str], listing: Path, losses: DataLosses) -> set[str]:
    """Return which of the files `names`, listed in `listing`, exist below `folder`; others go to losses.

    Raises DataError if more than 5 % are missing.
    """
    folders = {(folder / name).parent for name in names}
    found = {one / name for one in folders if one.is_dir() for name in os.listdir(one)}
    existing, kind = {name for name in names if folder / name in found}, f"images of {listing}"
    for name in (name for name in names if name not in existing):
        losses.add(kind, name, f"{listing}: {name} is missing from {folder}; copy the recording again")
    losses.check(kind, len(names))
    return existing
