"""Streams of measurements to frames: one pure iterator, the same for a file and for a live camera.

A frame goes out as soon as it is whole: its partner image is there and the IMU has reached its
stamp. Its IMU samples end with the first that is not before it, so that motion can be interpolated to
the moment of the image. Nothing waits for a wall clock: the time of the newest measurement is the only clock.
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
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU, LazyImage, Measurement
from share.sensors.stamps import StampRepair
from share.types import ImuBatch

_USUAL = ImuRange()
_DEAD = 10  # a stream silent for so many times what a frame waits is not waited for any more


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """A `Frame` whose images are not decoded yet. index counts the bundles of this iterator from 0."""

    stamp_ns: int
    index: int
    image0: LazyImage
    image1: LazyImage | None = None
    depth: LazyImage | None = None
    imu: ImuBatch = field(default_factory=ImuBatch.empty)
    gap_ns: int = 0


@dataclass
class SequencerCounters:
    """What happened to the measurements so far; for reports, and for a state that a person sees."""

    frames: int = 0
    imu_samples: int = 0  # handed out with frames
    gaps: int = 0  # frames with gap_ns set
    duplicates: int = 0  # dropped: the stamp was there already
    backward: int = 0  # dropped: older than what its stream had reached
    unpaired: int = 0  # dropped: images without a partner within sync_tolerance_ms
    imu_silent: int = 0  # frames that no IMU sample reaches although the rig has an IMU
    imu_dropped: int = 0  # samples longer than max_jump_s before their frame
    imu_out_of_range: int = 0  # dropped: beyond what the sensor can measure, or not finite
    imu_spikes: int = 0  # dropped: up to three samples in a row far from those around them
    wraps: int = 0
    jumps: int = 0
    strays: int = 0


def streams_of(rig: Rig) -> tuple[str, ...]:
    """The streams that a rig's frames are made of."""
    have = ((CAM0, True), (CAM1, rig.cam1), (DEPTH, rig.depth), (IMU, rig.imu))
    return tuple(name for name, there in have if there)


def sequence(
    measurements: Iterable[Measurement],
    streams: Collection[str],
    rate_hz: float,
    config: SequencerConfig,
    counters: SequencerCounters,
    imu_shift_ns: int = 0,
    imu_range: ImuRange = _USUAL,
) -> Iterator[Bundle]:
    """Merge by time. `streams` as `streams_of` gives them; rate_hz: the frame rate, 0 if unknown;
    imu_shift_ns: IMU time less camera time, by which a frame's IMU samples are later stamped than it;
    imu_range: beyond which a sample is none (`share.sensors.imu_check`).

    Every frame has its partner image: cam1, or depth where there is no cam1; depth beside cam1 may be
    missing. A partner that is dead (silent for _DEAD times what a frame waits) is done without where the
    IMU or depth is alive.

    Streams may be out of step with each other by up to imu_silent_ms, and within themselves by
    reorder_ms: such disorder does not change the bundles. Memory is bounded by these times.
    """
    repair = StampRepair(config.max_jump_s)
    merger = _Merger(streams, rate_hz, config, counters, imu_shift_ns, imu_range)
    for measurement in measurements:
        if measurement.stream in merger.buffers:
            for stamp, usable in repair.feed(measurement):
                merger.add(usable.stream, stamp, usable.payload)
                yield from merger.ready()
        _count(repair, counters, merger)
    for stamp, usable in repair.flush():
        merger.add(usable.stream, stamp, usable.payload)
        yield from merger.ready()
    merger.end()
    yield from merger.ready()
    _count(repair, counters, merger)


def _count(repair: StampRepair, counters: SequencerCounters, merger: _Merger) -> None:
    counters.wraps, counters.jumps, counters.strays = repair.wraps, repair.jumps, repair.strays
    counters.backward = merger.backward + repair.past


