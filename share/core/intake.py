"""Samples as a device gives them to measurements in one time that only goes forward."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from share.core.gaps import Gaps
from share.core.inertial_join import InertialJoin
from share.core.measurement import IMU, Measurement
from share.core.stamps import StampRepair

ACCEL, GYRO = "accel", "gyro"
_ACCEL_GAP = 3.5  # expected steps of the accelerometer over which it is not interpolated


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One sample as it left the device. payload: a LazyImage, or three values of accel or gyro.

    number: of the frame, as the device counts, None if it does not. hardware: whether the stamp is of the
    device's own clock. arrived_ns: on the host's monotonic clock. epoch: how often the device was
    opened before; its clock may have begun anew.
    """

    stream: str
    stamp_ns: int
    payload: Any
    arrived_ns: int
    number: int | None = None
    hardware: bool = True
    epoch: int = 0


@dataclass
class _Clock:
    """Of one epoch: the repair of its stamps, and what turns them into the time of the recording."""

    repair: StampRepair
    offset_ns: int = 0


class Intake:
    """Repairs stamps, joins accel and gyro, counts. Pure: no clock but what the samples say.

    After a reconnection time goes on by as much as the host's clock went on. `foreign` counts samples
    whose stamps are not of the device's clock: they are used, but a person has to know; `wraps`, `jumps`,
    `strays` and `past` are those of `StampRepair`; `streams` has the gaps of every stream of the device.
    """

    def __init__(self, rates_hz: Mapping[str, float], max_jump_s: float) -> None:
        """rates_hz: of every stream that is expected."""
        self.foreign = self.stretches = 0
        self.streams = {stream: Gaps(rate) for stream, rate in rates_hz.items()}
        gap_s = _ACCEL_GAP / rates_hz.get(ACCEL, 1.0)
        self.join = InertialJoin(int(gap_s * 1e9))
        self._max_jump_s = max_jump_s
        self._epoch = -1
        self._clocks: list[_Clock] = []
        self._last: tuple[int, int] | None = None  # (stamp, arrived) of the newest sample

    def feed(self, sample: Sample) -> Iterator[Measurement]:
        """What may now be used: mostly this sample, perhaps none or several."""
        if sample.epoch != self._epoch:
            self._begin(sample)
        self.foreign += not sample.hardware
        clock = self._clocks[-1]
        raw = Measurement(sample.stream, sample.stamp_ns, sample)
        for stamp, measurement in clock.repair.feed(raw):
            yield from self._use(stamp + clock.offset_ns, measurement.payload)

    def counts(self) -> dict[str, int]:
        """What was repaired or left out, by name."""
        repairs = [clock.repair for clock in self._clocks]
        names = ("wraps", "jumps", "strays", "past")
        out = {name: sum(getattr(repair, name) for repair in repairs) for name in names}
        return out | {"foreign": self.foreign, "imu_alone": self.join.alone}

    def _begin(self, sample: Sample) -> None:
        clock = _Clock(StampRepair(self._max_jump_s))
        if self._last is not None:
            stamp, arrived = self._last
            clock.offset_ns = stamp + (sample.arrived_ns - arrived) - sample.stamp_ns
        self._clocks.append(clock)
        self._epoch = sample.epoch
        self.stretches += 1

    def _use(self, stamp: int, sample: Sample) -> Iterator[Measurement]:
        gaps = self.streams.get(sample.stream)
        if gaps is None or not gaps.feed(stamp, sample.number):
            return
        if self._last is None or stamp > self._last[0]:
            self._last = (stamp, sample.arrived_ns)
        if sample.stream == GYRO:
            joined = self.join.gyro(stamp, sample.payload)
        elif sample.stream == ACCEL:
            joined = self.join.accel(stamp, sample.payload)
        else:
            yield Measurement(sample.stream, stamp, sample.payload)
            return
        yield from (Measurement(IMU, at, values) for at, values in joined)
