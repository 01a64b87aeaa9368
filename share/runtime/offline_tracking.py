"""Track one recording without an edge, as fast as possible and repeatably (`share track`)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from share import __version__, config
from share.metrics.frame_log import ReplayQueue, RunLog
from share.odometry.track_result import TrackResult
from share.plain_data import to_mapping
from share.recordings.trajectory import Trajectory
from share.runtime.error_estimators import ErrorEstimator, NoErrorEstimate
from share.runtime.fault_guard import FaultGuard
from share.runtime.guarded_tracker import GuardedTracker
from share.runtime.imu_bias_store import ImuBiasStore
from share.runtime.pipeline import check_trackable, read_frames
from share.runtime.source import Source
from share.sensors.sequencer import SequencerCounters
from share.types import Frame, OdometryKeyframe


@dataclass(frozen=True, eq=False)
class TrackingOutput:
    """Causal poses of the body in odom, one per frame that had a pose, and the report."""

    trajectory: Trajectory
    report: dict[str, Any]


class OfflineFrame(NamedTuple):
    """A frame with all work on it done. `error_cm`: its estimated error, `candidate`: its keyframe, if any.

    `track_s` and `total_s`: time until the pose was there, and until the end; `cpu_s`: CPU time of the
    process.
    """

    frame: Frame
    result: TrackResult
    error_cm: float | None
    candidate: OdometryKeyframe | None
    track_s: float
    total_s: float
    cpu_s: float


def track_frames(
    frames: Iterable[Frame], tracker: GuardedTracker, error_estimator: ErrorEstimator | None = None
) -> Iterator[OfflineFrame]:
    """Track all frames in turn, where nothing waits for a pose. Decoding does not count in the times."""
    estimator = error_estimator or NoErrorEstimate()
    for frame in frames:
        start_s, cpu_start_s = time.perf_counter(), time.process_time()
        result = tracker.track(frame)
        track_s = time.perf_counter() - start_s
        error_cm = estimator.update(frame, result)
        candidate = tracker.finish(frame, result.keyframe_ready, estimator.make_keyframe)
        total_s, cpu_s = time.perf_counter() - start_s, time.process_time() - cpu_start_s
        yield OfflineFrame(frame, result, error_cm, candidate, track_s, total_s, cpu_s)


def track(
    source: Source,
    settings: config.Config,
    on_result: Callable[[TrackResult], None],
    notify: Callable[[str], None] = lambda text: None,
    on_frame: Callable[[OfflineFrame], None] = lambda step: None,
) -> TrackingOutput:
    """Track all frames of a recording, or the newest ones of a live camera. Call `on_result` and `on_frame`
    for each frame and `notify` for messages to the user. Raises UsageError where no tracker fits the rig."""
    check_trackable(source.name, source.rig)
    guard, bias_store = FaultGuard(notify), ImuBiasStore(source, settings.inertial, notify)
    tracker = GuardedTracker(source.rig, settings, guard, bias_store.bias)
    log, counters, queue = RunLog(), SequencerCounters(), ReplayQueue()
    stamps, poses = [], []
    frames = read_frames(source, settings, counters, on_decoded=log.add_decode_time, notify=notify)
    for step in track_frames(frames, tracker):
        stamp_ns, result = step.frame.stamp_ns, step.result
        if tracker.has_dropped_bias:
            bias_store.note_dropped()
        waited_ms = queue.wait_ms(stamp_ns)
        queue.finish_frame(stamp_ns, waited_ms + 1e3 * step.total_s)
        log.add_result(result.new_segment, result.is_consistent, result.waiting_for)
        log.cpu_s += step.cpu_s
        log.add(stamp_ns, waited_ms + 1e3 * step.track_s, result.state, result.keyframe_ready)
        if result.T_odom_body is not None:
            stamps.append(stamp_ns)
            poses.append(result.T_odom_body)
        on_result(result)
        on_frame(step)
    bias_store.save(tracker.bias)
    log.imu_outliers = tracker.rejected_imu_samples
    trajectory = Trajectory(np.array(stamps, np.int64), np.array(poses).reshape(-1, 4, 4))
    report = offline_report(log, counters, settings) | {"skipped": source.losses.counts}
    report["failed_steps"] = guard.failure_count
    return TrackingOutput(trajectory, report | source.report() | bias_store.report())


def offline_report(log: RunLog, counters: SequencerCounters, settings: config.Config) -> dict[str, Any]:
    """Return the contents of report.json for a run without an edge."""
    return {
        **log.report(),
        "corrections": 0,
        "bytes_up": 0,
        "bytes_down": 0,
        "sequencer": dataclasses.asdict(counters),
        "version": __version__,
        "config": to_mapping(settings),
    }
