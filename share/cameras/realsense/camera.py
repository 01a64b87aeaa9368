"""One RealSense camera: connect, read, disconnect."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import Any

from share.cameras.realsense.devices import attached, choose, load_sdk, opening
from share.cameras.realsense.factory import factory_rig
from share.cameras.realsense.frames import has_dots, to_sample
from share.cameras.realsense.streams import Opened, Wanted, choose_streams, rates_hz
from share.errors import ShareError
from share.geometry.camera import Rig
from share.sensors.intake import ACCEL, GYRO, Sample
from share.sensors.measurement import CAM0, CAM1, DEPTH

_QUEUE = {True: 2000, False: 32}  # frames between the SDK and us: of the IMU, of images
_WAIT_MS = 100
_DEPTH_UNIT_M = 0.001
_UNKNOWN_DOTS = (
    "emitter interleaved: images do not tell which of them have dots, so all are kept: kernel patch missing, "
    "see docs/capture.md"
)
_DOTS = "the emitter is on though it was switched off: its dots spoil tracking; plug the camera in anew"
_MANY = 30  # images with dots and none without: it does not alternate
_NEVER_DARK = "emitter interleaved: all images have dots, so none is kept; use a profile with emitter off"

Sink = Callable[[Sample], None]


class RealSense:
    """A camera that is connected. `start` reads it in threads of its own, one for each sensor.

    Context manager; leaving it disconnects. Frames come through `frame_queue`s of the sensors and not
    by the SDK's pipeline, which loses IMU samples. `lit` counts images left out for their dots. `say` is
    told, in any thread, what a person has to know.
    Raises UsageError where no such camera can be used, ShareError where it cannot be opened.
    """

    def __init__(
        self,
        wanted: Wanted,
        serial: str | None = None,
        context: Any = None,
        epoch: int = 0,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._rs = rs = load_sdk()
        self._wanted, self._epoch, self._say = wanted, epoch, say
        with opening(f"RealSense camera {serial or ''}".rstrip()):
            self._context = rs.context() if context is None else context
            self._device = choose(attached(rs, self._context), serial, wanted.profile.device)
            self._opened = choose_streams(rs, self._device.handle, wanted)
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self.lit = 0
        self._dark = False  # whether an image without dots came
        self._images = 0
        self._told = set[str]()

    @property
    def serial(self) -> str:
        """By which it is found again."""
        return self._device.serial

    @property
    def rates_hz(self) -> dict[str, float]:
        """Of every stream that is read."""
        return rates_hz(self._opened, self._wanted)

    @property
    def _who(self) -> str:
        return f"{self._device.name} {self.serial}"

    @property
    def rig(self) -> Rig:
        """The factory calibration, with the profile's IMU noise; of the profile where no images are read.

        Raises ShareError, DataError."""
        stated = self._wanted.profile.rig()
        if stated.imu is not None:
            stated = replace(stated, imu=replace(stated.imu, rate_hz=self.rates_hz[GYRO]))
        profiles = {name: profile for one in self._opened for name, profile in one.profiles.items()}
        if CAM0 not in profiles:
            return stated
        with opening(self._who):
            return factory_rig(self._rs, profiles, stated.imu)

    def start(self, sink: Sink) -> None:
        """Deliver samples to `sink`, which is called from several threads. Raises ShareError."""
        for name, stated_hz in self._wanted.rates_hz().items():
            if abs(self.rates_hz[name] - stated_hz) > 1:
                self._say(f"the camera has no {name} at {stated_hz:g} Hz: takes {self.rates_hz[name]:g} Hz")
        for one in self._opened:
            moves = GYRO in one.profiles or ACCEL in one.profiles
            queue = self._rs.frame_queue(_QUEUE[moves], True)
            try:
                with opening(self._who):
                    self._set(one.sensor)
                    one.sensor.open(list(one.profiles.values()))
                    one.sensor.start(queue)
                    unit = _depth_unit(one)
            except ShareError:
                self.stop()
                raise
            thread = threading.Thread(target=self._pump, args=(queue, sink, unit), daemon=True)
            thread.start()
            self._threads.append(thread)

    def stop(self) -> None:
        """Stop reading and disconnect; does nothing the second time."""
        self._stop.set()
        for one in self._opened:
            with contextlib.suppress(RuntimeError):  # it may be gone, or was never started
                one.sensor.stop()
            with contextlib.suppress(RuntimeError):
                one.sensor.close()
        for thread in self._threads:
            thread.join(timeout=2)
        self._threads = []

    def reset(self) -> None:
        """Reset the device by its hardware: it disconnects, and comes back after some seconds."""
        self.stop()
        with contextlib.suppress(RuntimeError):
            self._device.handle.hardware_reset()

    def __enter__(self) -> RealSense:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _set(self, sensor: Any) -> None:
        """Options of a sensor, each where it has it: emitter by the profile, stamps of the device."""
        option, emitter = self._rs.option, self._wanted.profile.device.emitter
        dots = {
            "off": {option.emitter_on_off: 0, option.emitter_enabled: 0},  # others may have left it on
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
                if name != option.emitter_on_off or value:  # not to alternate is usual, and dots are said
                    raise

    def _pump(self, queue: Any, sink: Sink, depth_unit_m: float) -> None:
        while not self._stop.is_set():
            there, frame = queue.try_wait_for_frame(_WAIT_MS)
            if not there:
                continue
            try:
                sample = to_sample(self._rs, frame, depth_unit_m, time.monotonic_ns(), self._epoch)
                wanted = self._without_dots(sample, frame)
            except RuntimeError as error:  # of this frame; where all are so, the stream is silent
                self._once(f"a frame cannot be read: {str(error).partition(chr(10))[0]}")
                continue
            if wanted is not None:
                sink(wanted)

    def _without_dots(self, sample: Sample, frame: Any) -> Sample | None:
        """The sample, None for an image that has dots where others come without."""
        emitter = self._wanted.profile.device.emitter
        if sample.stream not in (CAM0, CAM1) or emitter not in ("interleaved", "off"):
            return sample
        if emitter == "off":
            self._images += 1
            if self._images % _MANY == 1 and has_dots(self._rs, frame):  # now and then: asking takes time
                self._once(_DOTS)
            return sample
        dots = has_dots(self._rs, frame)
        if dots is None:
            self._once(_UNKNOWN_DOTS)
        self.lit, self._dark = self.lit + bool(dots), self._dark or not dots
        if self.lit >= _MANY and not self._dark:
            self._once(_NEVER_DARK)
        # the number counts those with dots too, which are not missing
        return None if dots else replace(sample, number=None)

    def _once(self, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            self._say(text)


def _depth_unit(one: Opened) -> float:
    """Metres of one step of a depth map."""
    depth = DEPTH in one.profiles and one.sensor.is_depth_sensor()
    return float(one.sensor.as_depth_sensor().get_depth_scale()) if depth else _DEPTH_UNIT_M
