"""Measurements of a live camera, with a watchdog that resets and reconnects it.

device threads -> bounded queue -> reader's thread: repair stamps, join the IMU's streams; watchdog,
reconnection
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from share.cameras.sample_queue import SampleQueue
from share.errors import NotAttachedError, ShareError
from share.geometry.camera import Rig
from share.sensors.measurement import CAM0, Measurement
from share.sensors.sample_processor import DeviceSample, SampleProcessor
from share.sensors.watchdog import Action, Health, Watchdog
from share.timing import PeriodicTimer

_TICK_S = 0.1
_RATE_WINDOW_S = 1.0
_MAX_ARRIVALS = 1000  # newest images with a known arrival
_MIN_HOST_STAMPS = 30  # stamps of the host's clock in one stream before a warning; fewer are exceptions
_ACTION_NOTICES = {
    Action.RESET: "{silent}: no samples; resetting the camera once",
    Action.GO_WITHOUT: "{silent}: still no samples; {health}: continuing without",
    Action.RECOVERED: "{silent}: samples come again",
}
_GIVE_UP_NOTICE = (
    "camera {serial}: {silent}: no sample, not even after a hardware reset; unplug it and plug it in again, "
    "if need be with another cable or port"
)


class CameraDevice(Protocol):
    """A connected camera, such as `share.cameras.realsense.camera.RealSenseCamera`."""

    @property
    def rig(self) -> Rig: ...

    @property
    def serial(self) -> str: ...

    @property
    def rates_hz(self) -> Mapping[str, float]: ...

    def start(self, sink: Callable[[DeviceSample], None]) -> None: ...

    def stop(self) -> None: ...

    def reset(self) -> None: ...


Connect = Callable[[str | None, int], CameraDevice]  # (serial number or None for any, earlier attempts)
MakeWatchdog = Callable[[int, Collection[str]], Watchdog]


class CameraFeed:
    """A camera's measurements. Call `open`, read `measurements` in one thread, and `stop` from any; the
    reader's thread then disconnects the camera.

    notify: called with a line for each event of the camera.
    """

    def __init__(
        self,
        connect: Connect,
        serial: str | None,
        rates_hz: Mapping[str, float],
        notify: Callable[[str], None],
        queue: SampleQueue,
        watchdog: MakeWatchdog = Watchdog,
    ) -> None:
        """rates_hz: expected rate of each stream, until the device reports its own."""
        self._connect, self._notify, self.queue = connect, notify, queue
        self.serial, self.processor = serial, SampleProcessor(rates_hz)
        self._watchdog = watchdog(time.monotonic_ns(), rates_hz)
        self.has_failed = False  # a required stream never came
        self._tick = PeriodicTimer(_TICK_S)
        self._stop = threading.Event()
        self._device: CameraDevice | None = None
        self._last_sample_ns: dict[str, int] = {}
        self._attempts = self._notified_restarts = 0
        self._notified_reasons: set[str] = set()  # reported failures to reopen the camera
        self._has_warned_clocks = False  # that some streams carry the host's clock
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=_MAX_ARRIVALS)  # stamp, arrival of cam0
        self._rate_meter = RateMeter()

    def open(self) -> Rig:
        """Connect and start the camera; samples wait in the queue. Raises UsageError, ShareError,
        DataError."""
        device = self._connect(self.serial, 0)
        rig, self.serial = device.rig, device.serial
        self.processor = SampleProcessor(device.rates_hz)
        device.start(self._receive)
        self._device = device
        self._watchdog.record_connect(time.monotonic_ns())
        return rig

    def measurements(self) -> Iterator[Measurement]:
        """Yield measurements until stopped, those that wait in the queue included. Raises ShareError if a
        required stream never comes (`has_failed`)."""
        try:
            while not self.queue.is_drained:
                self._poll_watchdog()
                sample = self.queue.get(_TICK_S)
                if sample is not None:
                    yield from self._process(sample)
            yield from self.processor.flush()
        finally:
            self.close()

    def stop(self) -> None:
        """Request the end. Safe from any thread and from a signal handler."""
        self._stop.set()

    def close(self) -> None:
        """Disconnect the camera; queued samples can still be read. Call in the reader's thread, or before any
        reading."""
        if self._device is not None:
            self._device.stop()
        self._device = None
        self.queue.close()

    def arrived_ns(self, stamp_ns: int) -> int:
        """Return the arrival of cam0's image of that stamp on the host's monotonic clock; now, if unknown."""
        known = (arrived for stamp, arrived in reversed(self._arrivals) if stamp == stamp_ns)
        return next(known, time.monotonic_ns())

    @property
    def health(self) -> Health:
        return self._watchdog.health

    @property
    def image_ns(self) -> int | None:
        """Arrival of cam0's newest image, read or not, on the host's monotonic clock; None before the
        first."""
        return self._last_sample_ns.get(CAM0)

    @property
    def images_dropped(self) -> int:
        """Number of cam0 images dropped for newer ones because the reader was too slow."""
        return self.queue.dropped.get(CAM0, 0)

    @property
    def trouble(self) -> str:
        """What is wrong with the camera now, "" if nothing."""
        health = self.health
        if health is Health.AWAY:
            return "the camera is disconnected"
        return "" if health is Health.OK else f"the camera gives no {', '.join(self._watchdog.excluded)}"

    def status(self) -> FeedStatus:
        """Return the status for a live line."""
        streams = self.processor.streams
        return FeedStatus(
            health=self.health,
            rates_hz=self._rate_meter.update(
                {name: gaps.samples for name, gaps in streams.items()}, time.monotonic()
            ),
            missing=sum(gaps.missing for gaps in streams.values()),
            dropped=sum(self.queue.dropped.values()),
            queue=len(self.queue),
        )

    def report(self) -> dict[str, Any]:
        """Return counts of samples, repairs and losses."""
        return feed_report(self.processor, self.queue.dropped, self._watchdog)

    def _receive(self, sample: DeviceSample) -> None:
        """Called in the device's threads."""
        self._last_sample_ns[sample.stream] = time.monotonic_ns()
        self.queue.put(sample)

    def _process(self, sample: DeviceSample) -> Iterator[Measurement]:
        for measurement in self.processor.feed(sample):
            if measurement.stream == CAM0:
                self._arrivals.append((measurement.stamp_ns, sample.arrived_ns))
            yield measurement
        if self.processor.restarts > self._notified_restarts:
            self._notified_restarts = self.processor.restarts
            self._notify("the camera's clock restarted; a new segment begins")
        if not self._has_warned_clocks and max(self.processor.placed_by_arrival.values()) >= _MIN_HOST_STAMPS:
            self._has_warned_clocks = True
            self._notify(_describe_clocks(self.processor.placed_by_arrival))

    def _poll_watchdog(self) -> None:
        """Feed the watchdog and execute its action."""
        if self._stop.is_set():
            self.close()
        if self.queue.is_closed or not self._tick.fire_if_due(time.monotonic_ns()):
            return
        if self._device is not None:
            for stream, now_ns in list(self._last_sample_ns.items()):
                self._watchdog.record_sample(stream, now_ns)
        self._execute(self._watchdog.tick(time.monotonic_ns()))

    def _execute(self, action: Action) -> None:
        if action is Action.NOTHING:  # ten times a second
            return
        details = {
            "silent": ", ".join(self._watchdog.silent),
            "health": self.health.value,
            "serial": self.serial,
        }
        if action in _ACTION_NOTICES:
            self._notify(_ACTION_NOTICES[action].format(**details))
        if action is Action.RESET and self._device is not None:
            self._device.reset()
            self._device = None
        if action is Action.RECONNECT:
            self._reconnect()
        if action is Action.GIVE_UP:
            self.has_failed = True
            raise ShareError(_GIVE_UP_NOTICE.format(**details))

    def _reconnect(self) -> None:
        if self._device is not None:
            silent = ", ".join(self._watchdog.silent)
            self._notify(f"{silent}: no more samples; waiting for camera {self.serial} to come back")
            self._device.stop()
            self._device = None
        self._attempts += 1
        try:
            device = self._connect(self.serial, self._attempts)
            device.start(self._receive)
        except ShareError as error:
            self._notify_reason(error)
            self._watchdog.record_disconnect(time.monotonic_ns())
            return
        self._device = device
        self._notified_reasons.clear()
        self._watchdog.record_connect(time.monotonic_ns())
        self._notify(f"camera {self.serial} is connected again; a new segment begins")

    def _notify_reason(self, error: ShareError) -> None:
        """Report once each reason but absence why the camera cannot be reopened."""
        if not isinstance(error, NotAttachedError) and str(error) not in self._notified_reasons:
            self._notified_reasons.add(str(error))
            self._notify(str(error))


