"""The tracker: frames in, poses out. Deterministic, without threads, and the same as `share track` runs."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from typing import Any

from numpy.typing import ArrayLike, NDArray

from share.config import Config
from share.errors import UsageError
from share.geometry.camera import Rig
from share.library.checked_input import (
    check_frame,
    checked_config,
    checked_kind,
    checked_rate_hz,
    image_samples,
    imu_sample,
)
from share.recordings.images import decode_frame
from share.runtime.error_estimators import NoErrorEstimate
from share.runtime.fault_guard import FaultGuard
from share.runtime.guarded_tracker import GuardedTracker
from share.runtime.pipeline import check_trackable
from share.runtime.pose import Pose, tracked_pose
from share.sensors.measurement import Measurement
from share.sensors.sequencer import FrameMerger, FrameSequencer, SequencerCounters, rig_streams
from share.types import Frame, TrackState, WaitReason

logger = logging.getLogger("share")


class Tracker:
    """Visual-inertial odometry of one body.

    Give it whole frames by `track`, or the samples of your own camera, as they come, by `feed_imu` and
    `feed_images`, which merge them into frames; not both. state: of the last frame. waiting_for: what it
    needs before its first pose, None if nothing.

    A frame on which something fails inside is LOST, and a line goes to the logger "share".
    """

    def __init__(self, rig: Rig, config: Config | None = None, rate_hz: float = 0.0) -> None:
        """rate_hz: of cam0's images, by which missing ones are noticed; 0: unknown. Raises ShareError,
        also if no tracker fits the rig."""
        check_trackable("rig", checked_kind("rig", rig, Rig, "a Rig"))
        settings = checked_config(config)
        rate_hz = checked_rate_hz(rate_hz, may_be_unknown=True)
        self.rig = rig
        self.state = TrackState.INITIALISING
        self.waiting_for: WaitReason | None = None
        self._tracker = GuardedTracker(rig, settings, FaultGuard(logger.warning))
        self._sequencer = FrameSequencer(
            FrameMerger(rig_streams(rig), rate_hz, settings.sequencer, SequencerCounters(), rig.timeshift_ns)
        )
        self._segment, self._newest_ns = 0, -1
        self._unfinished: tuple[Frame, bool] | None = None  # the last frame; whether it becomes a keyframe

    def track(self, frame: Frame) -> Pose | None:
        """Return the pose of a frame, by what is known up to it; None without one (see `state`).

        Frames come with rising stamps, each with the IMU samples since the frame before, up to the first one
        not before it. Raises ShareError for images that do not fit the rig, or a stamp that does not rise.
        """
        check_frame(frame, self.rig)
        if frame.stamp_ns <= self._newest_ns:
            raise UsageError(f"stamp_ns: {frame.stamp_ns} is not after the last frame's, {self._newest_ns}")
        return self._track(frame)

    def feed_imu(self, stamp_ns: int, gyro: ArrayLike, accel: ArrayLike) -> list[Pose]:
        """Add an IMU sample, and return the poses of frames that waited for it.

        gyro (3,) rad/s, accel (3,) m/s^2 (at rest 9.81 upwards), in the body's axes. Raises ShareError.
        """
        return self._feed([imu_sample(self.rig, stamp_ns, gyro, accel)])

    def feed_images(
        self,
        stamp_ns: int,
        image0: NDArray[Any],
        image1: NDArray[Any] | None = None,
        depth: NDArray[Any] | None = None,
    ) -> list[Pose]:
        """Add the images of one moment, and return the poses that are known now.

        With an IMU a frame waits for the first sample at or after its stamp, up to
        `sequencer.imu_silent_ms`. image0, image1: gray (H, W) uint8. depth: (Hd, Wd) float32, m, 0 = no
        reading. They are copied. Raises ShareError.
        """
        return self._feed(image_samples(self.rig, stamp_ns, image0, image1, depth))

    def finish(self) -> list[Pose]:
        """Return the poses of fed frames that still wait: nothing follows."""
        return self._poses(self._sequencer.finish())

    def make_keyframe(self) -> None:
        """Do the work that follows a frame's pose, such as a keyframe. Call it once the pose is used; else
        the next frame waits for it."""
        if self._unfinished is not None:
            frame, is_keyframe = self._unfinished
            self._unfinished = None
            self._tracker.finish(frame, is_keyframe, NoErrorEstimate().make_keyframe)

    def _track(self, frame: Frame) -> Pose | None:
        self.make_keyframe()
        result = self._tracker.track(frame)
        self._unfinished, self._newest_ns = (frame, result.keyframe_ready), frame.stamp_ns
        self.state, self.waiting_for = result.state, result.waiting_for
        self._segment += result.new_segment
        return tracked_pose(frame.stamp_ns, self._segment, result)

    def _feed(self, measurements: Iterable[Measurement]) -> list[Pose]:
        return [pose for one in measurements for pose in self._poses(self._sequencer.feed(one))]

    def _poses(self, frames: Iterator[Any]) -> list[Pose]:
        poses = (self._track(decode_frame(frame)) for frame in frames)
        return [pose for pose in poses if pose is not None]
