"""From a source to tracked frames: what `share track` and `share agent` have in common."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from share.config import Config
from share.core.sequencer import SequencerCounters, sequence, streams_of
from share.errors import DataError, MisfitError, UsageError
from share.estimator.inertial.tracker import InertialTracker
from share.estimator.visual import VisualTracker
from share.geometry.camera import Rig
from share.io.images import load
from share.io.source import Source
from share.types import Frame

_LEFT_OUT = {
    "imu_out_of_range": "the IMU gave samples beyond {0.gyro:.3g} rad/s or {0.accel:.3g} m/s^2, or no "
    "numbers; such are left out (sequencer.imu_out_of_range in the report)",
    "imu_spikes": "the IMU gave single samples far from those before and after them; such are left out "
    "(sequencer.imu_spikes in the report); look at its cable and supply",
}


def frames_of(
    source: Source,
    config: Config,
    counters: SequencerCounters,
    on_bad: Callable[[DataError], None] | None = None,
    spent: Callable[[float], None] = lambda cpu_s: None,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[Frame]:
    """Decoded frames in order. A damaged image raises DataError, or goes to `on_bad` and is left out.

    Images of another size than the calibration's always raise: all of them will be.

    `spent` is told the CPU time of each frame's decoding on this thread; `say`, once, that the IMU gave what
    is no measurement.
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
    silent = set(_LEFT_OUT)
    for bundle in bundles:
        for name in [name for name in silent if getattr(counters, name)]:
            silent.remove(name)
            say(_LEFT_OUT[name].format(source.imu_range))
        began = time.thread_time()
        try:
            frame = load(bundle)
        except DataError as error:
            if on_bad is None or isinstance(error, MisfitError):
                raise
            on_bad(error)
            continue
        spent(time.thread_time() - began)
        yield frame


def tracker_for(source: Source, config: Config) -> VisualTracker | InertialTracker:
    """The estimator that fits the source's rig. Raises UsageError where there is none."""
    check_trackable(source.name, source.rig)
    return tracker_of(source.rig, config)


def check_trackable(name: str, rig: Rig) -> None:
    """Raises UsageError unless some estimator fits the rig of the source `name`."""
    if rig.imu is None and rig.cam1 is None and rig.depth is None:
        raise UsageError(f"{name}: one camera alone gives no scale; stereo, depth or an IMU is needed")


def tracker_of(rig: Rig, config: Config) -> VisualTracker | InertialTracker:
    """The estimator that fits a rig. Raises ValueError where there is none."""
    if rig.imu is not None:
        return InertialTracker(rig, config.inertial, config.tracker)
    return VisualTracker(rig, config.tracker)
