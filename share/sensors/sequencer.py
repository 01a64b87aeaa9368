"""Merge streams of measurements into frames: one pure iterator for recordings and live cameras.

A frame is yielded as soon as it is complete: its partner image is there, and the IMU has reached its stamp.
Its IMU samples end with the first one at or after the stamp, so that motion can be interpolated to the image.
Nothing waits for a wall clock: the stamp of the newest measurement is the only time.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any

import numpy as np

from share.config import SequencerConfig
from share.geometry.camera import Rig
from share.sensors.imu_check import ImuCheck, ImuRange
from share.sensors.imu_repeats import ImuRepeats
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU, LazyImage, Measurement
from share.sensors.stamps import GAP_FACTOR, MAX_JUMP_NS, StampRepair
from share.types import ImuBatch

_DEFAULT_IMU_RANGE = ImuRange()
_STALL_FACTOR = 10  # a stream that lets images wait for this many times a frame's longest wait is dead


@dataclass(frozen=True, slots=True, eq=False)
class UndecodedFrame:
    """A `Frame` with images that are not decoded yet. index: counts this iterator's frames from 0."""

    stamp_ns: int
    index: int
    image0: LazyImage
    image1: LazyImage | None = None
    depth: LazyImage | None = None
    imu: ImuBatch = field(default_factory=ImuBatch.empty)
    gap_ns: int = 0


@dataclass
class SequencerCounters:
    """Counts of measurements and what happened to them, for reports."""

    frames: int = 0
    imu_samples: int = 0  # in frames
    gaps: int = 0  # frames with gap_ns set
    duplicates: int = 0  # dropped: repeated stamp
    backward: int = 0  # dropped: older than its stream
    unpaired: int = 0  # dropped: images without a partner within sync_tolerance_ms
    imu_silent: int = 0  # frames without IMU samples although the rig has an IMU
    imu_dropped: int = 0  # samples more than MAX_JUMP_S before their frame
    imu_out_of_range: int = 0  # dropped: beyond the sensor's range, or not finite
    imu_spikes: int = 0  # dropped: runs of up to three samples far from their neighbours
    imu_repeated: int = 0  # dropped: equal to the two samples before, or all zero
    wraps: int = 0
    jumps: int = 0
    strays: int = 0


def rig_streams(rig: Rig) -> tuple[str, ...]:
    """Return the streams of a rig's frames."""
    return (*rig.cameras, *((IMU,) if rig.imu else ()))


def sequence_frames(measurements: Iterable[Measurement], merger: FrameMerger) -> Iterator[UndecodedFrame]:
    """Merge measurements into frames by time.

    Every frame has its partner image: cam1, or depth if there is no cam1; depth beside cam1 may be missing.
    Frames go without a dead partner if IMU or depth is alive: one that has sent nothing for _STALL_FACTOR
    times the longest wait since an image of cam0 needed it. Where cam0 pauses too, nothing is dead.

    Streams may be out of step by up to imu_silent_ms, and out of order within themselves by reorder_ms,
    without any effect on the frames. Memory is bounded by these times.
    """
    sequencer = FrameSequencer(merger)
    for measurement in measurements:
        yield from sequencer.feed(measurement)
    yield from sequencer.finish()


class FrameSequencer:
    """`sequence_frames`, one measurement at a time."""

    def __init__(self, merger: FrameMerger) -> None:
        self._merger, self._repair = merger, StampRepair()

    def feed(self, measurement: Measurement) -> Iterator[UndecodedFrame]:
        """Add a measurement; yield the frames that are complete now."""
        if measurement.stream in self._merger.buffers:
            for stamp, usable in self._repair.feed(measurement):
                self._merger.add(usable.stream, stamp, usable.payload)
                yield from self._merger.ready_frames()
        self._update_counters()

    def finish(self) -> Iterator[UndecodedFrame]:
        """Yield the frames that still wait: nothing follows."""
        for stamp, usable in self._repair.flush():
            self._merger.add(usable.stream, stamp, usable.payload)
            yield from self._merger.ready_frames()
        self._merger.finish()
        yield from self._merger.ready_frames()
        self._update_counters()

    def _update_counters(self) -> None:
        repair, counters = self._repair, self._merger.counters
        counters.wraps, counters.jumps, counters.strays = repair.wraps, repair.jumps, repair.strays
        counters.backward = self._merger.backward + repair.past


