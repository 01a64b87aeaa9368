"""The interface of all recordings and cameras: a rig, streams of measurements, perhaps ground truth."""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
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
    notes: tuple[str, ...]
    serial: str | None = None
    imu_range = ImuRange()  # by default that of the widest common sensor
    reports_silence = False  # whether the source itself reports a stream that has stopped

    @abstractmethod
    def stamps(self) -> dict[str, I64]:
        """Return the recorded stamps (N,) ns of every stream."""

    @abstractmethod
    def measurements(self) -> Iterator[Measurement]:
        """Yield all samples, roughly in order of time; `share.sensors.sequencer` merges them."""

    @abstractmethod
    def truth(self) -> Trajectory | None:
        """Return the true poses of the body in the world, None if unknown."""

    def stop(self) -> None:  # noqa: B027 -- a recording ends by itself
        """Ask a live camera to end, from any thread or signal handler."""

    @cached_property
    def losses(self) -> DataLosses:
        """What could not be read so far and was skipped."""
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


class Span(NamedTuple):
    """A part of a recording, ns: images in (image_from, image_to], IMU samples in (imu_from, imu_to]."""

    image_from: int
    image_to: int
    imu_from: int
    imu_to: int

    def limits(self, stream: str) -> tuple[int, int]:
        return (self.imu_from, self.imu_to) if stream == IMU else (self.image_from, self.image_to)


UNBOUNDED_NS = 2**62  # limit of a span without an end


def select_span(cam0: I64, frames: slice | None, where: str, imu_shift_ns: int = 0) -> Span:
    """Return the span of cam0's images number `frames`, with the IMU samples since the image before them.

    imu_shift_ns: IMU time minus camera time. Raises UsageError if nothing is left or the slice has a step.
    """
    if frames is None:
        return Span(-UNBOUNDED_NS, UNBOUNDED_NS, -UNBOUNDED_NS, UNBOUNDED_NS)
    first, last, step = frames.indices(len(cam0))
    if step != 1 or first >= last:
        requested = ":".join("" if end is None else str(end) for end in (frames.start, frames.stop))
        raise UsageError(f"{where}: --frames {requested} selects nothing; it has {len(cam0)} frames")
    previous_ns = int(cam0[first - 1]) if first else -UNBOUNDED_NS
    last_ns = int(cam0[last - 1])
    return Span(
        image_from=(previous_ns + int(cam0[first])) // 2 if first else -UNBOUNDED_NS,
        image_to=(last_ns + int(cam0[last])) // 2 if last < len(cam0) else UNBOUNDED_NS,
        imu_from=previous_ns + imu_shift_ns,
        imu_to=last_ns + imu_shift_ns if last < len(cam0) else UNBOUNDED_NS,
    )


@dataclass(frozen=True, eq=False)
class FolderSource(Source):
    """A recording in files: lists of images, and an IMU table (stamps (N,) ns, values (N, 6))."""

    name: str
    rig: Rig
    images: dict[str, list[tuple[int, LazyImage]]]
    imu: tuple[I64, F64] | None = None
    read_truth: Callable[[], Trajectory | None] = lambda: None
    notes: tuple[str, ...] = field(default=())
    losses: DataLosses = field(default_factory=DataLosses)

    def stamps(self) -> dict[str, I64]:
        out = {
            name: np.array([stamp for stamp, _ in images], np.int64) for name, images in self.images.items()
        }
        return out if self.imu is None else {**out, IMU: self.imu[0]}

    def measurements(self) -> Iterator[Measurement]:
        return heapq.merge(*self._streams(), key=lambda m: m.stamp_ns)

    def truth(self) -> Trajectory | None:
        return self.read_truth()

    def slice_frames(self, frames: slice | None) -> FolderSource:
        """Return this recording with only the frames number `frames` of cam0."""
        if not self.images[CAM0]:
            raise DataError(f"{self.name}: has no images")
        span = select_span(self.stamps()[CAM0], frames, self.name, self.rig.timeshift_ns)
        lo, hi = span.limits(CAM0)
        images = {
            name: [(stamp, image) for stamp, image in items if lo < stamp <= hi]
            for name, items in self.images.items()
        }
        imu = self.imu
        if imu is not None:
            keep = (imu[0] > span.imu_from) & (imu[0] <= span.imu_to)
            imu = (imu[0][keep], imu[1][keep])
        return FolderSource(self.name, self.rig, images, imu, self.read_truth, self.notes, self.losses)

    def _streams(self) -> Iterator[Iterator[Measurement]]:
        if self.imu is not None:  # first, so that samples precede an image of the same stamp
            yield map(_imu_measurement, self.imu[0].tolist(), self.imu[1].tolist())
        for name, items in self.images.items():
            yield _image_measurements(name, items)


def _imu_measurement(stamp_ns: int, values: list[float]) -> Measurement:
    return Measurement(IMU, stamp_ns, values)


def _image_measurements(stream: str, items: list[tuple[int, LazyImage]]) -> Iterator[Measurement]:
    return (Measurement(stream, stamp, image) for stamp, image in items)
