"""Turn a device's raw samples into measurements on one clock that only goes forward."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from share.sensors.measurement import IMU, Measurement
from share.sensors.stamps import ClockRestartDetector, GapCounter, StampRepair

ACCEL, GYRO = "accel", "gyro"
_MAX_ACCEL_GAP_STEPS = 3.5  # accelerometer steps; no interpolation over more
_PLACED_HISTORY = 8  # stamps placed by arrival that are kept, so that both images of a pair get the same one
_DEVICE_CLOCK_WAIT_NS = 10**9  # how long host-stamped samples wait for a device-stamped one


@dataclass(frozen=True, slots=True, eq=False)
class DeviceSample:
    """One sample as the device delivered it. payload: a LazyImage, or three values of accel or gyro.

    number: the device's frame number, None if it has none. is_device_clock: stamp_ns is of the device's
    clock, else of the host's. arrived_ns: on the host's monotonic clock. epoch: how often the device was
    opened before; its clock may have restarted.
    """

    stream: str
    stamp_ns: int
    payload: Any
    arrived_ns: int
    number: int | None = None
    is_device_clock: bool = True
    epoch: int = 0


@dataclass
class _Clock:
    """The stamp repair of one epoch, and the offset from its stamps to the recording's time."""

    repair: StampRepair
    offset_ns: int = 0


class SampleProcessor:
    """Repairs stamps, joins accel and gyro, counts losses. Pure: no clock but the samples' own.

    After a reconnection, or when the device's clock restarts without one (`restarts`), a new segment begins,
    and time advances by as much as the host's clock did. `host_stamped` counts samples with stamps of
    the host's clock: they are used, but reported. `streams` has a `GapCounter` for each stream.

    One repair never mixes the two clocks. Among device-stamped samples, a host-stamped one is placed by its
    arrival (`placed_by_arrival`, by stream); if the device has no clock, the host's is used for all.
    """

    def __init__(self, rates_hz: Mapping[str, float]) -> None:
        """rates_hz: expected rate of each stream."""
        self.host_stamped = self.segments = self.restarts = 0
        self.placed_by_arrival = dict.fromkeys(rates_hz, 0)
        self.streams = {stream: GapCounter(rate) for stream, rate in rates_hz.items()}
        gap_s = _MAX_ACCEL_GAP_STEPS / rates_hz.get(ACCEL, 1.0)
        self.imu_interpolator = ImuInterpolator(int(gap_s * 1e9))
        self._time_source: tuple[int, bool] | None = None  # epoch, is_device_clock
        self._clocks: list[_Clock] = []
        self._waiting: list[DeviceSample] = []  # host-stamped, until a device-stamped one comes
        self._recent_placed: deque[tuple[int, int]] = deque(
            maxlen=_PLACED_HISTORY
        )  # (raw stamp, placed stamp)
        self._restart_detector = ClockRestartDetector()
        self._newest: tuple[int, int] | None = None  # (stamp, arrived) of the newest sample

    def feed(self, sample: DeviceSample) -> Iterator[Measurement]:
        """Add a sample; yield the measurements that are now ready: usually one, none or several."""
        if sample.stream not in self.streams or (self._time_source and sample.epoch < self._time_source[0]):
            return  # unexpected stream, or left over from before a reconnection
        self.host_stamped += not sample.is_device_clock
        if sample.is_device_clock or (self._time_source is not None and not self._time_source[1]):
            yield from self._process_timed(sample)
        elif self._newest is not None:
            yield from self._place_by_arrival(sample, *self._newest)
        else:
            self._waiting.append(sample)
            if sample.arrived_ns - self._waiting[0].arrived_ns > _DEVICE_CLOCK_WAIT_NS:
                yield from self.flush()

    def flush(self) -> Iterator[Measurement]:
        """Give up waiting for the device's clock: use the host's for all waiting samples."""
        waiting, self._waiting = self._waiting, []
        for sample in waiting:
            yield from self._process_timed(sample)

    def _process_timed(self, sample: DeviceSample) -> Iterator[Measurement]:
        """Process a sample stamped by the clock in use."""
        if (sample.epoch, sample.is_device_clock) != self._time_source:
            self._start_segment(sample)
        clock = self._clocks[-1]
        past = clock.repair.past
        for stamp, measurement in self._repair(sample):
            yield from self._accept(stamp, measurement.payload)
        if clock.repair.past > past:
            self._reject(sample)

    def _place_by_arrival(self, sample: DeviceSample, last_ns: int, arrived_ns: int) -> Iterator[Measurement]:
        """Stamp a sample as long after the latest device-stamped one as it arrived after that."""
        stamp = next((placed for raw, placed in self._recent_placed if raw == sample.stamp_ns), None)
        if stamp is None:  # else take the stamp of its partner image
            stamp = last_ns + sample.arrived_ns - arrived_ns
            self._recent_placed.append((sample.stamp_ns, stamp))
        if self.streams[sample.stream].feed(stamp, sample.number):
            self.placed_by_arrival[sample.stream] += 1
            yield from self._deliver(stamp, sample)

    def _repair(self, sample: DeviceSample) -> Iterator[tuple[int, Measurement]]:
        clock = self._clocks[-1]
        raw = Measurement(sample.stream, sample.stamp_ns, sample)
        return ((stamp + clock.offset_ns, usable) for stamp, usable in clock.repair.feed(raw))

    def counts(self) -> dict[str, int]:
        """Return the counts of repaired and rejected samples, by name."""
        repairs = [clock.repair for clock in self._clocks]
        names = ("wraps", "jumps", "strays", "past")
        out = {name: sum(getattr(repair, name) for repair in repairs) for name in names}
        return out | {
            "restarts": self.restarts,
            "foreign": self.host_stamped,
            "imu_alone": self.imu_interpolator.unmatched,
        }

    def _start_segment(self, sample: DeviceSample) -> None:
        clock = _Clock(StampRepair())
        if self._newest is not None:
            stamp, arrived = self._newest
            clock.offset_ns = stamp + (sample.arrived_ns - arrived) - sample.stamp_ns
        self._clocks.append(clock)
        self._time_source = (sample.epoch, sample.is_device_clock)
        self._waiting = []  # their stamps are of another clock
        self._restart_detector.accept()
        self.segments += 1

    def _reject(self, sample: DeviceSample) -> None:
        """Count a stamp in the past. If stamps stay in the past, the next sample begins a new segment."""
        if self._restart_detector.reject(sample.stream, sample.stamp_ns):
            self.restarts += 1
            self._start_segment(sample)

    def _accept(self, stamp: int, sample: DeviceSample) -> Iterator[Measurement]:
        if not self.streams[sample.stream].feed(stamp, sample.number):
            self._reject(sample)
            return
        self._restart_detector.accept()
        if self._newest is None or stamp > self._newest[0]:
            self._newest = (stamp, sample.arrived_ns)
        yield from self._deliver(stamp, sample)

    def _deliver(self, stamp: int, sample: DeviceSample) -> Iterator[Measurement]:
        """Yield the measurements of a sample in order: an image as it is, IMU samples joined."""
        if sample.stream == GYRO:
            joined = self.imu_interpolator.add_gyro(stamp, sample.payload)
        elif sample.stream == ACCEL:
            joined = self.imu_interpolator.add_accel(stamp, sample.payload)
        else:
            yield Measurement(sample.stream, stamp, sample.payload)
            return
        yield from (Measurement(IMU, joined_stamp, values) for joined_stamp, values in joined)


