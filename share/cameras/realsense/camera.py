"""A RealSense camera: connect, read, disconnect; as a feed of samples and as a live source."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import Any

from share.cameras.feed import CameraFeed
from share.cameras.live import MAX_WAITING_FRAMES, LiveSource
from share.cameras.realsense.devices import choose_device, list_devices, load_sdk, parse_serial, sdk_errors
from share.cameras.realsense.streams import (
    OpenedSensor,
    StreamRequest,
    choose_streams,
    factory_rig,
    has_dots,
    stream_rates_hz,
    to_sample,
)
from share.cameras.sample_queue import NewestImageQueue, SampleQueue
from share.errors import ShareError
from share.geometry.camera import Rig
from share.recordings.calibration import Calibration
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.sensors.sample_processor import ACCEL, GYRO, DeviceSample

_QUEUE_FRAMES = {True: 2000, False: 32}  # SDK frames that may wait, of the IMU and of images
_WAIT_MS = 100
_DEFAULT_DEPTH_UNIT_M = 0.001
_UNKNOWN_DOTS_WARNING = (
    "emitter interleaved: images do not show which of them have dots, so all are kept: kernel patch missing, "
    "see docs/do/record.md"
)
_DOTS_WARNING = "the emitter is on although it was switched off: its dots harm tracking; replug the camera"
_MIN_DOTTED_IMAGES = 30  # with dots and none without: the emitter does not alternate
_ALWAYS_DOTS_WARNING = (
    "emitter interleaved: all images have dots, so none is kept; use a profile with emitter off"
)

Sink = Callable[[DeviceSample], None]


class RealSenseCamera:
    """A connected camera. `start` reads it, with one thread per sensor.

    Context manager; leaving it disconnects. Frames come through the sensors' `frame_queue`s, since the SDK's
    pipeline loses IMU samples. dotted_images: number of images dropped for their dots. notify: called from
    any thread with warnings for the user. Raises UsageError if no such camera is usable, ShareError if it
    cannot be opened.
    """

    def __init__(
        self,
        request: StreamRequest,
        serial: str | None = None,
        context: Any = None,
        epoch: int = 0,
        notify: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._rs = rs = load_sdk()
        self._request, self._epoch, self._notify = request, epoch, notify
        with sdk_errors(f"RealSense camera {serial or ''}".rstrip()):
            self._context = rs.context() if context is None else context
            self._device = choose_device(list_devices(rs, self._context), serial, request.profile.device)
            self._sensors = choose_streams(rs, self._device.handle, request)
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self.dotted_images = 0
        self._has_dark_image = False  # an image without dots came
        self._image_count = 0
        self._notified = set[str]()

    @property
    def serial(self) -> str:
        """Serial number."""
        return self._device.serial

    @property
    def rates_hz(self) -> dict[str, float]:
        """Rate of each stream that is read."""
        return stream_rates_hz(self._sensors, self._request)

    @property
    def _label(self) -> str:
        return f"{self._device.name} {self.serial}"

    @property
    def rig(self) -> Rig:
        """The factory calibration with the profile's IMU noise; the profile's rig if no images are read.

        Raises ShareError, DataError.
        """
        profile_rig = self._request.profile.rig()
        if profile_rig.imu is not None:
            profile_rig = replace(profile_rig, imu=replace(profile_rig.imu, rate_hz=self.rates_hz[GYRO]))
        profiles = {name: profile for one in self._sensors for name, profile in one.profiles.items()}
        if CAM0 not in profiles:
            return profile_rig
        with sdk_errors(self._label):
            return factory_rig(self._rs, profiles, profile_rig.imu)

    def start(self, sink: Sink) -> None:
        """Start reading; `sink` is called with samples from several threads. Raises ShareError."""
        for name, stated_hz in self._request.rates_hz().items():
            if abs(self.rates_hz[name] - stated_hz) > 1:
                self._notify(
                    f"the camera has no {name} at {stated_hz:g} Hz; using {self.rates_hz[name]:g} Hz"
                )
        for one in self._sensors:
            is_imu = GYRO in one.profiles or ACCEL in one.profiles
            queue = self._rs.frame_queue(_QUEUE_FRAMES[is_imu], True)
            try:
                with sdk_errors(self._label):
                    self._configure(one.sensor)
                    one.sensor.open(list(one.profiles.values()))
                    one.sensor.start(queue)
                    unit = _depth_unit(one)
            except ShareError:
                self.stop()
                raise
            thread = threading.Thread(target=self._read_loop, args=(queue, sink, unit), daemon=True)
            thread.start()
            self._threads.append(thread)

    def stop(self) -> None:
        """Stop reading and disconnect. May be repeated."""
        self._stop.set()
        for one in self._sensors:
            with contextlib.suppress(RuntimeError):  # disconnected, or never started
                one.sensor.stop()
            with contextlib.suppress(RuntimeError):
                one.sensor.close()
        for thread in self._threads:
            thread.join(timeout=2)
        self._threads = []

    def reset(self) -> None:
        """Reset the hardware: the device disconnects and comes back after some seconds."""
        self.stop()
        with contextlib.suppress(RuntimeError):
            self._device.handle.hardware_reset()

    def __enter__(self) -> RealSenseCamera:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _configure(self, sensor: Any) -> None:
        """Set a sensor's options as far as it has them: emitter by the profile, device clock for stamps."""
        option, emitter = self._rs.option, self._request.profile.device.emitter
        dots = {
            "off": {option.emitter_on_off: 0, option.emitter_enabled: 0},  # another program may have set it
            "on": {option.emitter_enabled: 1, option.emitter_on_off: 0},
            "interleaved": {option.emitter_enabled: 1, option.emitter_on_off: 1},
            "none": {},
        }[emitter]
        for name, value in ({option.global_time_enabled: 0} | dots).items():
            if not sensor.supports(name):
                continue
            try:
                sensor.set_option(name, value)
            except RuntimeError:
                if name != option.emitter_on_off or value:  # off is the default, and dots are reported
                    raise

    def _read_loop(self, queue: Any, sink: Sink, depth_unit_m: float) -> None:
        while not self._stop.is_set():
            has_frame, frame = queue.try_wait_for_frame(_WAIT_MS)
            if not has_frame:
                continue
            try:
                sample = to_sample(self._rs, frame, depth_unit_m, time.monotonic_ns(), self._epoch)
                accepted = self._without_dots(sample, frame)
            except RuntimeError as error:  # affects this frame; if all fail, the watchdog acts
                self._notify_once(f"a frame cannot be read: {str(error).partition(chr(10))[0]}")
                continue
            if accepted is not None:
                sink(accepted)

    def _without_dots(self, sample: DeviceSample, frame: Any) -> DeviceSample | None:
        """Return the sample, or None for an image with dots while the emitter alternates."""
        emitter = self._request.profile.device.emitter
        if sample.stream not in (CAM0, CAM1) or emitter not in ("interleaved", "off"):
            return sample
        if emitter == "off":
            self._image_count += 1
            is_due = self._image_count % _MIN_DOTTED_IMAGES == 1  # reading metadata takes time
            if is_due and has_dots(self._rs, frame):
                self._notify_once(_DOTS_WARNING)
            return sample
        dots = has_dots(self._rs, frame)
        if dots is None:
            self._notify_once(_UNKNOWN_DOTS_WARNING)
        self.dotted_images += bool(dots)
        self._has_dark_image = self._has_dark_image or not dots
        if self.dotted_images >= _MIN_DOTTED_IMAGES and not self._has_dark_image:
            self._notify_once(_ALWAYS_DOTS_WARNING)
        # The frame number also counts images with dots, which must not count as missing.
        return None if dots else replace(sample, number=None)

    def _notify_once(self, text: str) -> None:
        if text not in self._notified:
            self._notified.add(text)
            self._notify(text)


def _depth_unit(one: OpenedSensor) -> float:
    """Return the size of one depth step, m."""
    depth = DEPTH in one.profiles and one.sensor.is_depth_sensor()
    return float(one.sensor.as_depth_sensor().get_depth_scale()) if depth else _DEFAULT_DEPTH_UNIT_M


def make_feed(
    spec: str,
    request: StreamRequest,
    notify: Callable[[str], None],
    queue: SampleQueue,
) -> CameraFeed:
    """Return the camera's feed, not yet opened."""
    return CameraFeed(
        lambda serial, epoch: RealSenseCamera(request, serial, epoch=epoch, notify=notify),
        parse_serial(spec),
        request.rates_hz(),
        notify,
        queue,
    )


def open_live(
    spec: str,
    request: StreamRequest,
    notify: Callable[[str], None],
    calibration: Calibration | None = None,
) -> LiveSource:
    """Open the camera as a source, with `calibration` or else the factory's.

    Raises UsageError, ShareError, DataError.
    """
    rates = request.rates_hz()
    queue = NewestImageQueue(MAX_WAITING_FRAMES * len(request.cameras))
    feed = make_feed(spec, request, notify, queue)
    return LiveSource(feed, rates[CAM0], calibration, request.imu_range())
