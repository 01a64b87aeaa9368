"""`share capture`: a camera's streams to a recording, for as long as the disk lasts.

the device's threads -> bounded queue -> writer thread: repair, join, write
    main thread: watchdog, disk, live line
"""

from __future__ import annotations

import contextlib
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from share.core.intake import ACCEL, GYRO, Intake, Sample
from share.core.measurement import CAM0, IMU
from share.core.watchdog import Action, Health, Watchdog
from share.errors import ShareError, UsageError
from share.geometry.camera import Rig
from share.io.mcap.recorder import Recorder
from share.run.handover import Handover

_TICK_S = 0.1
_SHOW_S = 1.0
_WAIT_S = 0.2


class Device(Protocol):
    """A camera that is connected, such as `share.io.realsense.camera.RealSense`."""

    @property
    def rig(self) -> Rig: ...

    @property
    def serial(self) -> str: ...

    def start(self, sink: Callable[[Sample], None]) -> None: ...

    def stop(self) -> None: ...

    def reset(self) -> None: ...


Connect = Callable[[str | None, int], Device]  # serial number (None: any), how often it was tried before


@dataclass(frozen=True)
class Status:
    """For the live line. rates_hz: of every stream in the last second; minutes: that the disk lasts."""

    health: Health
    rates_hz: dict[str, float]
    missing: int
    dropped: int
    queue: int
    mb_s: float
    free_gb: float
    minutes: float