# ---- Joining accelerometer and gyroscope

Vector3 = Sequence[float]
Vector6 = list[float]


class ImuInterpolator:
    """Joins both into one IMU stream: the accelerometer is interpolated linearly at the gyroscope's stamps.

    Nothing is extrapolated: a gyroscope sample waits for the next accelerometer sample, max_wait_ns at most.
    Gyroscope samples in an accelerometer gap longer than max_gap_ns are dropped. `interpolated` counts joined
    samples, `unmatched` dropped ones. Each stream must be in order; the two may be out of step.
    """

    def __init__(self, max_gap_ns: int, max_wait_ns: int = 10**9) -> None:
        self.interpolated = self.unmatched = 0
        self._max_gap_ns, self._max_wait_ns = max_gap_ns, max_wait_ns
        self._waiting_gyro: deque[tuple[int, Vector3]] = deque()
        self._accel: deque[tuple[int, Vector3]] = (
            deque()
        )  # the last one before the waiting gyro, and later ones

    def add_gyro(self, stamp_ns: int, rates: Vector3) -> Iterator[tuple[int, Vector6]]:
        """Add a sample (3,) rad/s; yield (stamp_ns, (wx wy wz ax ay az)) for each sample now joined."""
        self._waiting_gyro.append((stamp_ns, rates))
        while stamp_ns - self._waiting_gyro[0][0] > self._max_wait_ns:
            self._waiting_gyro.popleft()
            self.unmatched += 1
        yield from self._interpolate_ready()

    def add_accel(self, stamp_ns: int, force: Vector3) -> Iterator[tuple[int, Vector6]]:
        """Add a sample (3,) m/s^2; yield as `add_gyro`."""
        self._accel.append((stamp_ns, force))
        while not self._waiting_gyro and self._accel[0][0] < stamp_ns - self._max_wait_ns:
            self._accel.popleft()
        yield from self._interpolate_ready()

    def _interpolate_ready(self) -> Iterator[tuple[int, Vector6]]:
        while self._waiting_gyro and self._accel and self._waiting_gyro[0][0] <= self._accel[-1][0]:
            stamp, rates = self._waiting_gyro.popleft()
            while len(self._accel) > 1 and self._accel[1][0] <= stamp:
                self._accel.popleft()
            force = self._interpolate_accel(stamp)
            if force is None:
                self.unmatched += 1
            else:
                self.interpolated += 1
                yield stamp, [*rates, *force]

    def _interpolate_accel(self, stamp: int) -> Vector6 | None:
        """Return the acceleration at `stamp`; None outside of the samples or in a gap."""
        before, a = self._accel[0]
        if before == stamp:
            return list(a)
        if before > stamp or self._accel[1][0] - before > self._max_gap_ns:
            return None
        after, b = self._accel[1]
        part = (stamp - before) / (after - before)
        return [(1 - part) * x + part * y for x, y in zip(a, b, strict=True)]
