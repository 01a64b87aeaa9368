"""Keyframes of a headset's own odometry: when it wants one, what that shows to others, and the work that one
brings, in slices.

A keyframe's pose joins the filter's state at once. All else is done after the poses of this frame and the
next ones are out, one slice a frame (more where frames are rare), so that no frame waits for the whole of
it: the view that others are shown, if they are told of it, features seen from about here before, free
corners, and their depth. A view is told at a fixed frame, and what is new is sought from a fixed frame on,
however long a slice takes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import Rig
from share.odometry import filter
from share.odometry.initialisation import tilt_sigma
from share.odometry.landmarks import LandmarkMap
from share.odometry.state import FilterState
from share.types import F32, F64, FeatureStatistics, Frame, View
from share.vision.orb import ViewBuilder

# ---- When a frame is far enough from the newest keyframe to be the next one.


class KeyframeSpacing:
    """From the newest keyframe of one tracker, by poses (4, 4) of its body or of its camera.

    gap_s: s, sooner there is none; m, rad: after so much motion; left: or with less than this part in view
    of the features that the newest had.
    """

    def __init__(self, gap_s: float, distance_m: float, angle_rad: float, min_share: float) -> None:
        self._gap_ns, self._distance_m, self._min_share = gap_s * 1e9, distance_m, min_share
        self._min_cosine = np.cos(min(angle_rad, np.pi))
        self.stamp_ns = self.feature_count = 0  # of the newest
        self.T = np.eye(4)

    def wants_keyframe(self, stamp_ns: int, T: F64, inlier_count: int) -> bool:
        """Whether a frame with so many features seen is to be one: moved, turned, or little left in view."""
        if stamp_ns - self.stamp_ns < self._gap_ns:
            return False
        cosine = ((self.T[:3, :3] * T[:3, :3]).sum() - 1) / 2  # of the angle between the two
        return bool(
            np.linalg.norm(T[:3, 3] - self.T[:3, 3]) > self._distance_m
            or cosine < self._min_cosine
            or inlier_count < self._min_share * self.feature_count
        )


# ---- How far the body has moved since the keyframe that others were told of last, as it is known by now.
#
# What was told of that keyframe has been corrected since: at first mostly its tilt, by degrees. The
# difference of what was told would have that as a turn of the body.

_RELOCALISED_COV = np.diag(
    np.repeat([0.01**2, 0.03**2], 3)
)  # rad, m: of a place found again by its ORB features


class LastPublishedKeyframe:
    """The keyframe that others were told of last: its id; -1 where the filter has none."""

    def __init__(self) -> None:
        self.keyframe_id, self._T_odom_body = -1, np.eye(4)

    def reset(self) -> None:
        """The filter's keyframes are numbered anew."""
        self.keyframe_id = -1

    def update(self, s: FilterState, keyframe_id: int) -> None:
        """The one with this id is the last one from now on: others have it."""
        self.keyframe_id, self._T_odom_body = (
            keyframe_id,
            s.keyframe_poses[filter.keyframe_index(s, keyframe_id)],
        )

    def motion_to(self, s: FilterState, k: int, new_segment: bool) -> tuple[F64, F64]:
        """T_last_body (4, 4) of keyframe number k and its covariance (6, 6): as the state knows both now.
        Where it has the last one no longer, after a loss, as they were told, and as unsure as the place where
        the body was found again."""
        known = np.flatnonzero(s.keyframe_ids[:k] == self.keyframe_id)
        if new_segment:
            return s.keyframe_poses[k], filter.keyframe_cov(s, k)
        if len(known):
            return filter.relative_pose(s, int(known[0]), k), filter.relative_pose_cov(s, int(known[0]), k)
        return se3.inverse(self._T_odom_body) @ s.keyframe_poses[k], filter.keyframe_cov(
            s, k
        ) + _RELOCALISED_COV


_PUBLISH_GAP_NS = 400_000_000  # between keyframes that others are told of
_SLICE_PERIOD_NS = 30_000_000  # of the time between frames: two slices a frame at 15 Hz, one at 20 and at 30


class PublishedView(NamedTuple):
    """Of a keyframe: its view, its pose T (4, 4) and the sigma of what is up there, rad, as the filter knows
    them now; T_last_body (4, 4) since the one shown before, and its covariance (6, 6). frames_ago: how many
    frames have been tracked since its own."""

    view: View
    T_odom_body: F64
    tilt_sigma: float
    T_previous_body: F64
    cov: F64
    frames_ago: int


