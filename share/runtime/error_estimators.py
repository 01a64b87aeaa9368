"""Estimators of an agent's tracking error: from ground truth, by the error model, or none."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from share.metrics.frame_log import summary
from share.metrics.local_error import LocalError
from share.odometry.error_model.history import FrameOutcome, MotionHistory, RecentMotion
from share.odometry.error_model.inputs import error_model_input
from share.odometry.error_model.network import ErrorEstimate, OnnxSession, estimate_error, open_error_model
from share.odometry.track_result import TrackResult
from share.timing import RingBuffer
from share.types import U8, FeatureStatistics, Frame, OdometryKeyframe

_MAX_TIMINGS = 50_000  # newest estimates that a report covers: hours at two keyframes a second


class KeyframeTracker(Protocol):
    """The part of a tracker that an error estimator uses."""

    def feature_statistics(self) -> FeatureStatistics: ...
    def make_keyframe(self, frame: Frame) -> OdometryKeyframe: ...


class ErrorEstimator(Protocol):
    """Estimates the tracking error of one agent."""

    def update(self, frame: Frame, result: TrackResult) -> float | None:
        """Add a tracked frame. Return the error, cm; None if unknown."""

    def make_keyframe(self, frame: Frame, tracker: KeyframeTracker) -> OdometryKeyframe:
        """Have `tracker` make the frame just tracked a keyframe, and use it as input for the next
        estimate."""

    def close(self) -> None: ...

    def report(self) -> dict[str, Any]:
        """For report.json."""


def frame_outcome(frame: Frame, result: TrackResult) -> FrameOutcome:
    """Return the part of a frame and its result that the error model's history keeps."""
    has_imu = len(frame.imu) > 0
    return FrameOutcome(
        frame.stamp_ns, has_imu, result.state, result.found_count, result.inlier_count, result.median_nis
    )


class NoErrorEstimate:
    """Gives no estimate."""

    def update(self, frame: Frame, result: TrackResult) -> float | None:
        return None

    def make_keyframe(self, frame: Frame, tracker: KeyframeTracker) -> OdometryKeyframe:
        return tracker.make_keyframe(frame)

    def close(self) -> None:
        pass

    def report(self) -> dict[str, Any]:
        return {}


class GroundTruthError(NoErrorEstimate):
    """The true error, from a recording's ground truth; for experiments."""

    def __init__(self, error: LocalError) -> None:
        self._error = error

    def update(self, frame: Frame, result: TrackResult) -> float | None:
        return self._error.update(frame.stamp_ns, result.T_odom_body, result.new_segment)


@dataclass(frozen=True, eq=False)
class _EstimateJob:
    image: U8
    feature_statistics: FeatureStatistics
    recent_motion: RecentMotion


class SynchronousErrorModel(NoErrorEstimate):
    """The error model, run within `make_keyframe`; used in virtual time (`share.lab.evaluate.virtual_time`).

    An estimate holds until the next one.
    """

    def __init__(self, network: OnnxSession) -> None:
        self._network, self._odometer = network, MotionHistory()
        self._latest: ErrorEstimate | None = None

    def update(self, frame: Frame, result: TrackResult) -> float | None:
        self._odometer.add_frame(frame_outcome(frame, result))
        latest = self._latest
        return None if latest is None or result.T_odom_body is None else latest.error_cm

    def make_keyframe(self, frame: Frame, tracker: KeyframeTracker) -> OdometryKeyframe:
        statistics, candidate = tracker.feature_statistics(), tracker.make_keyframe(frame)
        recent_motion = self._odometer.add_keyframe(frame.stamp_ns, candidate)
        self._submit(_EstimateJob(frame.image0, statistics, recent_motion))
        return candidate

    def _submit(self, job: _EstimateJob) -> None:
        self._latest = self._estimate(job)

    def _estimate(self, job: _EstimateJob) -> ErrorEstimate:
        return estimate_error(
            self._network, error_model_input(job.image, job.feature_statistics, job.recent_motion)
        )


class BackgroundErrorModel(SynchronousErrorModel):
    """The error model in a thread. While it is busy, only the newest keyframe waits (policy
    drop_estimate)."""

    def __init__(self, network: OnnxSession, notify: Callable[[str], None]) -> None:
        super().__init__(network)
        self._notify = notify
        self._pending_job: _EstimateJob | None = None
        self._wake = threading.Condition()
        self._is_closed = False
        self._timings_ms = RingBuffer(1, _MAX_TIMINGS)
        self._dropped = self._unfamiliar = 0
        self._thread = threading.Thread(target=self._run, name="error model", daemon=True)
        self._thread.start()

    def _submit(self, job: _EstimateJob) -> None:
        with self._wake:
            self._dropped += self._pending_job is not None
            self._pending_job = job
            self._wake.notify()

    def close(self) -> None:
        with self._wake:
            self._is_closed = True
            self._wake.notify()
        self._thread.join(timeout=2)

    def report(self) -> dict[str, Any]:
        timings = summary(np.array(self._timings_ms.column(0), float))
        counts = {"estimate_ms": timings.report(), "dropped_estimates": self._dropped}
        return {"error_model": {**counts, "unfamiliar": self._unfamiliar}}

    def _run(self) -> None:
        while (job := self._next_job()) is not None:
            start_s = time.thread_time()
            try:
                latest = self._estimate(job)
            except Exception as error:  # the network is a user's file; odometry goes on without it
                self._latest = None
                self._notify(f"the error model failed and is switched off: {error}")
                return
            self._latest = latest
            self._unfamiliar += latest.out_of_distribution
            self._timings_ms.add([1e3 * (time.thread_time() - start_s)])

    def _next_job(self) -> _EstimateJob | None:
        with self._wake:
            self._wake.wait_for(lambda: self._is_closed or self._pending_job is not None)
            job, self._pending_job = self._pending_job, None
            return None if self._is_closed else job


def model_estimator(error_model: str, notify: Callable[[str], None]) -> BackgroundErrorModel | None:
    """Return the error model `shipped` or of a file, running in a thread; None for "". Raises DataError."""
    return BackgroundErrorModel(open_error_model(error_model), notify) if error_model else None