class Capture:
    """One recording. `go` returns when it was stopped, is long enough or the disk is almost full.

    Raises UsageError and ShareError before anything is written; later, only where the file itself cannot
    be written any more (its `.part` stays, for `share dataset recover`).
    """

    def __init__(
        self,
        connect: Connect,
        serial: str | None,
        rates_hz: Mapping[str, float],
        out: Path,
        max_jump_s: float,
        min_free_gb: float,
        say: Callable[[str], None],
        show: Callable[[Status], None] = lambda status: None,
        watchdog: Callable[[int, bool, bool], Watchdog] = Watchdog,
    ) -> None:
        self._connect, self._serial, self._rates = connect, serial, dict(rates_hz)
        self._out, self._free_least = out, min_free_gb * 1e9
        self._say, self._show = say, show
        self._intake = Intake(rates_hz, max_jump_s)
        self._handover = Handover()
        self._make_watchdog = watchdog
        self._watchdog = self._new_watchdog()
        self._stop = threading.Event()
        self._device: Device | None = None
        self._heard: dict[str, int] = {}
        self._reconnections = self._attempts = 0
        self._error: BaseException | None = None
        self._shown: tuple[float, int, dict[str, int]] = (time.monotonic(), 0, {})
        self.ended = "stopped"

    def stop(self) -> None:
        """End in good order."""
        self._stop.set()

    def go(self, seconds: float | None = None) -> dict[str, Any]:
        """Record, and tell what came of it."""
        _check_disk(self._out, self._free_least)
        self._device = device = self._connect(self._serial, 0)
        self._serial = device.serial
        device.start(self._take)  # before there is a file: the queue holds what comes meanwhile
        try:
            self._record(Recorder(self._out, device.rig, durable=True), seconds)
        finally:
            self._leave()
        if self._error is not None:
            raise self._error
        return self.report()

    def _record(self, recorder: Recorder, seconds: float | None) -> None:
        """Until it ends; then the file is whole, or keeps its `.part` if something went wrong."""
        writer = threading.Thread(target=self._write, args=(recorder,), daemon=True)
        writer.start()
        self._watchdog = self._new_watchdog()
        try:
            self._loop(seconds)
        except BaseException as error:
            self._error = self._error or error
        self._leave()
        writer.join()
        if self._error is not None:
            recorder.abort()
        elif not any(gaps.samples for gaps in self._intake.streams.values()):
            recorder.abort()
            recorder.part.unlink()
            self._error = ShareError(f"camera {self._serial}: no sample came; nothing was recorded")
        else:
            recorder.close()

    def _leave(self) -> None:
        """Let the camera go; what it sent is still written."""
        if self._device is not None:
            self._device.stop()
        self._handover.close()

    def report(self) -> dict[str, Any]:
        """What was recorded, repaired and lost."""
        streams = {
            name: {
                "samples": gaps.samples,
                "seconds": round(gaps.seconds, 3),
                "gaps": gaps.gaps,
                "missing": gaps.missing,
                "backward": gaps.backward,
                "dropped": self._handover.dropped.get(name, 0),
            }
            for name, gaps in self._intake.streams.items()
        }
        return {
            "out": str(self._out),
            "ended": self.ended,
            "streams": streams,
            "imu": self._intake.join.joined,
            "stretches": self._intake.stretches,
            "reconnections": self._reconnections,
            "resets": self._watchdog.resets,
            "health": self._watchdog.health.value,
            **self._intake.counts(),
        }

    def _new_watchdog(self) -> Watchdog:
        return self._make_watchdog(time.monotonic_ns(), CAM0 in self._rates, GYRO in self._rates)

    def _take(self, sample: Sample) -> None:
        """In the device's threads."""
        self._heard[sample.stream] = time.monotonic_ns()
        self._handover.put(sample)

    # ------------------------------------------------------------------ writer

    def _write(self, recorder: Recorder) -> None:
        try:
            while not self._handover.done:
                sample = self._handover.get(_WAIT_S)
                for measurement in self._intake.feed(sample) if sample is not None else ():
                    recorder.write(measurement)
        except BaseException as error:
            self._error = error
            self._stop.set()
            self._handover.close()

    # ------------------------------------------------------------------ main

    def _loop(self, seconds: float | None) -> None:
        began = time.monotonic()
        while not self._stop.wait(_TICK_S):
            self._guard()
            if shutil.disk_usage(self._out.parent).free < self._free_least:
                self.ended = "disk almost full"
                self._say(f"{self._out.parent}: less than {self._free_least / 1e9:g} GB left; ends here")
                return
            if seconds is not None and time.monotonic() - began >= seconds:
                self.ended = "time is over"
                return
            if time.monotonic() - self._shown[0] >= _SHOW_S:
                self._show(self._status())

    def _guard(self) -> None:
        """Feed the watchdog, and do what it asks for."""
        if self._device is not None:
            for stream, now_ns in list(self._heard.items()):
                self._watchdog.heard(IMU if stream in (ACCEL, GYRO) else stream, now_ns)
        match self._watchdog.tick(time.monotonic_ns()):
            case Action.RESET:
                self._say("the IMU is silent; the camera is reset once")
                if self._device is not None:
                    self._device.reset()
                self._device = None
            case Action.VISION_ONLY:
                self._say("the IMU stays silent; VISION_ONLY: images are recorded without it")
            case Action.HEARD_AGAIN:
                self._say("the IMU is heard again")
            case Action.RECONNECT:
                self._reconnect()

    def _reconnect(self) -> None:
        if self._device is not None:
            self._say(f"no more samples come; looks for camera {self._serial} until it is back")
            self._device.stop()
            self._device = None
        self._attempts += 1
        try:
            device = self._connect(self._serial, self._attempts)
            device.start(self._take)
        except ShareError:
            self._watchdog.lost(time.monotonic_ns())
            return
        self._reconnections += 1
        self._device = device
        self._watchdog.connected(time.monotonic_ns())
        self._say(f"camera {self._serial} is connected again; a new stretch begins")

    def _status(self) -> Status:
        then, size, counts = self._shown
        now = time.monotonic()
        streams = self._intake.streams
        self._shown = (now, _size(self._out), {name: gaps.samples for name, gaps in streams.items()})
        mb_s = (self._shown[1] - size) / (now - then) / 1e6
        free = shutil.disk_usage(self._out.parent).free
        left = max(0.0, free - self._free_least)
        return Status(
            health=self._watchdog.health,
            rates_hz={n: (c - counts.get(n, 0)) / (now - then) for n, c in self._shown[2].items()},
            missing=sum(gaps.missing for gaps in streams.values()),
            dropped=sum(self._handover.dropped.values()),
            queue=len(self._handover),
            mb_s=mb_s,
            free_gb=free / 1e9,
            minutes=left / (mb_s * 1e6) / 60 if mb_s > 0 else float("inf"),
        )


def _check_disk(out: Path, least: float) -> None:
    """Raises UsageError where a recording is not to begin."""
    if out.exists():
        raise UsageError(f"{out}: exists; give a new name, a recording is never overwritten")
    out.parent.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(out.parent).free
    if free < least:
        raise UsageError(
            f"{out.parent}: has {free / 1e9:.1f} GB left and {least / 1e9:g} must stay free (--min-free-gb); "
            "delete something or record to another disk"
        )


def _size(out: Path) -> int:
    with contextlib.suppress(OSError):
        return out.with_name(out.name + ".part").stat().st_size
    return 0
