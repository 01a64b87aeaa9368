"""`share capture`: record a camera's streams until stopped or the disk is almost full.

camera feed -> writer thread: the file
main thread: free disk space, live line
"""

from __future__ import annotations

import contextlib
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share.cameras.feed import CameraFeed, FeedStatus
from share.cameras.live import choose_rig
from share.errors import ShareError, UsageError
from share.files.writing import write_errors
from share.recordings.calibration import Calibration
from share.recordings.mcap.recorder import Recorder, leftover_error, part_path

_TICK_S = 0.1
_SHOW_PERIOD_S = 1.0


@dataclass(frozen=True)
class CaptureStatus:
    """Contents of the live line. minutes: time until the disk is full; infinite while nothing is written."""

    feed: FeedStatus
    mb_s: float
    free_gb: float
    minutes: float


class Capture:
    """One recording. `run` returns when it is stopped, long enough, or the disk is almost full.

    Raises UsageError or ShareError before anything is written; later only if the file cannot be written any
    more (its `.part` stays, for `share dataset recover`).
    """

    def __init__(
        self,
        feed: CameraFeed,
        out: Path,
        min_free_gb: float,
        notify: Callable[[str], None],
        show: Callable[[CaptureStatus], None] = lambda status: None,
        calibration: Calibration | None = None,
    ) -> None:
        """calibration: written to the recording in place of the factory's."""
        self._feed, self._out, self._min_free_bytes = feed, out, min_free_gb * 1e9
        self._calibration = calibration
        self._notify, self._show = notify, show
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._written_measurements = 0
        self._last_shown = (time.monotonic(), 0)  # time, bytes written by then
        self.end_reason = "stopped"

    def stop(self) -> None:
        """End the recording and close its file."""
        self._stop.set()

    def run(self, seconds: float | None = None) -> dict[str, Any]:
        """Record for `seconds`, or until stopped. Return the report."""
        _check_disk(self._out, self._min_free_bytes)
        factory = self._feed.open()  # before the file exists: the queue holds samples meanwhile
        try:
            rig, warnings = choose_rig(self._calibration, factory, self._feed.serial)
            for warning in warnings:
                self._notify(f"camera {self._feed.serial}: {warning}")
            recorder = Recorder(self._out, rig, durable=True, serial=self._feed.serial)
        except BaseException:
            self._feed.close()
            raise
        self._record(recorder, seconds)
        if self._error is not None:
            raise self._error
        return {"out": str(self._out), "end_reason": self.end_reason, **self._feed.report()}

    def _record(self, recorder: Recorder, seconds: float | None) -> None:
        """Record until the end. The file is then complete, or stays as `.part` after an error."""
        writer = threading.Thread(target=self._write_measurements, args=(recorder,), daemon=True)
        writer.start()
        try:
            self._loop(seconds)
        except BaseException as error:
            self._error = self._error or error
        self._feed.stop()
        self._wait_for_writer(writer, recorder)
        if self._error is not None and not self._feed.has_failed:
            recorder.abort()
            self._notify_unclosed(recorder)
        elif self._feed.has_failed or not self._written_measurements:
            recorder.abort()
            recorder.part.unlink()
            nothing = f"camera {self._feed.serial}: {self._describe_samples()}"
            self._error = ShareError(f"{self._error or nothing}; nothing was recorded")
        else:
            recorder.close()

    def _wait_for_writer(self, writer: threading.Thread, recorder: Recorder) -> None:
        """Wait until everything is written, or a signal interrupts."""
        try:
            writer.join()
        except BaseException:
            self._notify_unclosed(recorder)
            raise

    def _notify_unclosed(self, recorder: Recorder) -> None:
        out, part = self._out, recorder.part
        self._notify(f"{part}: is not closed; `share dataset recover {part} --out {out}` saves its contents")

    def _describe_samples(self) -> str:
        """Return which samples came although nothing could be written."""
        counts = {name: gaps.samples for name, gaps in self._feed.processor.streams.items()}
        if not any(counts.values()):
            return "no sample came"
        listed = ", ".join(f"{count} of {name}" for name, count in counts.items())
        return f"samples came ({listed}), but the IMU needs both accel and gyro"

    def _write_measurements(self, recorder: Recorder) -> None:
        try:
            for measurement in self._feed.measurements():
                recorder.write(measurement)
                self._written_measurements += 1
        except BaseException as error:
            self._error = error
            self._feed.close()
            self._stop.set()

    def _loop(self, seconds: float | None) -> None:
        start_s = time.monotonic()
        while not self._stop.wait(_TICK_S):
            with write_errors(self._out):  # the disk may have been removed
                free = shutil.disk_usage(self._out.parent).free
            if free < self._min_free_bytes:
                self.end_reason = "disk almost full"
                self._notify(
                    f"{self._out.parent}: less than {self._min_free_bytes / 1e9:g} GB left; ends here"
                )
                return
            if seconds is not None and time.monotonic() - start_s >= seconds:
                self.end_reason = "time is over"
                return
            if time.monotonic() - self._last_shown[0] >= _SHOW_PERIOD_S:
                self._show(self._status(free))

    def _status(self, free: int) -> CaptureStatus:
        (then_s, size), now_s = self._last_shown, time.monotonic()
        self._last_shown = (now_s, _part_size(self._out))
        mb_s = (self._last_shown[1] - size) / (now_s - then_s) / 1e6
        left_bytes = max(0.0, free - self._min_free_bytes)
        minutes = left_bytes / (mb_s * 1e6) / 60 if mb_s > 0 else float("inf")
        return CaptureStatus(self._feed.status(), mb_s, free / 1e9, minutes)


def _check_disk(out: Path, min_free_bytes: float) -> None:
    """Raises UsageError if the recording exists, is left over unclosed, or the disk is too full."""
    if out.exists():
        raise UsageError(f"{out}: exists; give a new name, a recording is never overwritten")
    if part_path(out).exists():
        raise leftover_error(part_path(out))
    out.parent.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(out.parent).free
    if free < min_free_bytes:
        raise UsageError(
            f"{out.parent}: has {free / 1e9:.1f} GB left and {min_free_bytes / 1e9:g} must stay free "
            "(--min-free-gb); delete something or record to another disk"
        )


def _part_size(out: Path) -> int:
    with contextlib.suppress(OSError):
        return part_path(out).stat().st_size
    return 0
