"""One agent over one recording, no edge, as fast as it goes, and the same every time."""

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
from share.metrics.frame_log import Queue, RunLog
from share.odometry.result import TrackResult
from share.plain_data import to_mapping
from share.recordings.trajectory import Trajectory
from share.runtime.guarded_tracker import Guard, GuardedTracker
from share.runtime.imu_memory import ImuMemory
from share.runtime.pipeline import check_trackable, frames_of
from share.runtime.source import Source
from share.sensors.sequencer import SequencerCounters


@dataclass(frozen=True, eq=False)
class TrackRun:
    """Causal poses of the body in odom, one for every frame that had one, and the report."""

    trajectory: Trajectory
    report: dict[str, Any]


def track(
    source: Source,
    settings: config.Config,
    told: Callable[[TrackResult], None],
    say: Callable[[str], None] = lambda text: None,
) -> TrackRun:
    """Track every frame in turn, of a live camera the newest. `told` is what came of each; `say` is for a
    person. Raises UsageError where no tracker can use the rig."""
    check_trackable(source.name, source.rig)
    guard, memory = Guard(say), ImuMemory(source, settings.inertial, say)
    tracker = GuardedTracker(source.rig, settings, guard, memory.bias)
    log, counters, queue = RunLog(), SequencerCounters(), Queue()
    stamps, poses = [], []
    for frame in frames_of(source, settings, counters, spent=log.add_decode, say=say):
        began, cpu = time.perf_counter(), time.process_time()
        result = tracker.track(frame)
        waited_ms = queue.wait_ms(frame.stamp_ns)
        track_ms = waited_ms + 1e3 * (time.perf_counter() - began)
        log.add_result(result.new_stretch, result.sound, result.waits)
        tracker.finish(frame, result.keyframe)
        queue.served(frame.stamp_ns, waited_ms + 1e3 * (time.perf_counter() - began))
        log.cpu_s += time.process_time() - cpu
        log.add(frame.stamp_ns, track_ms, result.state, result.keyframe)
        if result.T_odom_body is not None:
            stamps.append(frame.stamp_ns)
            poses.append(result.T_odom_body)
        told(result)
    memory.keep(tracker.bias)
    log.imu_doubted = tracker.doubted
    trajectory = Trajectory(np.array(stamps, np.int64), np.array(poses).reshape(-1, 4, 4))
    report = report_of(log, counters, settings) | {"left_out": source.losses.counts}
    report["failed_steps"] = guard.failed
    return TrackRun(trajectory, report | source.report() | memory.report())


def report_of(log: RunLog, counters: SequencerCounters, settings: config.Config) -> dict[str, Any]:
    """report.json of an agent that has not spoken to an edge."""
    return {
        **log.report(),
        "corrections": 0,
        "bytes_up": 0,
        "bytes_down": 0,
        "sequencer": dataclasses.asdict(counters),
        "version": __version__,
        "config": to_mapping(settings),
    }


def accuracy(run: TrackRun, truth: Trajectory | None) -> Ate | None:
    """ATE against the recording's own truth (SE3 alignment), None where there is none to speak of."""
    if truth is None:
        return None
    try:
        return ate(run.trajectory, truth)
    except DataError:  # too few poses with a truth at their time
        return None
