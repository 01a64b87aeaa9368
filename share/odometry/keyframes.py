"""Keyframes of a tracker with IMU: when to make one, what is published of it, and its work, in slices.

A keyframe's pose joins the state at once. The rest of its work, reactivation of dormant features, corners in
free areas and their depth, is split into slices. One slice runs after each frame's pose is published (more at
low frame rates), so that no frame waits for all of them. Which slice runs after which frame depends on stamps
alone, not on how long a slice takes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from share.config import InertialConfig
from share.earlier_poses import MAX_EARLIER, EarlierPoses
from share.geometry import se3
from share.odometry import filter
from share.odometry.initialisation import tilt_sigma
from share.odometry.landmarks import LandmarkMap
from share.odometry.relocalisation import POSE_COV
from share.odometry.state import FilterState
from share.types import F32, F64, Frame
from share.vision.corners import CornerPeaks
from share.vision.keyframe_images import Surfaces

KEYFRAME_GAP_NS = 100_000_000  # least time between keyframes


class KeyframeSpacing:
    """Decides when a frame is far enough from the newest keyframe, by poses (4, 4) of the body or of the
    camera: it has moved by more than distance_m or angle_rad, or has less than min_share of the newest
    keyframe's features.
    """

    def __init__(self, distance_m: float, angle_rad: float, min_share: float) -> None:
        self._distance_m, self._min_share = distance_m, min_share
        self._min_cosine = np.cos(min(angle_rad, np.pi))
        self.stamp_ns, self.feature_count = -(2**62), 0  # of the newest keyframe
        self.T = np.eye(4)

    def wants_keyframe(self, stamp_ns: int, T: F64, inlier_count: int) -> bool:
        """Return whether a frame with `inlier_count` features is to be a keyframe."""
        if stamp_ns - self.stamp_ns < KEYFRAME_GAP_NS:
            return False
        cosine = ((self.T[:3, :3] * T[:3, :3]).sum() - 1) / 2  # of the angle between the two
        return bool(
            np.linalg.norm(T[:3, 3] - self.T[:3, 3]) > self._distance_m
            or cosine < self._min_cosine
            or inlier_count < self._min_share * self.feature_count
        )


class LastPublishedKeyframe:
    """The last published keyframe, and the motion since then by the present state.

    The filter still corrects a keyframe's pose after its publication, at first mostly the tilt, by degrees.
    In the difference of published poses that would look like a rotation of the body. keyframe_id: -1 if the
    state does not have it.
    """

    def __init__(self) -> None:
        self.keyframe_id, self._T_odom_body = -1, np.eye(4)

    def reset(self) -> None:
        """The filter begins anew, with new keyframe ids."""
        self.keyframe_id = -1

    def update(self, s: FilterState, keyframe_id: int) -> None:
        """Make the keyframe with this id the last published one."""
        self.keyframe_id = keyframe_id
        self._T_odom_body = s.keyframe_poses[filter.keyframe_index(s, keyframe_id)]

    def turn(self, T_new_old: F64) -> None:
        """Give its pose in another odom."""
        self._T_odom_body = T_new_old @ self._T_odom_body

    def motion_to(self, s: FilterState, k: int, new_segment: bool) -> tuple[F64, F64]:
        """Return T_last_body (4, 4) of keyframe k and its covariance (6, 6), by the present state.

        Where the state no longer has the last published keyframe, after a loss: by the published pose, with
        the covariance of relocalisation. With `new_segment`: the pose in odom.
        """
        known = np.flatnonzero(s.keyframe_ids[:k] == self.keyframe_id)
        if new_segment:
            return s.keyframe_poses[k], filter.keyframe_cov(s, k)
        if len(known):
            return filter.relative_pose(s, int(known[0]), k), filter.relative_pose_cov(s, int(known[0]), k)
        return se3.inverse(self._T_odom_body) @ s.keyframe_poses[k], filter.keyframe_cov(s, k) + POSE_COV


_MIN_SEEN_SHARE = 0.8  # a smaller share of the newest keyframe's features in use triggers another
_PUBLISH_GAP_NS = 400_000_000  # minimum between published keyframes
_SLICE_PERIOD_NS = 30_000_000  # of the time between frames: two slices a frame at 15 Hz, one at 20 and at 30


class PublishedKeyframe(NamedTuple):
    """A keyframe's surfaces, pose T_odom_body (4, 4) and tilt sigma, rad, by the present state.

    T_previous_body (4, 4): motion since the keyframe published before, with its covariance (6, 6). earlier:
    relative to all published ones in the state.
    """

    surfaces: Surfaces
    T_odom_body: F64
    tilt_sigma: float
    T_previous_body: F64
    cov: F64
    earlier: EarlierPoses


class OfferedKeyframe(NamedTuple):
    """A keyframe that `publish` returned. It counts as published with the next frame: until then the caller
    may still fail."""

    frame: Frame
    keyframe_id: int
    surfaces: Surfaces


@dataclass(eq=False)
class _PendingKeyframe:
    """A keyframe with work left.

    occupied_px (N, 2): positions near which no new feature is searched. peaks: candidates for corners.
    corners: of new features.
    """

    frame: Frame
    keyframe_id: int
    occupied_px: F32
    peaks: CornerPeaks
    corners: F32 = field(default_factory=lambda: np.zeros((0, 2), np.float32))


# The frame is the one just tracked; the rate (3,) is the body's then.
KeyframeStep = Callable[[_PendingKeyframe, LandmarkMap, Frame, F64], None]
Slice = list[tuple[KeyframeStep, _PendingKeyframe]]


class KeyframeWork:
    """Spreads the work of one tracker's keyframes over frames, in slices."""

    def __init__(self, config: InertialConfig) -> None:
        self._spacing = KeyframeSpacing(config.keyframe_m, config.keyframe_rad, _MIN_SEEN_SHARE)
        self._last_published = LastPublishedKeyframe()
        self._published_ns = self._processed_ns = 0
        self._published: dict[int, int] = {}  # stamps, ns, of published keyframes by id
        self._offered: OfferedKeyframe | None = None
        self._newest: _PendingKeyframe | None = None
        self._to_publish: _PendingKeyframe | None = None  # the frame just tracked
        self._slices: deque[Slice] = deque()

    def wants_keyframe(self, stamp_ns: int, T_odom_body: F64, inlier_count: int) -> bool:
        """Return whether the frame just tracked, with `inlier_count` features, is to be a keyframe."""
        steps = (step for group in self._slices for step, _ in group)
        return self._admit_features not in steps and self._spacing.wants_keyframe(
            stamp_ns, T_odom_body, inlier_count
        )

    def add_and_finish(self, frame: Frame, landmarks: LandmarkMap, rate: F64) -> None:
        """Make the frame just tracked a keyframe and do all its work at once; for the time before the
        first pose. rate (3,): rad/s."""
        self.add(frame, landmarks, rate, urgent=True)
        self._run_slice(landmarks, frame, rate)

    def add(
        self, frame: Frame, landmarks: LandmarkMap, rate: F64, urgent: bool, publish: bool = False
    ) -> None:
        """Make the frame just tracked a keyframe, if it is not one: its pose now, the rest in
        `process_pending` after the work of earlier ones.

        publish: offer it for publishing. urgent: add all new features in the next slice, because few are
        left.
        """
        if frame.stamp_ns != self._spacing.stamp_ns:
            keyframe_id = landmarks.add_keyframe(rate)
            self._spacing.stamp_ns, self._spacing.T = frame.stamp_ns, landmarks.state.T
            pending = self._newest = _PendingKeyframe(
                frame, keyframe_id, landmarks.occupied_px(), CornerPeaks(frame.image0)
            )
            slices: list[Slice] = [
                [(self._reactivate, pending), (self._find_peaks, pending)],
                [(self._find_corners, pending)],
                [(self._admit_features, pending)],
            ]
            steps = [step for group in slices for step in group]
            if not urgent:
                self._slices.extend(slices)
            elif self._slices:
                self._slices[0][:0] = steps
            else:
                self._slices.append(steps)
        if publish:
            self._to_publish, self._published_ns = self._newest, frame.stamp_ns

    def may_publish(self, stamp_ns: int) -> bool:
        """Return whether another keyframe may be published."""
        return stamp_ns - self._published_ns >= _PUBLISH_GAP_NS

    @property
    def is_ready(self) -> bool:
        """Whether the frame just tracked is a keyframe to publish."""
        return self._to_publish is not None

    def publish(self, landmarks: LandmarkMap, new_segment: bool) -> PublishedKeyframe:
        """Return the keyframe that is ready. Raises ValueError without one."""
        pending, s = self._to_publish, landmarks.state
        if pending is None:
            raise ValueError("no keyframe is ready")
        surfaces = landmarks.surfaces(pending.frame)
        self._offered = OfferedKeyframe(pending.frame, pending.keyframe_id, surfaces)
        k = filter.keyframe_index(s, pending.keyframe_id)
        T_previous_body, cov = self._last_published.motion_to(s, k, new_segment)
        tilt = tilt_sigma(s, s.keyframe_columns(k))
        earlier = EarlierPoses.empty() if new_segment else self._earlier_poses(s, k)
        return PublishedKeyframe(surfaces, s.keyframe_poses[k], tilt, T_previous_body, cov, earlier)

    def _earlier_poses(self, s: FilterState, k: int) -> EarlierPoses:
        """Return the pose of keyframe k relative to the published ones in the state, newest last."""
        self._published = {i: self._published[i] for i in s.keyframe_ids.tolist() if i in self._published}
        indices = np.flatnonzero(np.isin(s.keyframe_ids, list(self._published)))[-MAX_EARLIER:]
        T, cov = filter.relative_poses(s, indices, k)
        stamps_ns = [self._published[i] for i in s.keyframe_ids[indices].tolist()]
        return EarlierPoses(np.array(stamps_ns, np.int64), T.astype(np.float32), cov.astype(np.float32))

    def process_pending(self, landmarks: LandmarkMap, frame: Frame, rate: F64) -> OfferedKeyframe | None:
        """Run the slices that there is time for after `frame`, the one just tracked: at least one, less the
        one that publishing a keyframe takes the time of. Call it once a frame.

        Return the keyframe that was offered since the last call, if any.
        """
        offered, self._offered = self._offered, None
        if offered is not None:
            # Not before: the caller might have failed after `publish`.
            self._last_published.update(landmarks.state, offered.keyframe_id)
            self._published[offered.keyframe_id] = offered.frame.stamp_ns
        slices = max(1, self._slice_count(frame))
        if self._to_publish is not None:  # published, or the caller did not want it
            self._to_publish = None
            slices -= 1
        self._processed_ns = frame.stamp_ns
        for _ in range(slices):
            if not self._slices:
                break
            self._run_slice(landmarks, frame, rate)
        return offered

    def _slice_count(self, frame: Frame) -> int:
        """Return the number of slices that there is time for after the frame just tracked."""
        return int((frame.stamp_ns - self._processed_ns) // _SLICE_PERIOD_NS)

    def turn(self, T_new_old: F64) -> None:
        """Give the poses of earlier keyframes in another odom."""
        self._spacing.T = T_new_old @ self._spacing.T
        self._last_published.turn(T_new_old)

    def reset(self) -> None:
        """Drop all pending work: the filter begins anew, with new keyframe ids."""
        self._offered = self._newest = self._to_publish = None
        self._slices.clear()
        self._published.clear()
        self._last_published.reset()

    def _run_slice(self, landmarks: LandmarkMap, last_frame: Frame, rate: F64) -> None:
        for step, pending in self._slices.popleft():
            step(pending, landmarks, last_frame, rate)

    def _reactivate(
        self, pending: _PendingKeyframe, landmarks: LandmarkMap, last_frame: Frame, rate: F64
    ) -> None:
        reactivated_px = landmarks.reactivate(last_frame, rate)
        pending.occupied_px = np.concatenate([pending.occupied_px, reactivated_px])
        landmarks.drop_keyframes((self._last_published.keyframe_id,))

    def _find_peaks(
        self, pending: _PendingKeyframe, landmarks: LandmarkMap, last_frame: Frame, rate: F64
    ) -> None:
        if landmarks.free_slots():
            pending.peaks.find_half()

    def _find_corners(
        self, pending: _PendingKeyframe, landmarks: LandmarkMap, last_frame: Frame, rate: F64
    ) -> None:
        pending.corners = landmarks.find_corners(pending.frame, pending.occupied_px, pending.peaks)

    def _admit_features(
        self, pending: _PendingKeyframe, landmarks: LandmarkMap, last_frame: Frame, rate: F64
    ) -> None:
        landmarks.admit_features(pending.frame, pending.keyframe_id, pending.corners)
        self._spacing.feature_count = len(landmarks.state.feature_ids)
