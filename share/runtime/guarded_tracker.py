"""A tracker whose failures cost the frame that they come in, and not the process."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

from share.config import Config
from share.errors import ShareError
from share.geometry.camera import ImuBias, Rig
from share.odometry.track_result import TrackResult
from share.runtime.pipeline import make_tracker
from share.types import FeatureStatistics, Frame, KeyframeCandidate, TrackState

# ---- A step that fails costs what it was about, and not the process.

_MAX_FAILURE_KINDS = 16  # kinds of failure


class FaultGuard:
    """Counts steps that failed, and says each kind once, with the place in the program."""

    def __init__(self, notify: Callable[[str], None]) -> None:
        self.failure_count = 0
        self._notify = notify
        self._reported: set[str] = set()

    @contextmanager
    def step(self, what: str) -> Iterator[None]:
        """Within it any error but a ShareError, which ends a run by intent, costs only this step."""
        try:
            yield
        except ShareError:
            raise
        except Exception as error:
            self.record(what, error)

    def record(self, what: str, error: Exception) -> None:
        self.failure_count += 1
        frame_summary = traceback.extract_tb(error.__traceback__)[-1]
        kind = (
            f"{what}: {type(error).__name__} at "
            f"{frame_summary.filename.rpartition('/')[2]}:{frame_summary.lineno}"
        )
        if kind not in self._reported and len(self._reported) < _MAX_FAILURE_KINDS:
            self._reported.add(kind)
            text = "".join(c if c.isprintable() else "?" for c in str(error))[:200]
            self._notify(f"{kind}: {text}; it is left out and the run goes on")


T = TypeVar("T")


class GuardedTracker:
    """The estimator that fits a rig, see `InertialTracker`. What fails in it, a matrix that has no inverse or
    a library that refuses its numbers, is counted and said by `guard`. The frame is LOST, and the next one
    looks for itself among the places that the tracker knows; if that fails too, a new one begins."""

    def __init__(self, rig: Rig, config: Config, guard: FaultGuard, bias: ImuBias | None = None) -> None:
        """bias: of the rig's IMU, where that is known."""
        self._make_tracker = partial(make_tracker, rig, config, bias)
        self._tracker, self._guard = self._make_tracker(), guard
        self.bias: ImuBias | None = None  # as was learnt by the last keyframe by which any was
        self._had_pose = False  # since it failed last
        self._rejected_before = 0  # by trackers before this one

    def track(self, frame: Frame) -> TrackResult:
        result = self.attempt("tracking a frame", frame, lambda: self._tracker.track(frame))
        if result is None:
            return TrackResult(TrackState.LOST, None)
        self._had_pose = self._had_pose or result.T_odom_body is not None
        return result

    def attempt(self, what: str, frame: Frame, step: Callable[[], T]) -> T | None:
        """Of `frame`, the last; None where it fails. An error that is for a person goes on."""
        try:
            return step()
        except ShareError:
            raise
        except Exception as error:
            self._guard.record(what, error)
            self._recover(frame)
            return None

    def finish(self, frame: Frame, is_keyframe: bool) -> None:
        """What is left to do for the frame just tracked, where nobody else is to have what it shows.
        keyframe: whether it is one."""
        if is_keyframe:
            self.attempt("making a keyframe", frame, partial(self.make_keyframe, frame))
        self.attempt("settling a frame", frame, self._tracker.finish_keyframe)

    def make_keyframe(self, frame: Frame) -> KeyframeCandidate:
        """Within `attempt`; so `finish_keyframe` and `feature_statistics`."""
        candidate = self._tracker.make_keyframe(frame)
        self.bias = self._tracker.bias or self.bias
        return candidate

    def finish_keyframe(self) -> None:
        self._tracker.finish_keyframe()

    def feature_statistics(self) -> FeatureStatistics:
        return self._tracker.feature_statistics()

    @property
    def rejected_imu_samples(self) -> int:
        """How many IMU samples were not believed, since the beginning."""
        return self._rejected_before + self._tracker.rejected_imu_samples

    def _recover(self, frame: Frame) -> None:
        had_pose, self._had_pose = self._had_pose, False
        try:
            if had_pose:
                self._tracker.reset_after_failure(frame)
                return
        except Exception as error:
            self._guard.record("looking for itself again", error)
        self._rejected_before += self._tracker.rejected_imu_samples
        self._tracker = self._make_tracker()
