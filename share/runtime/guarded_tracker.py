"""A tracker in which a failure costs one frame, not the process."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

from share.config import Config
from share.errors import ShareError
from share.geometry.camera import ImuBias, Rig
from share.odometry.inertial_tracker import InertialTracker
from share.odometry.track_result import TrackResult
from share.runtime.fault_guard import FaultGuard
from share.runtime.pipeline import make_tracker
from share.types import F64, FeatureStatistics, Frame, OdometryKeyframe, TrackState

T = TypeVar("T")


class GuardedTracker:
    """The tracker that fits a rig, see `make_tracker`. `guard` records what fails in it, such as a singular
    matrix. The frame is then LOST, and the next one relocalises by the tracker's keyframes; if that fails
    too, a new tracker is made."""

    def __init__(self, rig: Rig, config: Config, guard: FaultGuard, bias: ImuBias | None = None) -> None:
        """bias: initial bias of the IMU, None if unknown."""
        self._make_tracker = partial(make_tracker, rig, config)
        self._tracker, self._guard = self._make_tracker(bias), guard
        self._initial_bias, self._dropped_before = bias, False  # dropped by an earlier tracker
        self._timeshift_ns = rig.timeshift_ns
        self.bias: ImuBias | None = None  # newest estimate at a keyframe
        self._had_pose = False  # since the last failure
        self._rejected_before = 0  # IMU samples, by earlier trackers

    def track(self, frame: Frame) -> TrackResult:
        result = self.attempt("tracking a frame", frame, lambda: self._tracker.track(frame))
        if result is None:
            return TrackResult(TrackState.LOST, None)
        self._had_pose = self._had_pose or result.T_odom_body is not None
        return result

    def predict(self, frame: Frame) -> F64 | None:
        """Return T_odom_body (4, 4) at a frame that is not tracked, by the IMU samples since the last one
        that was; None without a pose, or a tracker that knows the IMU."""
        T_odom_body = None
        if isinstance(self._tracker, InertialTracker) and len(frame.imu):
            with self._guard.step("predicting a pose"):
                T_odom_body = self._tracker.predict(frame.stamp_ns + self._timeshift_ns, frame.imu)
        return T_odom_body

    def attempt(self, what: str, frame: Frame, step: Callable[[], T]) -> T | None:
        """Return `step()`, a step of the newest `frame`; None if it fails. Raises ShareError only."""
        try:
            return step()
        except ShareError:
            raise
        except Exception as error:
            self._guard.record(what, error)
            self._recover(frame)
            return None

    def finish(
        self,
        frame: Frame,
        is_keyframe: bool,
        make_keyframe: Callable[[Frame, GuardedTracker], OdometryKeyframe] | None = None,
    ) -> OdometryKeyframe | None:
        """Finish the frame just tracked where its keyframe is not sent before. is_keyframe: make it a
        keyframe, by `make_keyframe` where one is given."""
        candidate = None
        if is_keyframe:
            step = (
                partial(make_keyframe, frame, self) if make_keyframe else partial(self.make_keyframe, frame)
            )
            candidate = self.attempt("making a keyframe", frame, step)
        self.attempt("finishing a keyframe", frame, self._tracker.finish_keyframe)
        return candidate

    def make_keyframe(self, frame: Frame) -> OdometryKeyframe:
        """Call within `attempt`, like `finish_keyframe` and `feature_statistics`."""
        candidate = self._tracker.make_keyframe(frame)
        self.bias = self._tracker.bias or self.bias
        return candidate

    def finish_keyframe(self) -> None:
        self._tracker.finish_keyframe()

    def feature_statistics(self) -> FeatureStatistics:
        return self._tracker.feature_statistics()

    @property
    def rejected_imu_samples(self) -> int:
        """Number of IMU samples rejected as outliers, over all trackers."""
        return self._rejected_before + self._tracker.rejected_imu_samples

    @property
    def has_dropped_bias(self) -> bool:
        """Whether the initial bias is not used, because a body at rest contradicts it."""
        is_dropped = isinstance(self._tracker, InertialTracker) and self._tracker.has_dropped_bias
        return self._dropped_before or is_dropped

    def _recover(self, frame: Frame) -> None:
        had_pose, self._had_pose = self._had_pose, False
        try:
            if had_pose:
                self._tracker.reset_after_failure(frame)
                return
        except Exception as error:
            self._guard.record("resetting the tracker", error)
        self._rejected_before += self._tracker.rejected_imu_samples
        self._dropped_before = self.has_dropped_bias
        self._tracker = self._make_tracker(None if self._dropped_before else self._initial_bias)
