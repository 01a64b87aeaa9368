"""Reading and decoding frames of a source and making a tracker; shared by `share track` and `share agent`."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

from share.config import Config
from share.errors import CalibrationMismatchError, DataError, UsageError
from share.geometry import rig_check
from share.geometry.camera import ImuBias, Rig
from share.odometry.inertial_tracker import InertialTracker
from share.odometry.visual_tracker import VisualTracker
from share.recordings.images import decode_frame
from share.runtime.source import Source
from share.sensors.sequencer import (
    FrameMerger,
    SequencerCounters,
    UndecodedFrame,
    rig_streams,
    sequence_frames,
)
from share.types import Frame, ImuBatch

_MAX_MISFITS = (
    10  # images of a wrong size before any of the right one: the calibration is another recording's
)
_SILENT_NS = 1_000_000_000  # without IMU samples before a warning
_STUCK_NS = 100_000_000  # of repeated samples before a warning
_MAX_SKIPPED_FRAMES = 600  # consecutive undecodable frames of which IMU samples are kept

_IMU_WARNINGS = {
    "imu_out_of_range": "IMU samples beyond {0.gyro:.3g} rad/s or {0.accel:.3g} m/s^2, or not finite, are "
    "dropped (sequencer.imu_out_of_range in the report)",
    "imu_spikes": "one to three consecutive IMU samples far from their neighbours are dropped "
    "(sequencer.imu_spikes in the report); check the IMU's cable and supply",
}


def read_frames(
    source: Source,
    config: Config,
    counters: SequencerCounters,
    on_damaged: Callable[[DataError], None] | None = None,
    on_decoded: Callable[[float], None] = lambda cpu_s: None,
    notify: Callable[[str], None] = lambda text: None,
) -> Iterator[Frame]:
    """Yield decoded frames in order. A frame with a damaged image is skipped; its IMU samples go to the next
    one, and `on_damaged` is called, or else the source's losses count it.

    on_decoded: called with each frame's decoding CPU time on this thread, s. notify: called once per kind of
    IMU fault, also when it only repeats the same values, and when a recording's IMU falls silent (a camera's
    feed reports that itself). Raises
    CalibrationMismatchError if the first ten images, or all, have another size than the calibration.
    """
    rig = source.rig
    merger = FrameMerger(
        rig_streams(rig),
        source.rate_hz,
        config.sequencer,
        counters,
        rig.timeshift_ns,
        source.imu_range,
    )
    bundles = sequence_frames(source.measurements(), merger)
    skipped, unwarned = _SkippedFrames(on_damaged or partial(_count_loss, source)), set(_IMU_WARNINGS)
    silence_monitor = _ImuSilenceMonitor(notify, source.reports_silence) if rig.imu else None
    for bundle in bundles:
        if silence_monitor is not None:
            silence_monitor.update(bundle, counters.imu_repeated)
        for name in [name for name in unwarned if getattr(counters, name)]:
            unwarned.remove(name)
            notify(_IMU_WARNINGS[name].format(source.imu_range))
        start_s = time.thread_time()
        try:
            frame = decode_frame(skipped.merge_into(bundle))
        except DataError as error:
            skipped.add(bundle, error)
            continue
        skipped.clear()
        on_decoded(time.thread_time() - start_s)
        yield frame
    skipped.check_end()


def _count_loss(source: Source, error: DataError) -> None:
    source.losses.add("frames", str(error), str(error))


class _ImuSilenceMonitor:
    """Warns once when IMU samples stop, and once when they only repeat the same values."""

    def __init__(self, notify: Callable[[str], None], reports_silence: bool) -> None:
        """reports_silence: somebody else warns of samples that stop."""
        self._notify = notify
        self._first_ns = self._last_imu_ns = -1  # stamps of the first frame and the last one with samples
        self._repeated_before = 0  # repeated samples until then
        self._has_warned, self._has_warned_of_repeats = reports_silence, False

    def update(self, bundle: UndecodedFrame, repeated: int) -> None:
        """Add a frame. repeated: samples dropped so far because they repeat the ones before."""
        if len(bundle.imu) or bundle.index == 0:
            self._last_imu_ns, self._repeated_before = bundle.stamp_ns, repeated
        if bundle.index == 0:
            self._first_ns = bundle.stamp_ns
        silent_ns = bundle.stamp_ns - self._last_imu_ns
        since_s = (self._last_imu_ns - self._first_ns) * 1e-9
        meanwhile = "meanwhile poses come from images alone"
        if repeated > self._repeated_before:
            if silent_ns >= _STUCK_NS and not self._has_warned_of_repeats:
                self._has_warned_of_repeats = True
                self._notify(
                    f"the IMU repeats the same values from {since_s:.1f} s on; {meanwhile} "
                    "(sequencer.imu_repeated in the report); check its driver, cable and supply"
                )
        elif silent_ns >= _SILENT_NS and not self._has_warned:
            self._has_warned = True
            self._notify(
                f"no IMU samples from {since_s:.1f} s on, for at least 1 s; {meanwhile} "
                "(sequencer.imu_silent in the report)"
            )


class _SkippedFrames:
    """Undecodable frames since the last good one."""

    def __init__(self, on_damaged: Callable[[DataError], None]) -> None:
        self._on_damaged = on_damaged
        self._imu: deque[ImuBatch] = deque(maxlen=_MAX_SKIPPED_FRAMES)
        self._gap_ns = 0
        self._misfits: list[CalibrationMismatchError] = []  # until the first good frame
        self._has_decoded = False

    def add(self, bundle: UndecodedFrame, error: DataError) -> None:
        """Add an undecodable frame. Raises `error` if it concerns the recording, not this image."""
        self._imu.append(bundle.imu)
        self._gap_ns += bundle.gap_ns
        if isinstance(error, CalibrationMismatchError) and not self._has_decoded:
            self._misfits.append(error)
            if len(self._misfits) >= _MAX_MISFITS:
                raise error
        else:
            self._on_damaged(error)

    def merge_into(self, bundle: UndecodedFrame) -> UndecodedFrame:
        """Return `bundle` with the IMU samples and gaps of the skipped frames before it."""
        if not self._imu:
            return bundle
        imu = ImuBatch.empty().concatenate(*self._imu, bundle.imu)
        return replace(bundle, imu=imu, gap_ns=self._gap_ns + bundle.gap_ns)

    def clear(self) -> None:
        """Forget the skipped frames after a good one."""
        if self._has_decoded and not self._imu:
            return
        for error in self._misfits:
            self._on_damaged(error)
        self._has_decoded = True
        self._misfits.clear()
        self._imu.clear()
        self._gap_ns = 0

    def check_end(self) -> None:
        """Raises CalibrationMismatchError if no frame could be decoded for that reason."""
        if self._misfits:
            raise self._misfits[0]


def check_trackable(name: str, rig: Rig) -> None:
    """Raises UsageError if no tracker fits the rig of the source `name`."""
    if (objection := rig_check.rig_problem(rig)) is not None:
        raise UsageError(f"{name}: {objection}")


def make_tracker(rig: Rig, config: Config, bias: ImuBias | None = None) -> VisualTracker | InertialTracker:
    """Return a tracker for `rig`. bias: initial IMU bias, None if unknown. Raises ValueError if none fits."""
    if rig.imu is not None:
        return InertialTracker(rig, config.inertial, bias=bias)
    return VisualTracker(rig, config.tracker)