class _Buffer:
    """One stream's samples that wait: (stamp, payload) in order of time."""

    def __init__(self, reorder_ns: int) -> None:
        self.items: list[tuple[int, Any]] = []
        self.newest = -(2**62)
        self.taken = -(2**62)  # nothing up to here is accepted any more
        self.died = False  # was dead when all ended
        self._reorder_ns = reorder_ns

    @property
    def reached(self) -> int:
        """Everything up to here has come, unless the stream is more disordered than we allow."""
        return self.newest - self._reorder_ns

    def accepts(self, stamp: int) -> bool:
        return stamp >= self.reached and stamp > self.taken

    def insert(self, stamp: int, payload: Any) -> bool:
        """Whether it was new."""
        if stamp > self.newest:
            self.items.append((stamp, payload))
            self.newest = stamp
            return True
        at = bisect_left(self.items, stamp, key=itemgetter(0))
        if stamp == self.newest or (at < len(self.items) and self.items[at][0] == stamp):
            return False
        self.items.insert(at, (stamp, payload))
        return True

    def first_from(self, stamp: int) -> int | None:
        """The stamp of the first item that waits and is not before `stamp`."""
        at = bisect_left(self.items, stamp, key=itemgetter(0))
        return self.items[at][0] if at < len(self.items) else None

    def pop_until(self, stamp: int) -> list[tuple[int, Any]]:
        """Take everything with a stamp up to `stamp`."""
        self.taken = max(self.taken, stamp)
        count = bisect_right(self.items, stamp, key=itemgetter(0))
        out, self.items = self.items[:count], self.items[count:]
        return out


