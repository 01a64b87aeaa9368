"""How wrong its tracker is, as an agent tells the edge: by the truth, by the error model, or not at all."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from share.metrics.frame_log import summary
from share.metrics.local_error import LocalError
from share.odometry.error_model.history import MOST_AGO, FrameOutcome, MotionHistory, RecentMotion
from share.odometry.error_model.inference import ErrorEstimate, OnnxSession, estimate_error
from share.odometry.error_model.inputs import error_model_input
from share.odometry.track_result import TrackResult
from share.timing import RingBuffer
from share.types import U8, FeatureStatistics, Frame, KeyframeCandidate

_MAX_TIMINGS = 50_000  # estimates that a report is about, the newest: hours, at two keyframes a second


class KeyframeTracker(Protocol):
    """What of either tracker is asked here."""

    def feature_statistics(self) -> FeatureStatistics: ...
    def make_keyframe(self, frame: Frame) -> KeyframeCandidate: ...


class ErrorEstimator(Protocol):
    """Of one agent."""

    def update(self, frame: Frame, result: TrackResult) -> float | None:
        """cm, after another frame; None where it is not known."""

    def make_keyframe(self, frame: Frame, tracker: KeyframeTracker) -> KeyframeCandidate:
        """Has `tracker` make the frame just tracked a keyframe, and looks at what it has to know of it."""

    def close(self) -> None: ...

    def report(self) -> dict[str, Any]:
        """For report.json."""


def frame_outcome(frame: Frame, result: TrackResult) -> FrameOutcome:
    """What of a frame and its result is remembered."""
    has_imu = len(frame.imu) > 0
    return FrameOutcome(
        frame.stamp_ns, has_imu, result.state, result.found_count, result.inlier_count, result.median_nis
    )


class NoErrorEstimate:
    """Nobody tells."""

    def update(self, frame: Frame, result: TrackResult) -> float | None:
        return None

    def make_keyframe(self, frame: Frame, tracker: KeyframeTracker) -> KeyframeCandidate:
        return tracker.make_keyframe(frame)

    def close(self) -> None:
        pass

    def report(self) -> dict[str, Any]:
        return {}


class GroundTruthError(NoErrorEstimate):
    """An oracle, for experiments."""

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
    """The error model, where time is drawn (`share.lab.evaluate.virtual_time`): it has answered when
    `keyframe` returns. What it said last holds until it says something else."""

    def __init__(self, network: OnnxSession) -> None:
        self._network, self._odometer = network, MotionHistory()
        self._seen: deque[tuple[int, U8]] = deque(maxlen=MOST_AGO)  # stamps, images
        self._latest: ErrorEstimate | None = None

    def update(self, frame: Frame, result: TrackResult) -> float | None:
        self._odometer.add_frame(frame_outcome(frame, result))
        self._seen.append((frame.stamp_ns, frame.image0))
        latest = self._latest
        return None if latest is None or result.T_odom_body is None else latest.error_cm

    def make_keyframe(self, frame: Frame, tracker: KeyframeTracker) -> KeyframeCandidate:
        statistics, candidate = tracker.feature_statistics(), tracker.make_keyframe(frame)
        stamp_ns, image = self._seen[-1 - candidate.frames_ago]
        self._submit(_EstimateJob(image, statistics, self._odometer.add_keyframe(stamp_ns, candidate)))
        return candidate

    def _submit(self, job: _EstimateJob) -> None:
        self._latest = self._estimate(job)

    def _estimate(self, job: _EstimateJob) -> ErrorEstimate:
        return estimate_error(
            self._network, error_model_input(job.image, job.feature_statistics, job.recent_motion)
        )


class BackgroundErrorModel(SynchronousErrorModel):
    """The error model, in a thread of its own. A keyframe that comes while it is busy waits; one more, and
    the older is left out (policy drop_estimate)."""

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
        counts = {"estimate_ms": timings.report(), "drop_estimate": self._dropped}
        return {"error_model": {**counts, "strange": self._unfamiliar}}

    def _run(self) -> None:
        while (job := self._next_job()) is not None:
            start_s = time.thread_time()
            try:
                latest = self._estimate(job)
            except Exception as error:  # a network is a file from somewhere; odometry goes on without it
                self._latest = None
                self._notify(f"the error model has failed and is left alone: {error}")
                return
            self._latest = latest
            self._unfamiliar += latest.out_of_distribution
            self._timings_ms.add([1e3 * (time.thread_time() - start_s)])

    def _next_job(self) -> _EstimateJob | None:
        with self._wake:
            self._wake.wait_for(lambda: self._is_closed or self._pending_job is not None)
            job, self._pending_job = self._pending_job, None
            return None if self._is_closed else job