class _Buffer:
    """Waiting samples (stamp, payload) of one stream, in order of time."""

    def __init__(self, reorder_ns: int) -> None:
        self.items: list[tuple[int, Any]] = []
        self.newest = -(2**62)
        self.consumed_until = -(2**62)  # samples up to here are rejected
        self.awaited_ns: int | None = None  # stamp of the first image of cam0 after the newest sample
        self.was_stalled = False  # at the end of all streams
        self._reorder_ns = reorder_ns

    @property
    def complete_until(self) -> int:
        """Every sample up to this stamp has come, if disorder stays within reorder_ms."""
        return self.newest - self._reorder_ns

    def accepts(self, stamp: int) -> bool:
        return stamp >= self.complete_until and stamp > self.consumed_until

    def insert(self, stamp: int, payload: Any) -> bool:
        """Insert a sample in order; return False if the stamp is there already."""
        if stamp > self.newest:
            self.items.append((stamp, payload))
            self.newest, self.awaited_ns = stamp, None
            return True
        index = bisect_left(self.items, stamp, key=itemgetter(0))
        if stamp == self.newest or (index < len(self.items) and self.items[index][0] == stamp):
            return False
        self.items.insert(index, (stamp, payload))
        return True

    def await_sample(self, stamp: int) -> None:
        """Record that an image of cam0 at `stamp` needs a sample."""
        if self.awaited_ns is None and stamp > self.newest:
            self.awaited_ns = stamp

    def first_from(self, stamp: int) -> int | None:
        """Return the stamp of the first waiting sample at or after `stamp`; None if there is none."""
        index = bisect_left(self.items, stamp, key=itemgetter(0))
        return self.items[index][0] if index < len(self.items) else None

    def pop_until(self, stamp: int) -> list[tuple[int, Any]]:
        """Remove and return all samples up to `stamp`."""
        self.consumed_until = max(self.consumed_until, stamp)
        count = bisect_right(self.items, stamp, key=itemgetter(0))
        out, self.items = self.items[:count], self.items[count:]
        return out