class OfferedKeyframe(NamedTuple):
    """A keyframe, by id, whose candidate was made, and that others are told of unless something fails."""

    frame: Frame
    keyframe_id: int
    view: View


@dataclass(eq=False)
class _PendingKeyframe:
    """Of the keyframe with id `keyframe_id`, whose frame this is: px (N, 2) near which nothing new is
    sought, and
    of new corners; `frames_ago` frames have been settled since. view, and what its pose rested on: if others
    are to be told of it."""

    frame: Frame
    keyframe_id: int
    occupied_px: F32
    corners: F32 = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    frames_ago: int = 0
    view: ViewBuilder | None = None
    footing: FeatureStatistics | None = None
    is_ready: bool = False  # what it shows is for the next who asks


KeyframeStep = Callable[
    [_PendingKeyframe, LandmarkMap, Frame, F64], None
]  # with the frame just tracked, and its rate
Slice = list[tuple[KeyframeStep, _PendingKeyframe]]


class KeyframeScheduler:
    """Those of one tracker, newest last in its scene."""

    def __init__(self, rig: Rig, config: InertialConfig, view_features: int) -> None:
        self._rig, self._view_features = rig, view_features
        c = config
        self._spacing = KeyframeSpacing(c.keyframe_gap_s, c.keyframe_m, c.keyframe_rad, c.keyframe_seen)
        self._last_published = LastPublishedKeyframe()
        self._published_ns = self._processed_ns = 0
        self._offered: OfferedKeyframe | None = None
        self._newest_pending: _PendingKeyframe | None = None
        self._to_publish: _PendingKeyframe | None = None  # of which others are told next
        self._slices: deque[Slice] = deque()

    def wants_keyframe(self, stamp_ns: int, T_odom_body: F64, inlier_count: int) -> bool:
        """Whether a frame with so many features seen is to be one."""
        steps = (step for group in self._slices for step, _ in group)
        return self._add_features not in steps and self._spacing.wants_keyframe(
            stamp_ns, T_odom_body, inlier_count
        )

    def add_at_once(self, frame: Frame, landmarks: LandmarkMap, rate: F64) -> None:
        """Make the frame just tracked one, all at once: where no pose is told yet. rate (3,): rad/s."""
        self.add(frame, landmarks, rate, urgent=True)
        self._run_slice(landmarks, frame, rate)

    def add(
        self, frame: Frame, landmarks: LandmarkMap, rate: F64, urgent: bool, publish: bool = False
    ) -> None:
        """Make the frame just tracked one, if it is not: its pose; the rest is for `process_pending`, after
        what an
        earlier one still takes. to_show: others are to be told of it, when its view is made, which is what
        comes first. urgent: all new features with the next slice, for there is little to go by."""
        if frame.stamp_ns == self._spacing.stamp_ns:
            return
        keyframe_id = landmarks.add_keyframe(rate)
        self._spacing.stamp_ns, self._spacing.T = frame.stamp_ns, landmarks.state.T
        pending = self._newest_pending = _PendingKeyframe(frame, keyframe_id, landmarks.occupied_px())
        features: Slice = [
            (step, pending) for step in (self._reactivate, self._find_corners, self._add_features)
        ]
        view: Slice = (
            [(step, pending) for step in (self._detect_view, self._describe_view)] if publish else []
        )
        if view and self._at_a_time(frame) == 1:
            view[-1] = (self._describe_more, pending)
        if publish:
            self._start_publishing(landmarks)
        if not urgent:
            self._slices.extend([step] for step in [*view, *features])
            return
        if self._slices:
            self._slices[0][:0] = features
        else:
            self._slices.append(features)
        self._slices.extend([step] for step in view)

    def publish_at_once(self, landmarks: LandmarkMap) -> None:
        """Others are to be told of the newest, which is the frame just tracked, now."""
        self._start_publishing(landmarks).is_ready = True

    def _start_publishing(self, landmarks: LandmarkMap) -> _PendingKeyframe:
        pending = self._to_publish = self._newest_pending
        assert pending is not None
        self._published_ns, pending.footing = pending.frame.stamp_ns, landmarks.feature_statistics()
        pending.view = ViewBuilder(
            pending.frame, self._rig, self._view_features, landmarks.known_depths(pending.frame)
        )
        return pending

    def may_publish(self, stamp_ns: int) -> bool:
        """Whether it is time to tell others of one."""
        return self._to_publish is None and stamp_ns - self._published_ns >= _PUBLISH_GAP_NS

    @property
    def is_ready(self) -> bool:
        """Whether there is one that others are to be told of now."""
        return self._to_publish is not None and self._to_publish.is_ready

    @property
    def footing(self) -> FeatureStatistics | None:
        """What the pose of the one that is due rested on; None where none is."""
        return (
            self._to_publish.footing if self._to_publish is not None and self._to_publish.is_ready else None
        )

    def publish(self, landmarks: LandmarkMap, new_segment: bool) -> PublishedView:
        """The one that is due. Raises ValueError where none is."""
        pending, s = self._to_publish, landmarks.state
        if pending is None or pending.view is None or not pending.is_ready:
            raise ValueError("no keyframe is due")
        view = pending.view.finish()
        self._offered = OfferedKeyframe(pending.frame, pending.keyframe_id, view)
        k = filter.keyframe_index(s, pending.keyframe_id)
        T_previous_body, cov = self._last_published.motion_to(s, k, new_segment)
        return PublishedView(
            view,
            s.keyframe_poses[k],
            tilt_sigma(s, s.keyframe_columns(k)),
            T_previous_body,
            cov,
            pending.frames_ago,
        )

    def process_pending(self, landmarks: LandmarkMap, frame: Frame, rate: F64) -> OfferedKeyframe | None:
        """A slice of what is left to do, or as many as there is time for between frames, once a frame, of
        which `frame` is the last. The keyframe that was shown, if there was one."""
        offered, self._offered = self._offered, None
        if offered is not None:
            self._last_published.update(
                landmarks.state, offered.keyframe_id
            )  # not before: making its candidate might have failed
        slices = self._at_a_time(frame)
        if self._to_publish is not None:
            self._to_publish.frames_ago += 1
            if self._to_publish.is_ready:  # others have it, or nobody asked
                self._to_publish = None
                slices -= 1  # to show it was one
        self._processed_ns = frame.stamp_ns
        for _ in range(max(1, slices)):
            if not self._slices:
                break
            self._run_slice(landmarks, frame, rate)
        return offered

    def _at_a_time(self, frame: Frame) -> int:
        """How many slices there is time for after the frame just tracked."""
        return int(max(1, (frame.stamp_ns - self._processed_ns) // _SLICE_PERIOD_NS))

    def reset(self) -> None:
        """The filter begins anew, and numbers its keyframes anew. What is left to do is void."""
        self._offered = self._newest_pending = self._to_publish = None
        self._slices.clear()
        self._last_published.reset()

    # ------------------------------------------------------------------ slices

    def _run_slice(self, landmarks: LandmarkMap, last_frame: Frame, rate: F64) -> None:
        for step, pending in self._slices.popleft():
            step(pending, landmarks, last_frame, rate)

    def _reactivate(
        self, pending: _PendingKeyframe, landmarks: LandmarkMap, last_frame: Frame, rate: F64
    ) -> None:
        reactivated_px = landmarks.reactivate(last_frame, rate)
        pending.occupied_px = np.concatenate([pending.occupied_px, reactivated_px])
        landmarks.forget(
            (
                self._last_published.keyframe_id,
                -1 if self._to_publish is None else self._to_publish.keyframe_id,
            )
        )

    def _find_corners(
        self, pending: _PendingKeyframe, landmarks: LandmarkMap, last_frame: Frame, rate: F64
    ) -> None:
        pending.corners = landmarks.find_corners(pending.frame, pending.occupied_px)

    def _add_features(
        self, pending: _PendingKeyframe, landmarks: LandmarkMap, last_frame: Frame, rate: F64
    ) -> None:
        landmarks.admit_features(pending.frame, pending.keyframe_id, pending.corners)
        self._spacing.feature_count = len(landmarks.state.feature_ids)

    def _detect_view(
        self, pending: _PendingKeyframe, landmarks: LandmarkMap, last_frame: Frame, rate: F64
    ) -> None:
        if pending.view is not None:
            pending.view.detect()

    def _describe_view(
        self, pending: _PendingKeyframe, landmarks: LandmarkMap, last_frame: Frame, rate: F64
    ) -> None:
        if pending.view is not None:
            pending.view.describe()
            pending.is_ready = True

    def _describe_more(self, made: _PendingKeyframe, scene: LandmarkMap, last: Frame, rate: F64) -> None:
        self._describe_view(made, scene, last, rate)
        if made.view is not None:
            made.view.measure_half()