class _Merger:
    def __init__(
        self,
        streams: Collection[str],
        rate_hz: float,
        config: SequencerConfig,
        counters: SequencerCounters,
        imu_shift_ns: int = 0,
        imu_range: ImuRange = _USUAL,
    ) -> None:
        self.buffers = {name: _Buffer(_ns(config.reorder_ms)) for name in streams}
        self.backward = 0
        self._partners = [self.buffers[name] for name in (CAM1, DEPTH) if name in streams]
        self._images = self.buffers[CAM0]
        self._imu = self.buffers.get(IMU)
        self._check = ImuCheck(imu_range)
        self._now, self._first = -(2**62), 2**62
        self._last: int | None = None
        self._counters = counters
        self._tolerance = _ns(config.sync_tolerance_ms)
        self._wait = _ns(config.imu_silent_ms) + _ns(config.reorder_ms)
        self._shift, self._ahead = imu_shift_ns, max(imu_shift_ns, 0)
        self._keep = int(config.max_jump_s * 1e9)
        self._gap = config.gap_factor / rate_hz * 1e9 if rate_hz > 0 else float("inf")

    def add(self, stream: str, stamp: int, payload: Any) -> None:
        buffer = self.buffers[stream]
        if stamp == buffer.newest:
            self._counters.duplicates += 1
        elif not buffer.accepts(stamp):
            self.backward += 1
        elif not buffer.insert(stamp, payload):
            self._counters.duplicates += 1
        self._now = max(self._now, stamp)
        self._first = min(self._first, stamp)

    def end(self) -> None:
        """No more will come: whatever waits is as whole as it gets."""
        for buffer in self.buffers.values():
            buffer.died = self._dead(buffer)
        for buffer in self.buffers.values():
            buffer.newest = self._now = 2**62

    def ready(self) -> Iterator[Bundle]:
        """The bundles that are whole, in order of time."""
        while self._images.items and self._settled(self._images.items[0][0]):
            stamp, image0 = self._images.items[0]
            self._images.pop_until(stamp)
            partners = [self._partner(buffer, stamp) for buffer in self._partners]
            if self._incomplete(partners):
                self._counters.unpaired += 1 + sum(p is not None for p in partners)
            else:
                yield self._bundle(stamp, image0, partners)
        self._forget()

    def _incomplete(self, partners: list[Any]) -> bool:
        """Whether the frame lacks an image that it needs: the first partner, unless that one is dead and
        something else tells how far things are."""
        if not partners or partners[0] is not None:
            return False
        other = partners[-1] is not None or (self._imu is not None and not self._dead(self._imu))
        return not (other and self._dead(self._partners[0]))

    def _settled(self, stamp: int) -> bool:
        """Whether waiting longer can change nothing in the frame at `stamp`, or has lasted too long."""
        if self._now >= stamp + self._wait + self._tolerance + self._ahead:
            return True
        return (
            self._images.reached >= stamp
            and all(self._has_partner(buffer, stamp) for buffer in self._partners)
            and self._imu_reached(stamp + self._shift)
        )

    def _has_partner(self, buffer: _Buffer, stamp: int) -> bool:
        """The partner is there, or it will not come any more."""
        if buffer.reached > stamp + self._tolerance:
            return True
        if self._dead(buffer):
            return True
        at = bisect_left(buffer.items, stamp - self._tolerance, key=itemgetter(0))
        return at < len(buffer.items) and buffer.items[at][0] <= min(stamp + self._tolerance, buffer.reached)

    def _imu_reached(self, stamp: int) -> bool:
        """The first sample from `stamp` on is there, and none can come before it."""
        imu = self._imu
        if imu is None or imu.taken >= stamp:
            return True
        first = imu.first_from(stamp)
        return (first is not None and imu.reached >= first) or self._dead(imu)

    def _dead(self, buffer: _Buffer) -> bool:
        """It is silent for so long that nobody waits for it any more."""
        return buffer.died or self._now - max(buffer.newest, self._first) > _DEAD * self._wait

    def _partner(self, buffer: _Buffer, stamp: int) -> Any | None:
        """The first image within the tolerance. Those before it have missed their frame."""
        self._counters.unpaired += len(buffer.pop_until(stamp - self._tolerance - 1))
        if buffer.items and buffer.items[0][0] <= stamp + self._tolerance:
            return buffer.pop_until(buffer.items[0][0])[0][1]
        return None

    def _bundle(self, stamp: int, image0: LazyImage, partners: list[Any]) -> Bundle:
        step = 0 if self._last is None else stamp - self._last
        gap = step if step > self._gap else 0
        images = dict(zip([name for name in (CAM1, DEPTH) if name in self.buffers], partners, strict=True))
        bundle = Bundle(
            stamp_ns=stamp,
            index=self._counters.frames,
            image0=image0,
            image1=images.get(CAM1),
            depth=images.get(DEPTH),
            imu=self._take_imu(stamp + self._shift),
            gap_ns=gap,
        )
        self._last = stamp
        self._counters.frames += 1
        self._counters.gaps += gap > 0
        return bundle

    def _take_imu(self, stamp: int) -> ImuBatch:
        """Samples since the frame before, until the first that is not before `stamp`."""
        imu = self._imu
        if imu is None:
            return ImuBatch.empty()
        self._counters.imu_dropped += len(imu.pop_until(stamp - self._keep))
        if imu.taken >= stamp:  # the frame before has the first after both
            return ImuBatch.empty()
        first = imu.first_from(stamp)
        batch = self._measured(imu.pop_until(stamp if first is None or first > stamp + self._wait else first))
        self._counters.imu_samples += len(batch)
        self._counters.imu_silent += not len(batch)
        return batch

    def _measured(self, samples: list[tuple[int, Any]]) -> ImuBatch:
        """Those that are measurements."""
        if not samples:
            return ImuBatch.empty()
        stamps, table = np.array([s for s, _ in samples], np.int64), np.array([v for _, v in samples], float)
        good = self._check.believed(stamps, table)
        self._counters.imu_out_of_range = self._check.out_of_range
        self._counters.imu_spikes = self._check.spikes
        if not good.all():
            stamps, table = stamps[good], table[good]
        return ImuBatch(stamps, table[:, :3], table[:, 3:])

    def _forget(self) -> None:
        """Drop what no frame can want any more, so that a stream without frames does not fill memory."""
        oldest = self._now - 2 * (self._wait + self._tolerance) - self._ahead
        for buffer in self._partners:
            if buffer.items and buffer.items[0][0] < oldest:
                self._counters.unpaired += len(buffer.pop_until(oldest))
        if self._imu and self._imu.items and self._imu.items[0][0] < oldest - self._keep:
            self._counters.imu_dropped += len(self._imu.pop_until(oldest - self._keep))


def _ns(ms: float) -> int:
    return int(ms * 1e6)