class FrameMerger:
    """The state of `sequence_frames`: buffers of all streams, and which frames are complete.

    streams: as from `rig_streams`. rate_hz: the frame rate, 0 if unknown. imu_shift_ns: IMU time minus camera
    time. imu_range: samples beyond it are dropped (`share.sensors.imu_check`).
    """

    def __init__(
        self,
        streams: Collection[str],
        rate_hz: float,
        config: SequencerConfig,
        counters: SequencerCounters,
        imu_shift_ns: int = 0,
        imu_range: ImuRange = _DEFAULT_IMU_RANGE,
    ) -> None:
        self.buffers = {name: _Buffer(_ns(config.reorder_ms)) for name in streams}
        self.backward = 0
        self._partners = [self.buffers[name] for name in (CAM1, DEPTH) if name in streams]
        self._images = self.buffers[CAM0]
        self._imu = self.buffers.get(IMU)
        self._imu_check, self._imu_repeats = ImuCheck(imu_range), ImuRepeats()
        self._newest_ns = -(2**62)
        self._last_frame_ns: int | None = None
        self.counters = counters
        self._tolerance_ns = _ns(config.sync_tolerance_ms)
        self._wait_ns = _ns(config.imu_silent_ms) + _ns(config.reorder_ms)
        self._imu_shift_ns, self._imu_ahead_ns = imu_shift_ns, max(imu_shift_ns, 0)
        self._min_gap_ns = GAP_FACTOR / rate_hz * 1e9 if rate_hz > 0 else float("inf")

    def add(self, stream: str, stamp: int, payload: Any) -> None:
        buffer = self.buffers[stream]
        if stamp == buffer.newest:
            self.counters.duplicates += 1
        elif not buffer.accepts(stamp):
            self.backward += 1
        elif not buffer.insert(stamp, payload):
            self.counters.duplicates += 1
        self._newest_ns = max(self._newest_ns, stamp)
        if stream == CAM0:
            for other in self.buffers.values():
                other.await_sample(stamp)

    def finish(self) -> None:
        """Mark the end of all streams: waiting frames will get nothing more."""
        for buffer in self.buffers.values():
            buffer.was_stalled = self._has_stalled(buffer)
        for buffer in self.buffers.values():
            buffer.newest = self._newest_ns = 2**62
            buffer.awaited_ns = None

    def ready_frames(self) -> Iterator[UndecodedFrame]:
        """Yield the frames that are complete, in order of time."""
        while self._images.items and self._is_final(self._images.items[0][0]):
            stamp, image0 = self._images.items[0]
            self._images.pop_until(stamp)
            partners = [self._take_partner(buffer, stamp) for buffer in self._partners]
            if self._is_incomplete(partners):
                self.counters.unpaired += 1 + sum(p is not None for p in partners)
            else:
                yield self._make_frame(stamp, image0, partners)
        self._drop_old()

    def _is_incomplete(self, partners: list[Any]) -> bool:
        """Return whether the frame lacks its first partner image, and that stream is alive or nothing else
        gives scale (depth, IMU)."""
        if not partners or partners[0] is not None:
            return False
        other = partners[-1] is not None or (self._imu is not None and not self._has_stalled(self._imu))
        return not (other and self._has_stalled(self._partners[0]))

    def _is_final(self, stamp: int) -> bool:
        """Return whether nothing can still change the frame at `stamp`, or it has waited too long."""
        if self._newest_ns >= stamp + self._wait_ns + self._tolerance_ns + self._imu_ahead_ns:
            return True
        return (
            self._images.complete_until >= stamp
            and all(self._has_partner(buffer, stamp) for buffer in self._partners)
            and self._has_imu_until(stamp + self._imu_shift_ns)
        )

    def _has_partner(self, buffer: _Buffer, stamp: int) -> bool:
        """Return whether the partner image is there, or can no longer come."""
        if buffer.complete_until > stamp + self._tolerance_ns:
            return True
        if self._has_stalled(buffer):
            return True
        index = bisect_left(buffer.items, stamp - self._tolerance_ns, key=itemgetter(0))
        return index < len(buffer.items) and buffer.items[index][0] <= min(
            stamp + self._tolerance_ns, buffer.complete_until
        )

    def _has_imu_until(self, stamp: int) -> bool:
        """Return whether the first IMU sample at or after `stamp` is there, and no earlier one can come."""
        imu = self._imu
        if imu is None or imu.consumed_until >= stamp:
            return True
        first = imu.first_from(stamp)
        return (first is not None and imu.complete_until >= first) or self._has_stalled(imu)

    def _has_stalled(self, buffer: _Buffer) -> bool:
        """Return whether a stream has let images of cam0 wait for too long. Without images its silence says
        nothing: all of a device pauses."""
        if buffer.was_stalled or buffer.awaited_ns is None:
            return buffer.was_stalled
        return self._newest_ns - buffer.awaited_ns > _STALL_FACTOR * self._wait_ns

    def _take_partner(self, buffer: _Buffer, stamp: int) -> Any | None:
        """Remove and return the first image within the tolerance; drop earlier ones, which are unpaired."""
        self.counters.unpaired += len(buffer.pop_until(stamp - self._tolerance_ns - 1))
        if buffer.items and buffer.items[0][0] <= stamp + self._tolerance_ns:
            return buffer.pop_until(buffer.items[0][0])[0][1]
        return None

    def _make_frame(self, stamp: int, image0: LazyImage, partners: list[Any]) -> UndecodedFrame:
        step = 0 if self._last_frame_ns is None else stamp - self._last_frame_ns
        gap = step if step > self._min_gap_ns else 0
        images = dict(zip([name for name in (CAM1, DEPTH) if name in self.buffers], partners, strict=True))
        frame = UndecodedFrame(
            stamp_ns=stamp,
            index=self.counters.frames,
            image0=image0,
            image1=images.get(CAM1),
            depth=images.get(DEPTH),
            imu=self._take_imu(stamp + self._imu_shift_ns),
            gap_ns=gap,
        )
        self._last_frame_ns = stamp
        self.counters.frames += 1
        self.counters.gaps += gap > 0
        return frame

    def _take_imu(self, stamp: int) -> ImuBatch:
        """Return the samples since the previous frame, up to the first at or after `stamp`."""
        imu = self._imu
        if imu is None:
            return ImuBatch.empty()
        self.counters.imu_dropped += len(imu.pop_until(stamp - MAX_JUMP_NS))
        if imu.consumed_until >= stamp:  # the previous frame has the first sample after both
            return ImuBatch.empty()
        first = imu.first_from(stamp)
        batch = self._valid_samples(
            imu.pop_until(stamp if first is None or first > stamp + self._wait_ns else first)
        )
        self.counters.imu_samples += len(batch)
        self.counters.imu_silent += not len(batch)
        return batch

    def _valid_samples(self, samples: list[tuple[int, Any]]) -> ImuBatch:
        """Return the samples that are measurements and pass the IMU check."""
        if not samples:
            return ImuBatch.empty()
        stamps, table = np.array([s for s, _ in samples], np.int64), np.array([v for _, v in samples], float)
        if not (measured := self._imu_repeats.valid_mask(table)).all():
            self.counters.imu_repeated = self._imu_repeats.count
            stamps, table = stamps[measured], table[measured]
        valid = self._imu_check.valid_mask(stamps, table)
        self.counters.imu_out_of_range = self._imu_check.out_of_range
        self.counters.imu_spikes = self._imu_check.spikes
        if not valid.all():
            stamps, table = stamps[valid], table[valid]
        return ImuBatch(stamps, table[:, :3], table[:, 3:])

    def _drop_old(self) -> None:
        """Drop samples too old for any frame, so that streams without frames do not fill memory."""
        oldest = self._newest_ns - 2 * (self._wait_ns + self._tolerance_ns) - self._imu_ahead_ns
        for buffer in self._partners:
            if buffer.items and buffer.items[0][0] < oldest:
                self.counters.unpaired += len(buffer.pop_until(oldest))
        if self._imu and self._imu.items and self._imu.items[0][0] < oldest - MAX_JUMP_NS:
            self.counters.imu_dropped += len(self._imu.pop_until(oldest - MAX_JUMP_NS))


def _ns(ms: float) -> int:
    return int(ms * 1e6)
