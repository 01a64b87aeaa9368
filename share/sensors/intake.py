"""Samples as a device gives them to measurements in one time that only goes forward."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from share.sensors.measurement import IMU, Measurement
from share.sensors.stamps import Gaps, Restart, StampRepair

ACCEL, GYRO = "accel", "gyro"
_ACCEL_GAP = 3.5  # expected steps of the accelerometer over which it is not interpolated
_PARTNERS = 8  # placed stamps that are remembered, so that a pair stays one
_HOLD_NS = 10**9  # so long samples of the host's clock wait for one of the device's


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

    After a reconnection, and where the device's clock begins anew without one (`restarts`), a new stretch
    begins and time goes on by as much as the host's clock went on. `foreign` counts samples
    whose stamps are not of the device's clock: they are used, but a person has to know; `wraps`, `jumps`,
    `strays` and `past` are those of `StampRepair`; `streams` has the gaps of every stream of the device.

    The two clocks never meet in one repair. Among samples of the device's clock those of the host's are
    placed by when they arrived (`placed`, by stream); where the device has no clock, the host's is time.
    """

    def __init__(self, rates_hz: Mapping[str, float], max_jump_s: float) -> None:
        """rates_hz: of every stream that is expected."""
        self.foreign = self.stretches = self.restarts = 0
        self.placed = dict.fromkeys(rates_hz, 0)
        self.streams = {stream: Gaps(rate) for stream, rate in rates_hz.items()}
        gap_s = _ACCEL_GAP / rates_hz.get(ACCEL, 1.0)
        self.join = InertialJoin(int(gap_s * 1e9))
        self._max_jump_s = max_jump_s
        self._source: tuple[int, bool] | None = None  # of time: epoch, and whether it is the device's clock
        self._clocks: list[_Clock] = []
        self._held: list[Sample] = []  # of the host's clock, until the device's is known
        self._lately: deque[tuple[int, int]] = deque(maxlen=_PARTNERS)  # (stamp, where it was placed)
        self._restart = Restart()
        self._last: tuple[int, int] | None = None  # (stamp, arrived) of the newest sample

    def feed(self, sample: Sample) -> Iterator[Measurement]:
        """What may now be used: mostly this sample, perhaps none or several."""
        if sample.stream not in self.streams or (self._source and sample.epoch < self._source[0]):
            return  # not asked for, or left over from before a reconnection
        self.foreign += not sample.hardware
        if sample.hardware or (self._source is not None and not self._source[1]):
            yield from self._timed(sample)
        elif self._last is not None:
            yield from self._place(sample, *self._last)
        else:
            self._held.append(sample)
            if sample.arrived_ns - self._held[0].arrived_ns > _HOLD_NS:
                yield from self.end()

    def end(self) -> Iterator[Measurement]:
        """No sample of the device's clock comes: those that waited for one go by the host's."""
        held, self._held = self._held, []
        for sample in held:
            yield from self._timed(sample)

    def _timed(self, sample: Sample) -> Iterator[Measurement]:
        """A sample of the clock that is time."""
        if (sample.epoch, sample.hardware) != self._source:
            self._begin(sample)
        clock = self._clocks[-1]
        past = clock.repair.past
        for stamp, measurement in self._repaired(sample):
            yield from self._use(stamp, measurement.payload)
        if clock.repair.past > past:
            self._refuse(sample)

    def _place(self, sample: Sample, last_ns: int, arrived_ns: int) -> Iterator[Measurement]:
        """As long after the newest sample of the device's clock as it arrived after that."""
        stamp = next((at for raw, at in self._lately if raw == sample.stamp_ns), None)
        if stamp is None:  # else its partner was placed there
            stamp = last_ns + sample.arrived_ns - arrived_ns
            self._lately.append((sample.stamp_ns, stamp))
        if self.streams[sample.stream].feed(stamp, sample.number):
            self.placed[sample.stream] += 1
            yield from self._given(stamp, sample)

    def _repaired(self, sample: Sample) -> Iterator[tuple[int, Measurement]]:
        clock = self._clocks[-1]
        raw = Measurement(sample.stream, sample.stamp_ns, sample)
        return ((stamp + clock.offset_ns, usable) for stamp, usable in clock.repair.feed(raw))

    def counts(self) -> dict[str, int]:
        """What was repaired or left out, by name."""
        repairs = [clock.repair for clock in self._clocks]
        names = ("wraps", "jumps", "strays", "past")
        out = {name: sum(getattr(repair, name) for repair in repairs) for name in names}
        return out | {"restarts": self.restarts, "foreign": self.foreign, "imu_alone": self.join.alone}

    def _begin(self, sample: Sample) -> None:
        clock = _Clock(StampRepair(self._max_jump_s))
        if self._last is not None:
            stamp, arrived = self._last
            clock.offset_ns = stamp + (sample.arrived_ns - arrived) - sample.stamp_ns
        self._clocks.append(clock)
        self._source = (sample.epoch, sample.hardware)
        self._held = []  # from before the device's clock was known
        self._restart.used()
        self.stretches += 1

    def _refuse(self, sample: Sample) -> None:
        """Its stamp lies in the past. Where that goes on, the next sample begins a new stretch."""
        if self._restart.refused(sample.stream, sample.stamp_ns):
            self.restarts += 1
            self._begin(sample)

    def _use(self, stamp: int, sample: Sample) -> Iterator[Measurement]:
        if not self.streams[sample.stream].feed(stamp, sample.number):
            self._refuse(sample)
            return
        self._restart.used()
        if self._last is None or stamp > self._last[0]:
            self._last = (stamp, sample.arrived_ns)
        yield from self._given(stamp, sample)

    def _given(self, stamp: int, sample: Sample) -> Iterator[Measurement]:
        """A sample in order: an image as it is, the IMU's joined."""
        if sample.stream == GYRO:
            joined = self.join.gyro(stamp, sample.payload)
        elif sample.stream == ACCEL:
            joined = self.join.accel(stamp, sample.payload)
        else:
            yield Measurement(sample.stream, stamp, sample.payload)
            return
        yield from (Measurement(IMU, at, values) for at, values in joined)


