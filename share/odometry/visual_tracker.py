"""Odometry by cameras alone, stereo or RGB-D; for rigs without IMU.

A frame: predict -> track points -> pose -> (keyframe: match points of earlier keyframes -> refine -> add
corners). What is published of a keyframe is made after its pose. Points keep the position that their first
keyframe gave them; matching points of earlier keyframes again, by their first patch, keeps drift low.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.array_table import ArrayTable
from share.config import TrackerConfig
from share.geometry import se3
from share.geometry.camera import ImuBias, Rig, rays
from share.odometry import initialisation, relocalisation
from share.odometry.keyframes import KeyframeSpacing
from share.odometry.relocalisation import (
    GATE_SIGMA,
    MIN_INLIERS,
    NOISE_PX,
    RANSAC_PX,
    LocalKeyframe,
    LocalMap,
    PoseEstimate,
    ransac_pose,
    refine_absolute_pose,
)
from share.odometry.track_result import TrackResult, finite_median
from share.types import (
    F32,
    F64,
    I64,
    U8,
    FeatureStatistics,
    Frame,
    OdometryKeyframe,
    TrackState,
    View,
    WaitReason,
)
from share.vision import corners, optical_flow
from share.vision.corners import UNIFORM_FIELD_DEG, field_mask
from share.vision.depth import measure_depth
from share.vision.keyframe_images import Surfaces

KEYFRAME_M, KEYFRAME_RAD = 0.15, 0.15  # motion since the last keyframe that triggers a new one
_UP_SIGMA_RAD = float(np.radians(3.0))  # of a keyframe's up, which is 0: not known
_SIGMA_RHO = 0.01  # 1/m, of a point's inverse depth
_MIN_TRACKED_SHARE = 0.6  # of the last keyframe's features; a smaller one triggers a new keyframe too
_SPACING_PX = 14.0  # least distance between corners
_WEAK_INLIERS = 40  # features that agree with a pose; fewer: WEAK
_MAX_SPEED_M_S, _MAX_TURN_RAD_S = 5.0, 12.0  # a pose that implies a faster motion is rejected
_REOBSERVED_KEYFRAMES = 6  # earlier keyframes whose points are searched for again
_REOBSERVE_M, _REOBSERVE_RAD = 1.0, 0.5  # their largest distance
_REOBSERVE_PX = 3.0  # largest distance between the predicted and the found position of such a point
MIN_NCC = 0.8  # of a patch matched in an earlier keyframe
MIN_POINTS_TO_MATCH = 8  # of an earlier keyframe; fewer are not worth an image pyramid


@dataclass(frozen=True, eq=False)
class _Tracks(ArrayTable):
    """Points of the local map seen in the last image: ids (N,), px (N, 2)."""

    ids: I64
    px: F32


_NO_TRACKS = _Tracks(np.zeros(0, np.int64), np.zeros((0, 2), np.float32))


class VisualTracker:
    """Feed frames in order to `track`. Deterministic: the same frames give the same poses."""

    def __init__(self, rig: Rig, config: TrackerConfig) -> None:
        """Raises ValueError for a rig without stereo and depth."""
        if rig.cam1 is None and rig.depth is None:
            raise ValueError("one camera alone gives no scale; stereo or depth is needed")
        self._rig, self._config = rig, config
        self._T_cam_body = se3.inverse(rig.T_body_cam0)
        self.local_map = LocalMap()
        self._tracks = _NO_TRACKS
        self._found_tracks = _NO_TRACKS  # in the last frame, outliers included
        self._tracked_count = 0  # tracked into the last frame
        self._image: U8 | None = None
        self._stamp_ns = 0
        self._T_odom_cam: F64 | None = None  # of the last accepted pose
        self._velocity = np.zeros(6)  # body twist of the camera, rad/s and m/s
        self._cov = np.zeros((6, 6))  # of the last pose against the local map, camera frame
        self._spacing = KeyframeSpacing(KEYFRAME_M, KEYFRAME_RAD, _MIN_TRACKED_SHARE)
        self._new_segment = True  # of the last keyframe
        self._T_last_published = np.eye(4)  # T_odom_body of the last published keyframe
        self._keyframe_pending = False  # the last frame is to become a keyframe of the local map
        self._offered: tuple[Frame, Surfaces] | None = None
        self._lost_since_ns: int | None = None
        self._round_robin = relocalisation.RoundRobin()

    def track(self, frame: Frame) -> TrackResult:
        """Return the causal pose of this frame. Frames must come with rising stamps."""
        self.finish_keyframe()
        if self._T_odom_cam is None:
            result = self._initialise(frame)
        elif self._lost_since_ns is not None:
            result = self._relocalise(frame)
        else:
            result = self._track_frame(frame, self._T_odom_cam)
        self._image, self._stamp_ns = frame.image0, frame.stamp_ns
        return result

    def make_keyframe(self, frame: Frame) -> OdometryKeyframe:
        """Return the frame just tracked as a keyframe to publish; call it where `track` says that one is
        ready.

        It is separate from `track` so that a headset has its pose before.
        """
        surfaces = self._surfaces()
        new_segment = self._new_segment and not self._keyframe_pending
        T_odom_body = self._T_odom_body()
        T_previous_body = T_odom_body if new_segment else se3.inverse(self._T_last_published) @ T_odom_body
        cov = se3.compose_cov(self._T_cam_body, self._cov, np.zeros((6, 6)))
        self._offered = frame, surfaces
        image = surfaces.with_image(frame.image0)
        up = np.zeros(3)
        return OdometryKeyframe(
            T_odom_body, T_previous_body, cov, up, _UP_SIGMA_RAD, View.empty(), new_segment, image
        )

    def _surfaces(self) -> Surfaces:
        """Return the surfaces at the points in the last frame, taken to face the camera."""
        assert self._T_odom_cam is not None
        points = self.local_map.points[self.local_map.row_indices(self._tracks.ids)]
        rho = 1 / se3.transform(se3.inverse(self._T_odom_cam), points)[:, 2]
        plane = np.column_stack([np.zeros((len(rho), 2)), rho])
        uv = self._rig.cam0.normalise(self._tracks.px.astype(np.float64))
        found = Surfaces(uv, plane, np.full(len(rho), _SIGMA_RHO))
        return found.take(found.is_valid())

    def finish_keyframe(self) -> None:
        """Add the last keyframe to the local map; see `InertialTracker.finish_keyframe`."""
        if self._offered is None:
            return
        (frame, surfaces), self._offered = self._offered, None
        self._T_last_published = self._T_odom_body()  # not before: making the keyframe might have failed
        if self._keyframe_pending:
            self._add_keyframe(frame)
        self.local_map.set_surfaces(surfaces.with_image(None))

    def reset_after_failure(self, frame: Frame) -> None:
        """Declare LOST: something failed in or after `frame`, the last."""
        self._declare_lost(frame)
        self._tracks, self._offered, self._keyframe_pending = _NO_TRACKS, None, False
        self._image, self._stamp_ns = frame.image0, frame.stamp_ns

    @property
    def rejected_imu_samples(self) -> int:
        """0: no IMU is used."""
        return 0

    @property
    def bias(self) -> ImuBias | None:
        """None: no IMU is used."""
        return None

    def feature_statistics(self) -> FeatureStatistics:
        """Return the statistics of the frame just tracked, which must have a pose."""
        assert self._T_odom_cam is not None
        tracks = self._all_found_tracks()
        rows = self.local_map.row_indices(tracks.ids)
        points = np.where(rows[:, None] >= 0, self.local_map.points[rows], np.nan)
        z = se3.transform(se3.inverse(self._T_odom_cam), points)[:, 2]
        is_inlier = np.arange(len(rows)) < len(self._tracks.ids)
        tracked_count, known_count = max(self._tracked_count, len(rows)), len(self.local_map.ids)
        return FeatureStatistics(tracks.px, is_inlier, z, tracked_count, known_count)

    def _all_found_tracks(self) -> _Tracks:
        """Return the tracks of the last frame: inliers, then outliers."""
        return self._tracks.concatenate(
            self._found_tracks.take(~np.isin(self._found_tracks.ids, self._tracks.ids))
        )

    def _median_nis(self, tracks: _Tracks) -> float:
        """Return `TrackResult.median_nis`."""
        assert self._T_odom_cam is not None
        expected = self._project(se3.inverse(self._T_odom_cam), self.local_map.row_indices(tracks.ids))
        return finite_median((((tracks.px - expected) / NOISE_PX) ** 2).sum(axis=1))

    def _track_frame(self, frame: Frame, T_last: F64) -> TrackResult:
        dt = (frame.stamp_ns - self._stamp_ns) * 1e-9
        # After a gap the last velocity does not hold.
        T_predicted = T_last if frame.gap_ns else T_last @ se3.exp(self._velocity * dt)
        tracks = self._follow_tracks(frame.image0, T_predicted)
        estimate, tracks = self._estimate_pose(tracks)
        if estimate is None or not self._is_plausible(T_last, estimate, dt):
            self._declare_lost(frame)
            return TrackResult(TrackState.LOST, None)
        T_odom_cam = se3.inverse(estimate.T)
        self._velocity = se3.log(se3.inverse(T_last) @ T_odom_cam) / dt
        self._tracks, self._T_odom_cam = tracks, T_odom_cam
        self._cov = se3.inverse_cov(estimate.T, estimate.cov)
        wants_keyframe = self._spacing.wants_keyframe(frame.stamp_ns, T_odom_cam, len(tracks.ids))
        if wants_keyframe:
            self._reobserve(frame)
            self._keyframe_pending = True
        count = len(self._tracks.ids)
        state = TrackState.OK if count >= _WEAK_INLIERS else TrackState.WEAK
        found = self._all_found_tracks()
        result = TrackResult(state, self._T_odom_body(), wants_keyframe, count)
        velocity, angular_velocity = self._body_velocity(T_odom_cam)
        return replace(
            result,
            found_count=len(found.ids),
            median_nis=self._median_nis(found),
            velocity=velocity,
            angular_velocity=angular_velocity,
        )

    def _body_velocity(self, T_odom_cam: F64) -> tuple[F64, F64]:
        """Return the body's velocity (3,) in odom, m/s, and angular velocity (3,) in the body, rad/s, as the
        mean since the last frame."""
        twist = se3.adjoint(self._rig.T_body_cam0) @ self._velocity
        return (T_odom_cam @ self._T_cam_body)[:3, :3] @ twist[3:], twist[:3]

    def _follow_tracks(self, image: U8, T_predicted: F64) -> _Tracks:
        assert self._image is not None
        rows = self.local_map.row_indices(self._tracks.ids)
        tracks = self._tracks.take(rows >= 0)
        expected = self._project(se3.inverse(T_predicted), rows[rows >= 0])
        guess = np.where(np.isnan(expected), tracks.px, expected).astype(np.float32)
        px, found = optical_flow.track_points(self._image, image, tracks.px, guess, levels=2)
        found &= self._rig.cam0.has_normalised(px.astype(np.float64))
        self._found_tracks, self._tracked_count = _Tracks(tracks.ids, px).take(found), len(tracks.ids)
        return self._found_tracks

    def _project(self, T_cam_odom: F64, rows: I64) -> F64:
        """Return predicted px (N, 2) of points of the map, NaN behind the camera."""
        return self._rig.cam0.project(se3.transform(T_cam_odom, self.local_map.points[rows]))

    def _estimate_pose(self, tracks: _Tracks) -> tuple[PoseEstimate | None, _Tracks]:
        """Return the pose T_cam_odom, None without enough inliers, and the inlier tracks."""
        focal = self._rig.cam0.focal
        points = self.local_map.points[self.local_map.row_indices(tracks.ids)]
        uv = self._rig.cam0.normalise(tracks.px.astype(np.float64))
        initial = ransac_pose(points, uv, focal, RANSAC_PX)
        if initial is None or initial.inliers.sum() < MIN_INLIERS:
            return None, _NO_TRACKS
        sigma = np.full(len(points), NOISE_PX)
        best = refine_absolute_pose(initial.T, points, uv, focal, sigma, GATE_SIGMA)
        if best.inliers.sum() < MIN_INLIERS:
            return None, _NO_TRACKS
        return best, tracks.take(best.inliers)

    def _is_plausible(self, T_last: F64, estimate: PoseEstimate, dt: float) -> bool:
        """Return whether the pose is finite, and the motion no faster than a person or robot."""
        if dt <= 0 or not np.isfinite(estimate.T).all():
            return False
        motion = se3.log(se3.inverse(T_last) @ se3.inverse(estimate.T)) / dt
        slow = np.linalg.norm(motion[3:]) < _MAX_SPEED_M_S
        return bool(slow and np.linalg.norm(motion[:3]) < _MAX_TURN_RAD_S)

    def _add_keyframe(self, frame: Frame, new_segment: bool = False) -> None:
        """Add this frame to the local map as a keyframe, with points at free corners."""
        assert self._T_odom_cam is not None
        anchor = self.local_map.add_keyframe(frame.image0, self._T_odom_cam)
        self._add_corners(frame, anchor)
        spacing = self._spacing
        spacing.stamp_ns = frame.stamp_ns
        spacing.T = self._T_odom_cam
        spacing.feature_count = len(self._tracks.ids)
        self._new_segment, self._keyframe_pending = new_segment, False

    def _reobserve(self, frame: Frame) -> None:
        """Match points of earlier keyframes near their prediction, and refine the pose.

        Matches further away would correct all drift since then in one frame: a jump that a headset shows and
        that the edge's map takes for motion. The edge closes loops.
        """
        assert self._T_odom_cam is not None
        T_cam_odom = se3.inverse(self._T_odom_cam)
        anchors = self.local_map.keyframes_near(self._T_odom_cam, _REOBSERVE_M, _REOBSERVE_RAD)
        found = _NO_TRACKS
        for anchor in anchors[:_REOBSERVED_KEYFRAMES]:
            rows, guess = self.local_map.visible_points(T_cam_odom, self._rig.cam0, [anchor])
            fresh = ~np.isin(self.local_map.ids[rows], self._tracks.ids)
            if fresh.sum() >= MIN_POINTS_TO_MATCH:
                found = found.concatenate(
                    self._match_patches(frame.image0, anchor, rows[fresh], guess[fresh])
                )
        expected = self._project(T_cam_odom, self.local_map.row_indices(found.ids))
        found = found.take(np.linalg.norm(found.px - expected, axis=1) < _REOBSERVE_PX)
        estimate, tracks = self._estimate_pose(self._tracks.concatenate(found))
        if estimate is not None:
            self._T_odom_cam, self._tracks = se3.inverse(estimate.T), tracks

    def _match_patches(self, image: U8, anchor: int, rows: I64, guess: F32) -> _Tracks:
        source = self.local_map.keyframes[anchor].image
        anchor_px = self.local_map.anchor_px[rows]
        px, found = optical_flow.track_points(
            source, image, anchor_px, guess, window=15, levels=1, back_check_px=None
        )
        found &= optical_flow.ncc(source, image, anchor_px, px) > MIN_NCC
        found &= self._rig.cam0.has_normalised(px.astype(np.float64))
        return _Tracks(self.local_map.ids[rows], px).take(found)

    def _add_corners(self, frame: Frame, anchor: int) -> None:
        assert self._T_odom_cam is not None
        max_count = self._config.corners - len(self._tracks.ids)
        mask = field_mask(self._rig.cam0, UNIFORM_FIELD_DEG)
        px = corners.strongest(frame.image0, self._tracks.px, max_count, _SPACING_PX, mask=mask)
        uv = self._rig.cam0.normalise(px.astype(np.float64))
        z = measure_depth(frame, self._rig, px, uv)
        known = ~np.isnan(z)
        points = se3.transform(self._T_odom_cam, rays(uv[known]) * z[known, None])
        ids = self.local_map.add_points(anchor, points, px[known])
        self._tracks = self._tracks.concatenate(_Tracks(ids, px[known]))

    def _initialise(self, frame: Frame) -> TrackResult:
        """Make the first keyframe, which defines odom: body at the origin, the top of the image up."""
        up = self._rig.T_body_cam0[:3, :3] @ np.array([0.0, -1.0, 0.0])
        forward = self._rig.T_body_cam0[:3, 2]
        self._T_odom_cam = initialisation.align_to_gravity(up, forward) @ self._rig.T_body_cam0
        self._add_keyframe(frame, new_segment=True)
        if len(self._tracks.ids) < MIN_INLIERS:
            self._T_odom_cam, self._tracks = None, _NO_TRACKS
            self.local_map = LocalMap()
            return TrackResult(TrackState.INITIALISING, None, waiting_for=WaitReason.VIEW)
        return TrackResult(TrackState.OK, self._T_odom_body(), True, len(self._tracks.ids), True)

    def _declare_lost(self, frame: Frame) -> None:
        self._lost_since_ns, self._velocity = frame.stamp_ns, np.zeros(6)
        self._round_robin.reset()

    def _relocalise(self, frame: Frame) -> TrackResult:
        """Relocalise in the local map; after NEW_SEGMENT_S, begin a new segment at the last pose."""
        assert self._lost_since_ns is not None
        keyframes = self._next_keyframes()
        T_found = relocalisation.relocalise(keyframes, frame, self._rig)
        waited_s = (frame.stamp_ns - self._lost_since_ns) * 1e-9
        if T_found is not None:
            self._T_odom_cam, self._tracks = T_found, _NO_TRACKS
            self._reobserve(frame)
        elif waited_s < relocalisation.NEW_SEGMENT_S:
            return TrackResult(TrackState.LOST, None)
        old_map = self.local_map
        if T_found is None:
            self.local_map, self._tracks = LocalMap(), _NO_TRACKS
        self._add_keyframe(frame, new_segment=T_found is None)
        if len(self._tracks.ids) < MIN_INLIERS:
            self.local_map = old_map  # no features here either: keep the map for relocalisation
            return TrackResult(TrackState.LOST, None)
        self._lost_since_ns = None
        return TrackResult(TrackState.WEAK, self._T_odom_body(), True, len(self._tracks.ids), T_found is None)

    def _next_keyframes(self) -> list[LocalKeyframe]:
        """Return the next batch of the local map's keyframes, nearest to the last pose first."""
        assert self._T_odom_cam is not None
        nearest = self.local_map.keyframes_near(self._T_odom_cam, np.inf, np.inf)
        return [self.local_map.keyframes[n] for n in self._round_robin.next_batch(nearest)]

    def _T_odom_body(self) -> F64:
        assert self._T_odom_cam is not None
        return se3.orthonormal(self._T_odom_cam @ self._T_cam_body)
