"""Track one recording without an edge, as fast as possible and repeatably (`share track`)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from share import __version__, config
from share.errors import DataError
from share.metrics.ate import Ate, ate
from share.metrics.frame_log import ReplayQueue, RunLog
from share.odometry.track_result import TrackResult
from share.plain_data import to_mapping
from share.recordings.trajectory import Trajectory
from share.runtime.guarded_tracker import FaultGuard, GuardedTracker
from share.runtime.imu_bias_store import ImuBiasStore
from share.runtime.pipeline import check_trackable, read_frames
from share.runtime.source import Source
from share.sensors.sequencer import SequencerCounters


@dataclass(frozen=True, eq=False)
class TrackingOutput:
    """Causal poses of the body in odom, one per frame that had a pose, and the report."""

    trajectory: Trajectory
    report: dict[str, Any]


def track(
    source: Source,
    settings: config.Config,
    on_result: Callable[[TrackResult], None],
    notify: Callable[[str], None] = lambda text: None,
) -> TrackingOutput:
    """Track all frames of a recording, or the newest ones of a live camera. Call `on_result` for each frame
    and `notify` for messages to the user. Raises UsageError where no tracker fits the rig."""
    check_trackable(source.name, source.rig)
    guard, bias_store = FaultGuard(notify), ImuBiasStore(source, settings.inertial, notify)
    tracker = GuardedTracker(source.rig, settings, guard, bias_store.bias)
    log, counters, queue = RunLog(), SequencerCounters(), ReplayQueue()
    stamps, poses = [], []
    for frame in read_frames(source, settings, counters, on_decoded=log.add_decode_time, notify=notify):
        start_s, cpu = time.perf_counter(), time.process_time()
        result = tracker.track(frame)
        waited_ms = queue.wait_ms(frame.stamp_ns)
        track_ms = waited_ms + 1e3 * (time.perf_counter() - start_s)
        log.add_result(result.new_segment, result.is_consistent, result.waiting_for)
        tracker.finish(frame, result.keyframe_ready)
        queue.finish_frame(frame.stamp_ns, waited_ms + 1e3 * (time.perf_counter() - start_s))
        log.cpu_s += time.process_time() - cpu
        log.add(frame.stamp_ns, track_ms, result.state, result.keyframe_ready)
        if result.T_odom_body is not None:
            stamps.append(frame.stamp_ns)
            poses.append(result.T_odom_body)
        on_result(result)
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


def trajectory_accuracy(run: TrackingOutput, truth: Trajectory | None) -> Ate | None:
    """Return the ATE against the recording's ground truth (SE3 alignment); None without enough truth."""
    if truth is None:
        return None
    try:
        return ate(run.trajectory, truth)
    except DataError:  # too few poses have ground truth at their time
        return None
