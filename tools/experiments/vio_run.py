"""One run of the inertial tracker over one recording: its poses and figures of them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from consistency import Deviations, deviations, nees, share_within

from share.config import Config
from share.errors import DataError
from share.geometry import se3
from share.geometry.interpolation import associate
from share.metrics.ate import ate
from share.metrics.frame_log import RunLog
from share.metrics.rpe import rpe_time
from share.odometry.inertial_tracker import InertialTracker
from share.odometry.track_result import TrackResult
from share.recordings.trajectory import Trajectory
from share.runtime.pipeline import make_tracker, read_frames
from share.runtime.source import Source
from share.sensors.sequencer import SequencerCounters
from share.types import F64, I64, TrackState

ACCURACY = (
    *("ate_cm", "worst_cm", "rpe_1s_cm", "rpe_1s_deg"),
    *("nees_position", "inside_position", "nees_orientation", "inside_orientation"),
)


@dataclass
class TrackedRun:
    """The frames with a pose: stamps, published poses, the body's motion since the filter began (as published
    but that odom turns upright) and its covariances, index of the unbroken segment. CPU ms of every frame and
    of every keyframe."""

    stamps: list[int] = field(default_factory=list)
    poses: list[F64] = field(default_factory=list)
    motions: list[F64] = field(default_factory=list)
    covs: list[F64] = field(default_factory=list)
    segments: list[int] = field(default_factory=list)
    track_ms: list[float] = field(default_factory=list)
    keyframe_ms: list[float] = field(default_factory=list)
    log: RunLog = field(default_factory=RunLog)

    @property
    def trajectory(self) -> Trajectory:
        return Trajectory(np.array(self.stamps, np.int64), np.array(self.poses).reshape(-1, 4, 4))

    def add(self, stamp_ns: int, result: TrackResult, motion: F64 | None) -> None:
        self.log.segments += result.new_segment
        self.log.add(stamp_ns, self.track_ms[-1], result.state, result.keyframe_ready)
        if result.T_odom_body is not None:
            assert result.cov is not None and motion is not None  # of the inertial tracker
            self.motions.append(motion)
            self.stamps.append(stamp_ns)
            self.poses.append(result.T_odom_body)
            self.covs.append(result.cov)
            self.segments.append(self.log.segments)


@dataclass(frozen=True, eq=False)
class Series:
    """The frames with a pose and ground truth: stamps (N,), segment (N,), deviations."""

    stamps_ns: I64
    segment: I64
    deviations: Deviations


def follow(source: Source, settings: Config) -> TrackedRun:
    """Track every frame in turn, causal. Decoding does not count."""
    tracker, run = make_tracker(source.rig, settings), TrackedRun()
    assert isinstance(tracker, InertialTracker)  # all sequences have an IMU
    for frame in read_frames(source, settings, SequencerCounters()):
        began = time.process_time()
        result = tracker.track(frame)
        run.track_ms.append(1e3 * (time.process_time() - began))
        s = tracker.state
        motion = None if s is None else se3.inverse(s.T_origin) @ s.T
        if result.keyframe_ready:
            began = time.process_time()
            tracker.make_keyframe(frame)
            tracker.finish_keyframe()
            run.keyframe_ms.append(1e3 * (time.process_time() - began))
        run.add(frame.stamp_ns, result, motion)
    return run


def series(source: Source, run: TrackedRun) -> Series:
    truth, (stamps, _) = source.truth(), run.trajectory
    assert truth is not None  # the emulator writes it
    motions = np.array(run.motions).reshape(-1, 4, 4)
    at, poses, true = associate(Trajectory(stamps, motions), truth)
    chosen = np.isin(stamps, at)
    segment = np.array(run.segments, np.int64)[chosen]
    covs = np.array(run.covs).reshape(-1, 6, 6)[chosen]
    return Series(at, segment, deviations(poses, covs, true, segment))


def figures(source: Source, run: TrackedRun, found: Series) -> dict[str, Any]:
    """Return all figures of a run; accuracies are None where there are too few poses."""
    report, frames = run.log.report(), run.log.frames()
    return {
        "frames": report["frames"],
        "with_pose": report["tracked"] / report["frames"],
        "with_truth": len(found.stamps_ns),
        **accuracy(source, run, found),
        "states": {str(state): int(frames.in_state(state).sum()) / len(frames) for state in TrackState},
        "lost_s": report["lost_s"],
        "init_s": report["init_s"],
        "new_stretches": max(report["segments"] - 1, 0),
        "track_ms": _percentile(run.track_ms, 50),
        "track_p99_ms": _percentile(run.track_ms, 99),
        "keyframes": report["keyframes"],
        "keyframe_ms": _percentile(run.keyframe_ms, 50),
        "keyframe_p99_ms": _percentile(run.keyframe_ms, 99),
    }


def accuracy(source: Source, run: TrackedRun, found: Series) -> dict[str, float | None]:
    """Return accuracies with one alignment over all frames: a break of odometry shows in the ATE."""
    estimate, truth = run.trajectory, source.truth()
    assert truth is not None
    try:
        absolute, relative = ate(estimate, truth), rpe_time(estimate, truth)
    except DataError:
        return dict.fromkeys(ACCURACY)
    values = (absolute.rmse, absolute.max, relative.translation.rmse)
    degrees = float(np.degrees(relative.rotation.rmse))
    return dict(
        zip(ACCURACY, [*(100 * v for v in values), degrees, *consistency(found.deviations)], strict=True)
    )


def consistency(found: Deviations) -> Iterator[float]:
    """Yield, of position, then orientation: mean NEES of three axes (3 is consistent) and share of frames
    within 3 sigma on each axis. Poses at which the truth is aligned are left out."""
    rest = ~found.is_aligned
    for part in (slice(3, 6), slice(0, 3)):
        errors, cov = found.errors[rest, part], found.cov[rest, part, part]
        yield float(nees(errors, cov).mean())
        yield share_within(errors, found.sigmas[rest, part])


def _percentile(values: list[float], q: float) -> float | None:
    return float(np.percentile(values, q)) if values else None
