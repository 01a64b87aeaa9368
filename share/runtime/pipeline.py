"""From a source to tracked frames: what `share track` and `share agent` have in common."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

from share.config import Config
from share.errors import DataError, MisfitError, UsageError
from share.geometry import rig_check
from share.geometry.camera import ImuBias, Rig
from share.odometry.tracker import InertialTracker
from share.odometry.visual_tracker import VisualTracker
from share.recordings.images import load
from share.runtime.source import Source
from share.sensors.sequencer import Bundle, SequencerCounters, sequence, streams_of
from share.types import Frame, ImuBatch

_MISFITS = 10  # images of a wrong size before any of the right one: the calibration is another recording's
_SILENT_NS = 1_000_000_000  # as long as a camera may be silent before it is said
_REMEMBERED = 600  # frames that are left out one after the other, whose IMU samples are kept

_NO_MEASUREMENTS = {
    "imu_out_of_range": "the IMU gave samples beyond {0.gyro:.3g} rad/s or {0.accel:.3g} m/s^2, or no "
    "numbers; such are left out (sequencer.imu_out_of_range in the report)",
    "imu_spikes": "the IMU gave one to three samples in a row far from those before and after; such are left "
    "out (sequencer.imu_spikes in the report); look at its cable and supply",
}


def frames_of(
    source: Source,
    config: Config,
    counters: SequencerCounters,
    on_bad: Callable[[DataError], None] | None = None,
    spent: Callable[[float], None] = lambda cpu_s: None,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[Frame]:
    """Decoded frames in order. One with a damaged image is left out: the next one has its IMU samples too,
    and `on_bad` is told, or the source's losses are. Raises MisfitError where the first ten images, or all of
    them, are of another size than the calibration's.

    `spent` is told the CPU time of each frame's decoding on this thread; `say`, once each, that the IMU gave
    what is no measurement, and that the IMU of a recording has stopped; a camera's feed says that itself.
    """
    rig = source.rig
    bundles = sequence(
        source.measurements(),
        streams_of(rig),
        source.rate_hz,
        config.sequencer,
        counters,
        rig.timeshift_ns,
        source.imu_range,
    )
    left_out, silent = _LeftOut(on_bad or partial(_lose, source)), set(_NO_MEASUREMENTS)
    stopped = None if rig.imu is None or source.tells_silence else _Stopped(say)
    for bundle in bundles:
        if stopped is not None:
            stopped.look(bundle)
        for name in [name for name in silent if getattr(counters, name)]:
            silent.remove(name)
            say(_NO_MEASUREMENTS[name].format(source.imu_range))
        began = time.thread_time()
        try:
            frame = load(left_out.before(bundle))
        except DataError as error:
            left_out.add(bundle, error)
            continue
        left_out.clear()
        spent(time.thread_time() - began)
        yield frame
    left_out.end()


def _lose(source: Source, error: DataError) -> None:
    source.losses.add("frames", str(error), str(error))


class _Stopped:
    """Says once that the IMU gives nothing any more."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._first_ns = self._heard_ns = -1  # of frames: the first, the last with samples
        self._said = False

    def look(self, bundle: Bundle) -> None:
        if len(bundle.imu) or bundle.index == 0:
            self._heard_ns = bundle.stamp_ns
        if bundle.index == 0:
            self._first_ns = bundle.stamp_ns
        if not self._said and bundle.stamp_ns - self._heard_ns >= _SILENT_NS:
            self._said = True
            since_s = (self._heard_ns - self._first_ns) * 1e-9
            self._say(
                f"no IMU sample comes from {since_s:.1f} s on, for 1 s at least; poses are by images alone "
                "meanwhile (sequencer.imu_silent in the report)"
            )


class _LeftOut:
    """Frames since the last good one that cannot be decoded."""

    def __init__(self, on_bad: Callable[[DataError], None]) -> None:
        self._on_bad = on_bad
        self._imu: deque[ImuBatch] = deque(maxlen=_REMEMBERED)
        self._gap_ns = 0
        self._misfits: list[MisfitError] = []  # until there is a good one
        self._any_good = False

    def add(self, bundle: Bundle, error: DataError) -> None:
        """Raises `error` if it is about the recording, not about this image."""
        self._imu.append(bundle.imu)
        self._gap_ns += bundle.gap_ns
        if isinstance(error, MisfitError) and not self._any_good:
            self._misfits.append(error)
            if len(self._misfits) >= _MISFITS:
                raise error
        else:
            self._on_bad(error)

    def before(self, bundle: Bundle) -> Bundle:
        """`bundle` with what those before it carried."""
        if not self._imu:
            return bundle
        imu = ImuBatch.empty().join(*self._imu, bundle.imu)
        return replace(bundle, imu=imu, gap_ns=self._gap_ns + bundle.gap_ns)

    def clear(self) -> None:
        """There was a good one."""
        if self._any_good and not self._imu:
            return
        for error in self._misfits:
            self._on_bad(error)
        self._any_good = True
        self._misfits.clear()
        self._imu.clear()
        self._gap_ns = 0

    def end(self) -> None:
        if self._misfits:
            raise self._misfits[0]


def tracker_for(source: Source, config: Config) -> VisualTracker | InertialTracker:
    """The estimator that fits the source's rig. Raises UsageError where there is none."""
    check_trackable(source.name, source.rig)
    return tracker_of(source.rig, config)


def check_trackable(name: str, rig: Rig) -> None:
    """Raises UsageError unless some estimator fits the rig of the source `name`."""
    if (why := rig_check.objection(rig)) is not None:
        raise UsageError(f"{name}: {why}")


def tracker_of(rig: Rig, config: Config, bias: ImuBias | None = None) -> VisualTracker | InertialTracker:
    """The estimator that fits a rig. bias: of its IMU, where that is known. Raises ValueError where there is
    none."""
    if rig.imu is not None:
        return InertialTracker(rig, config.inertial, config.tracker, bias=bias)
    return VisualTracker(rig, config.tracker)