# ---- Accelerometer and gyroscope with stamps of their own to one IMU stream, at the gyroscope's stamps.

Three = Sequence[float]
Six = list[float]


class InertialJoin:
    """Linear interpolation of the accelerometer between its neighbours; nothing is extrapolated.

    A gyroscope sample waits for the next accelerometer sample. Where the accelerometer has a gap longer
    than most_gap_ns, the samples in it are left out, so that a gap stays one. `joined` and `alone` (left
    out: no accelerometer on both sides) count samples. Each stream must come in order; the two may be
    out of step. At most most_wait_ns of the gyroscope is kept waiting.
    """

    def __init__(self, most_gap_ns: int, most_wait_ns: int = 10**9) -> None:
        self.joined = self.alone = 0
        self._most_gap_ns, self._most_wait_ns = most_gap_ns, most_wait_ns
        self._waiting: deque[tuple[int, Three]] = deque()  # gyro, later than the accel before
        self._accel: deque[tuple[int, Three]] = deque()  # the last one that is used up, and later ones

    def gyro(self, stamp_ns: int, rates: Three) -> Iterator[tuple[int, Six]]:
        """Feed one sample (3,) rad/s; gives (stamp_ns, (wx wy wz ax ay az)) of all that can be joined."""
        self._waiting.append((stamp_ns, rates))
        while stamp_ns - self._waiting[0][0] > self._most_wait_ns:
            self._waiting.popleft()
            self.alone += 1
        yield from self._join()

    def accel(self, stamp_ns: int, force: Three) -> Iterator[tuple[int, Six]]:
        """Feed one sample (3,) m/s^2; gives what `gyro` gives."""
        self._accel.append((stamp_ns, force))
        while not self._waiting and self._accel[0][0] < stamp_ns - self._most_wait_ns:
            self._accel.popleft()
        yield from self._join()

    def _join(self) -> Iterator[tuple[int, Six]]:
        while self._waiting and self._accel and self._waiting[0][0] <= self._accel[-1][0]:
            stamp, rates = self._waiting.popleft()
            while len(self._accel) > 1 and self._accel[1][0] <= stamp:
                self._accel.popleft()
            force = self._at(stamp)
            if force is None:
                self.alone += 1
            else:
                self.joined += 1
                yield stamp, [*rates, *force]

    def _at(self, stamp: int) -> Six | None:
        """The accelerometer at `stamp`, None outside of its samples or in a gap."""
        before, a = self._accel[0]
        if before == stamp:
            return list(a)
        if before > stamp or self._accel[1][0] - before > self._most_gap_ns:
            return None
        after, b = self._accel[1]
        part = (stamp - before) / (after - before)
        return [(1 - part) * x + part * y for x, y in zip(a, b, strict=True)]