def _describe_clocks(placed_by_arrival: Mapping[str, int]) -> str:
    """Describe which streams carry the host's clock. placed_by_arrival: number of such samples by stream."""
    host_streams, device_streams = (
        ", ".join(n for n, count in placed_by_arrival.items() if bool(count) is host)
        for host in (True, False)
    )
    return (
        f"{host_streams} carry the host's clock, {device_streams} the camera's: "
        "kernel patch missing, see docs/do/record.md"
    )


@dataclass(frozen=True)
class FeedStatus:
    """Status for a live line. rates_hz: of each stream over the last second. missing, dropped: samples so
    far. queue: samples that wait."""

    health: Health
    rates_hz: dict[str, float]
    missing: int
    dropped: int
    queue: int

    def __str__(self) -> str:
        rates = " ".join(f"{name} {hz:.0f}" for name, hz in self.rates_hz.items())
        counts = f"missing {self.missing}  dropped {self.dropped}  queue {self.queue}"
        return f"{self.health.value}  {rates} Hz  {counts}"


class RateMeter:
    """Converts counts to rates over about a second."""

    def __init__(self) -> None:
        self._previous: tuple[float, Mapping[str, int]] | None = None
        self._rates: dict[str, float] = {}

    def update(self, counts: Mapping[str, int], now_s: float) -> dict[str, float]:
        """Return rates by name, Hz; 0 in the first second."""
        if self._previous is None:
            self._previous, self._rates = (now_s, counts), dict.fromkeys(counts, 0.0)
        since_s, before = now_s - self._previous[0], self._previous[1]
        if since_s >= _RATE_WINDOW_S:
            self._rates = {name: (count - before.get(name, 0)) / since_s for name, count in counts.items()}
            self._previous = (now_s, counts)
        return self._rates


def feed_report(processor: SampleProcessor, dropped: Mapping[str, int], watchdog: Watchdog) -> dict[str, Any]:
    """Return counts of samples, repairs and losses as plain data (docs/do/record.md)."""
    streams = {
        name: {
            "samples": gaps.samples,
            "seconds": round(gaps.seconds, 3),
            "gaps": gaps.gaps,
            "missing": gaps.missing,
            "backward": gaps.backward,
            "dropped": dropped.get(name, 0),
        }
        for name, gaps in processor.streams.items()
    }
    return {
        "streams": streams,
        "imu": processor.imu_interpolator.interpolated,
        "segments": processor.segments,
        "reconnections": watchdog.reconnections,
        "resets": watchdog.resets,
        "health": watchdog.health.value,
        **processor.counts(),
    }
