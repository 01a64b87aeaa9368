"""From a source to tracked frames: what `share track` and `share agent` have in common."""

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
from share.sensors.sequencer import SequencerCounters, UndecodedFrame, rig_streams, sequence_frames
from share.types import Frame, ImuBatch

_MAX_MISFITS = (
    10  # images of a wrong size before any of the right one: the calibration is another recording's
)
_SILENT_NS = 1_000_000_000  # as long as a camera may be silent before it is said
_MAX_SKIPPED_FRAMES = 600  # frames that are left out one after the other, whose IMU samples are kept

_IMU_WARNINGS = {
    "imu_out_of_range": "the IMU gave samples beyond {0.gyro:.3g} rad/s or {0.accel:.3g} m/s^2, or no "
    "numbers; such are left out (sequencer.imu_out_of_range in the report)",
    "imu_spikes": "the IMU gave one to three samples in a row far from those before and after; such are left "
    "out (sequencer.imu_spikes in the report); look at its cable and supply",
}


def read_frames(
    source: Source,
    config: Config,
    counters: SequencerCounters,
    on_damaged: Callable[[DataError], None] | None = None,
    on_decoded: Callable[[float], None] = lambda cpu_s: None,
    notify: Callable[[str], None] = lambda text: None,
) -> Iterator[Frame]:
    """Decoded frames in order. One with a damaged image is left out: the next one has its IMU samples too,
    and `on_damaged` is told, or the source's losses are. Raises MisfitError where the first ten images, or
    all of them, are of another size than the calibration's.

    `on_decoded` is told the CPU time of each frame's decoding on this thread; `notify`, once each, that the
    IMU gave
    what is no measurement, and that the IMU of a recording has stopped; a camera's feed says that itself.
    """
    rig = source.rig
    bundles = sequence_frames(
        source.measurements(),
        rig_streams(rig),
        source.rate_hz,
        config.sequencer,
        counters,
        rig.timeshift_ns,
        source.imu_range,
    )
    skipped, unwarned = _SkippedFrames(on_damaged or partial(_count_loss, source)), set(_IMU_WARNINGS)
    silence_monitor = None if rig.imu is None or source.reports_silence else _ImuSilenceMonitor(notify)
    for bundle in bundles:
        if silence_monitor is not None:
            silence_monitor.update(bundle)
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
    """Says once that the IMU gives nothing any more."""

    def __init__(self, notify: Callable[[str], None]) -> None:
        self._notify = notify
        self._first_ns = self._last_imu_ns = -1  # of frames: the first, the last with samples
        self._has_warned = False

    def update(self, bundle: UndecodedFrame) -> None:
        if len(bundle.imu) or bundle.index == 0:
            self._last_imu_ns = bundle.stamp_ns
        if bundle.index == 0:
            self._first_ns = bundle.stamp_ns
        if not self._has_warned and bundle.stamp_ns - self._last_imu_ns >= _SILENT_NS:
            self._has_warned = True
            since_s = (self._last_imu_ns - self._first_ns) * 1e-9
            self._notify(
                f"no IMU sample comes from {since_s:.1f} s on, for 1 s at least; poses are by images alone "
                "meanwhile (sequencer.imu_silent in the report)"
            )


class _SkippedFrames:
    """Frames since the last good one that cannot be decoded."""

    def __init__(self, on_damaged: Callable[[DataError], None]) -> None:
        self._on_damaged = on_damaged
        self._imu: deque[ImuBatch] = deque(maxlen=_MAX_SKIPPED_FRAMES)
        self._gap_ns = 0
        self._misfits: list[CalibrationMismatchError] = []  # until there is a good one
        self._has_decoded = False

    def add(self, bundle: UndecodedFrame, error: DataError) -> None:
        """Raises `error` if it is about the recording, not about this image."""
        self._imu.append(bundle.imu)
        self._gap_ns += bundle.gap_ns
        if isinstance(error, CalibrationMismatchError) and not self._has_decoded:
            self._misfits.append(error)
            if len(self._misfits) >= _MAX_MISFITS:
                raise error
        else:
            self._on_damaged(error)

    def merge_into(self, bundle: UndecodedFrame) -> UndecodedFrame:
        """`bundle` with what those before it carried."""
        if not self._imu:
            return bundle
        imu = ImuBatch.empty().concatenate(*self._imu, bundle.imu)
        return replace(bundle, imu=imu, gap_ns=self._gap_ns + bundle.gap_ns)

    def clear(self) -> None:
        """There was a good one."""
        if self._has_decoded and not self._imu:
            return
        for error in self._misfits:
            self._on_damaged(error)
        self._has_decoded = True
        self._misfits.clear()
        self._imu.clear()
        self._gap_ns = 0

    def check_end(self) -> None:
        if self._misfits:
            raise self._misfits[0]


def make_source_tracker(source: Source, config: Config) -> VisualTracker | InertialTracker:
    """The estimator that fits the source's rig. Raises UsageError where there is none."""
    check_trackable(source.name, source.rig)
    return make_tracker(source.rig, config)


def check_trackable(name: str, rig: Rig) -> None:
    """Raises UsageError unless some estimator fits the rig of the source `name`."""
    if (objection := rig_check.rig_problem(rig)) is not None:
        raise UsageError(f"{name}: {objection}")


def make_tracker(rig: Rig, config: Config, bias: ImuBias | None = None) -> VisualTracker | InertialTracker:
    """The estimator that fits a rig. bias: of its IMU, where that is known. Raises ValueError where there is
    none."""
    if rig.imu is not None:
        return InertialTracker(rig, config.inertial, config.tracker, bias=bias)
    return VisualTracker(rig, config.tracker)
