"""Odometry by cameras and IMU.

A frame: propagate by the IMU -> predict the features -> match their patches -> gate -> update. The work of
keyframes (`keyframes`) is done after the pose is published. Without IMU samples the body is taken to keep its
velocity; without features the IMU carries the pose for a while.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from share.config import InertialConfig, TrackerConfig
from share.geometry import se3
from share.geometry.camera import ImuBias, Rig
from share.odometry import feature_matching, filter, relocalisation
from share.odometry.feature_appearance import Appearance
from share.odometry.health import DivergenceMonitor, ImageImuConsistency, is_plausible
from share.odometry.imu_buffer import mean_angular_rate
from share.odometry.imu_predictor import ImuPredictor
from share.odometry.initialisation import (
    estimated_bias,
    has_converged,
    is_publishable,
    state_from_camera,
    state_from_imu,
    unknown_bias,
    waiting_for,
)
from share.odometry.keyframes import KeyframeScheduler
from share.odometry.landmarks import LandmarkMap
from share.odometry.mono_initialisation import MonoWindow, start_mono_window
from share.odometry.relocalisation import LocalMap
from share.odometry.state import FilterState
from share.odometry.tilt_realignment import TiltRealignment
from share.odometry.track_result import TrackResult, finite_median
from share.odometry.visual_update import VisualUpdate
from share.types import F64, FeatureStatistics, Frame, ImuBatch, KeyframeCandidate, TrackState, WaitReason
from share.vision import corners
from share.vision.orb import measures_depth

_LONG_GAP_NS = 250_000_000  # between frames; integration over more is worse than the IMU's noise model says
_MAX_IMU_WAIT_FRAMES = 10  # without an IMU sample, after which the tracker begins without IMU
_MAX_UP_SIGMA_RAD = np.radians(3.0)  # tilt sigma up to which the up direction is published


class InertialTracker:
    """Feed frames in order to `track`. Deterministic: the same frames give the same poses."""

    def __init__(
        self,
        rig: Rig,
        config: InertialConfig,
        tracker_config: TrackerConfig,
        seed: int = 0,
        bias: ImuBias | None = None,
    ) -> None:
        """bias: of the IMU, as estimated by an earlier run. Raises ValueError without an IMU."""
        if rig.imu is None:
            raise ValueError("the rig has no IMU; use VisualTracker")
        self._rig, self._config = rig, config
        self._bias = unknown_bias(config) if bias is None else bias
        self._imu = ImuPredictor(rig.imu, config)
        self._visual_update = VisualUpdate(rig.cam0, config)
        self._landmarks: LandmarkMap | None = None
        self._mono_window: MonoWindow | None = None  # of a single camera, until the scale is known
        self._last_frame: Frame | None = None
        self._stamp_ns = 0
        self._is_finished = True  # `finish_keyframe` was called after the last frame
        self._divergence = DivergenceMonitor(config.weak, config.blind)
        self._consistency = ImageImuConsistency()
        self._imu_wait_frames = 0  # without an IMU sample
        self._start_ns, self._start_position = 0, np.zeros(3)
        self._has_published = False
        self._knows_up = False  # the state began with IMU samples
        self._new_segment = False  # the next keyframe begins a segment
        self._keyframes = KeyframeScheduler(rig, config, tracker_config.view_features)
        self._realignment = TiltRealignment()
        self._local_map = LocalMap(tracker_config.max_keyframes)  # for relocalisation
        self._tracker_config, self._seed = tracker_config, seed
        self._round_robin = relocalisation.RoundRobin(tracker_config.relocalise_hosts)
        self._lost_ns: int | None = None

    @property
    def state(self) -> FilterState | None:
        """The filter's state; None before the start and while LOST."""
        return self._landmarks.state if self._landmarks else None

    @property
    def bias(self) -> ImuBias | None:
        """The estimated IMU bias; None where it is not worth storing."""
        if self._landmarks is None or not (
            self._has_published and self._knows_up and self._consistency.is_consistent
        ):
            return None
        return estimated_bias(self._landmarks.state, self._config)

    @property
    def appearance(self) -> Appearance | None:
        """The appearance of the state's features."""
        return self._landmarks.appearance if self._landmarks else None

    def track(self, frame: Frame) -> TrackResult:
        """Return the causal pose of this frame. Frames must come with rising stamps."""
        self.finish_keyframe()
        self._imu.buffer.add(frame.imu)
        result = (
            self._initialise(frame) if self._landmarks is None else self._track_frame(frame, self._landmarks)
        )
        self._last_frame, self._stamp_ns, self._is_finished = frame, frame.stamp_ns, False
        return result

    def make_keyframe(self, frame: Frame) -> KeyframeCandidate:
        """Return the keyframe to publish; call it where `track` says that one is ready.

        It is this frame's, or that of a frame shortly before, whose view is complete by now.
        """
        assert self._landmarks is not None
        new_segment, self._new_segment = self._new_segment, False
        published = self._keyframes.publish(self._landmarks, new_segment)
        knows_up = self._knows_up and published.tilt_sigma < _MAX_UP_SIGMA_RAD
        return KeyframeCandidate(
            self._realignment.published_pose(published.T_odom_body),
            published.T_previous_body,
            published.cov,
            published.T_odom_body[2, :3] if knows_up else np.zeros(3),
            published.tilt_sigma / np.sqrt(2),
            published.view,
            new_segment,
            published.frames_ago,
        )

    def finish_keyframe(self) -> None:
        """Run a slice of the pending keyframe work: view, new features, the local map.

        Call it when the pose, and the candidate if there is one, are sent; otherwise the next `track` calls
        it first.
        """
        if self._landmarks is None or self._last_frame is None or self._is_finished:
            return
        self._is_finished = True
        s = self._landmarks.state
        offered = self._keyframes.process_pending(self._landmarks, self._last_frame, self._imu.rate)
        if offered is not None and not self._divergence.is_suspected:
            T_odom_body = s.keyframe_poses[filter.keyframe_index(s, offered.keyframe_id)]
            self._local_map.add_keyframe(offered.frame.image0, T_odom_body @ s.T_body_cam)
            self._local_map.set_view(offered.view)

    def feature_statistics(self) -> FeatureStatistics:
        """Return the statistics of the frame of the keyframe that is ready; without one, of the frame just
        tracked, which must have a pose."""
        assert self._landmarks is not None
        return self._keyframes.statistics or self._landmarks.feature_statistics()

    def reset_after_failure(self, frame: Frame) -> None:
        """Start again: something failed in or after `frame`, the last, and the state may be corrupt."""
        self._mono_window = None
        self._declare_lost(frame)
        self._last_frame, self._stamp_ns = frame, frame.stamp_ns

    @property
    def rejected_imu_samples(self) -> int:
        """The number of IMU samples rejected."""
        return self._imu.buffer.rejected_count

    def predict(self, t_ns: int, imu: ImuBatch | None = None) -> F64 | None:
        """Return T_odom_body (4, 4) at a time after the last frame's, IMU time, for renderers between frames;
        None without a pose.

        imu: samples since that frame. After the last one the body is taken to turn and accelerate as it did
        then.
        """
        if self._landmarks is None or not self._has_published:
            return None
        T_odom_body = self._imu.pose_at(self._landmarks.state, t_ns, imu or ImuBatch.empty())
        return self._realignment.published_pose(T_odom_body)

    def _track_frame(self, frame: Frame, landmarks: LandmarkMap) -> TrackResult:
        T_before = landmarks.state.T
        interval_s = (frame.stamp_ns - self._stamp_ns) * 1e-9
        image_ns = frame.stamp_ns + round(landmarks.state.timeshift_s * 1e9)  # IMU time
        imu = self._imu.predict(landmarks.state, image_ns, gyro_only=self._mono_window is not None)
        landmarks.begin_frame(interval_s)
        matches = self._match_features(frame, landmarks)
        is_after_gap = frame.stamp_ns - self._stamp_ns > _LONG_GAP_NS
        is_suspect = self._imu.buffer.is_suspect(landmarks.state.stamp_ns)
        inliers, nis = self._visual_update.apply(landmarks, matches, self._imu.rate, is_after_gap, is_suspect)
        has_imu = imu.has_samples and not (imu.has_rejected and self._has_published)
        if imu.has_gyro and self._mono_window is None:
            self._consistency.add(nis, interval_s)
        landmarks.record_frame(matches, inliers)
        if not imu.has_gyro:
            self._imu.rate = mean_angular_rate(T_before, landmarks.state.T, frame.stamp_ns - self._stamp_ns)
        count = int(inliers.sum())
        textured = count >= self._config.blind or corners.count_fast(frame.image0) >= self._config.weak
        self._divergence.add(
            textured, matches.in_view_count(self._rig.cam0), int(matches.is_found.sum()), count, interval_s
        )
        state = self._track_state(landmarks.state, count, has_imu)
        if not is_plausible(landmarks.state, self._config) or self._divergence.has_diverged:
            return self._declare_lost(frame)
        if state is TrackState.LOST:
            return TrackResult(state, None)
        wants_keyframe = textured and self._keyframes.wants_keyframe(frame.stamp_ns, landmarks.state.T, count)
        if state is TrackState.INITIALISING:
            if wants_keyframe:
                self._keyframes.add_at_once(frame, landmarks, self._imu.rate)
            if not self._solve_scale(frame, landmarks, wants_keyframe):
                return self._waiting_result(landmarks.state)
            state, wants_keyframe = TrackState.OK, True
        result = self._publish(frame, landmarks, state, wants_keyframe, count)
        return replace(
            result, found_count=int((matches.is_found | inliers).sum()), median_nis=finite_median(nis)
        )

    def _solve_scale(self, frame: Frame, landmarks: LandmarkMap, is_keyframe: bool) -> bool:
        """Return whether a single camera's window gives the scale, and the state has converged."""
        window, s = self._mono_window, landmarks.state
        if window is None or not (is_keyframe or window.wants_frame(s.stamp_ns)):
            return False
        imu = self._imu.samples(window.last_ns, s.stamp_ns)
        if imu is None or window.is_full or measures_depth(frame, self._rig):
            self._landmarks = self._mono_window = None  # start again
            return False
        return window.try_solve(landmarks, imu, is_keyframe) and has_converged(s)

    def _publish(
        self, frame: Frame, landmarks: LandmarkMap, state: TrackState, wants_keyframe: bool, count: int
    ) -> TrackResult:
        s = landmarks.state
        is_first, self._has_published, self._mono_window = not self._has_published, True, None
        new_segment = is_first and self._new_segment
        if is_first:
            self._realignment.start(s, self._start_position, new_segment)
        else:
            self._realignment.update(s)
        pose, cov = self._published_pose(s), filter.pose_cov(s)
        if wants_keyframe or is_first:
            publish = not is_first and self._keyframes.may_publish(frame.stamp_ns)
            self._keyframes.add(frame, landmarks, self._imu.rate, count < self._config.weak, publish)
            if is_first:
                self._keyframes.publish_at_once(landmarks)
        is_ready = self._keyframes.is_ready
        return TrackResult(state, pose, is_ready, count, new_segment, cov, self._consistency.is_consistent)

    def _match_features(self, frame: Frame, landmarks: LandmarkMap) -> feature_matching.FeatureMatches:
        """Return the matches of the features, with dynamic ones marked."""
        matches = feature_matching.match_features(
            frame, self._rig, landmarks.state, landmarks.appearance, self._config
        )
        if self._last_frame is not None:
            feature_matching.match_by_flow(
                self._last_frame.image0,
                frame.image0,
                self._rig.cam0,
                landmarks.appearance,
                matches,
                self._config,
            )
        landmarks.mark_dynamic(matches, self._imu.rate)
        return matches

    def _track_state(self, s: FilterState, count: int, has_imu: bool) -> TrackState:
        config = self._config
        if self._mono_window is not None or (
            has_imu and not self._has_published and not self._is_publishable(s)
        ):
            return TrackState.INITIALISING
        if count < config.blind:
            return TrackState.INERTIAL_ONLY if has_imu else TrackState.LOST
        if not has_imu:
            return TrackState.VISION_ONLY
        return TrackState.OK if count >= config.weak else TrackState.WEAK

    def _is_publishable(self, s: FilterState) -> bool:
        """Return whether a first pose can be published. The velocity must not rest on dynamic features
        alone."""
        waited_s = (s.stamp_ns - self._start_ns) * 1e-9
        return self._is_static() and is_publishable(s, waited_s, self._new_segment)

    def _is_static(self) -> bool:
        return self._landmarks is None or self._landmarks.is_static(self._config.weak // 2)

    def _waiting_result(self, s: FilterState) -> TrackResult:
        reason = (
            WaitReason.SCALE
            if self._mono_window is not None
            else waiting_for(s)
            if self._is_static()
            else WaitReason.VIEW
        )
        return TrackResult(TrackState.INITIALISING, None, waiting_for=reason)

    def _published_pose(self, s: FilterState) -> F64:
        """Return the pose at the frame's stamp, IMU time; the state is at the time of the image."""
        if s.timeshift_s == 0:
            return self._realignment.published_pose(s.T)
        T_odom_body = se3.exp(-filter.twist(s, self._imu.rate) * s.timeshift_s) @ s.T
        return self._realignment.published_pose(T_odom_body)

    def _initialise(self, frame: Frame) -> TrackResult:
        """Start at odom's origin, z up. After a loss, at the relocalised pose; after `new_stretch_s`, in a
        new segment."""
        T_found = self._relocalise(frame)
        waiting_state = TrackState.INITIALISING if self._lost_ns is None else TrackState.LOST
        lost_ns = 0 if self._lost_ns is None else frame.stamp_ns - self._lost_ns
        if T_found is None and 0 < lost_ns < self._tracker_config.new_stretch_s * 1e9:
            return TrackResult(waiting_state, None)
        state = state_from_imu(frame.stamp_ns, self._imu.buffer.samples, self._rig, self._config, self._bias)
        self._imu_wait_frames += state is None
        self._knows_up = state is not None
        if state is None and self._imu_wait_frames >= _MAX_IMU_WAIT_FRAMES:
            state = state_from_camera(frame.stamp_ns, self._rig, self._config, self._bias)
        if state is None:
            return TrackResult(waiting_state, None, waiting_for=WaitReason.IMU)
        if T_found is not None:
            state.T = T_found @ se3.inverse(self._rig.T_body_cam0)
        landmarks = LandmarkMap(state, self._rig, self._config)
        self._imu.restart(state)
        self._keyframes.add_at_once(frame, landmarks, self._imu.rate)
        if len(state.feature_ids) < self._config.weak:
            return TrackResult(waiting_state, None, waiting_for=WaitReason.VIEW)
        self._landmarks, self._has_published = landmarks, False
        self._start_ns, self._start_position = state.stamp_ns, state.T[:3, 3].copy()  # by the IMU's clock
        self._mono_window = start_mono_window(
            state, self._rig.cam0, self._imu.noise, self._config, self._visual_update.common_cov
        )
        self._new_segment = T_found is None
        if T_found is None:
            self._local_map = LocalMap(self._tracker_config.max_keyframes)
        self._lost_ns = None
        if self._mono_window is not None or not self._is_publishable(state):
            return self._waiting_result(state)
        return self._publish(frame, landmarks, TrackState.OK, True, len(state.feature_ids))

    def _declare_lost(self, frame: Frame) -> TrackResult:
        """Discard the filter."""
        self._landmarks, self._divergence = None, DivergenceMonitor(self._config.weak, self._config.blind)
        self._keyframes.reset()
        if self._mono_window is not None:  # no pose was published yet
            return TrackResult(TrackState.INITIALISING, None, waiting_for=WaitReason.SCALE)
        self._has_published, self._lost_ns = False, frame.stamp_ns
        return TrackResult(TrackState.LOST, None)

    def _relocalise(self, frame: Frame) -> F64 | None:
        """Return T_odom_cam (4, 4) of a LOST frame by its ORB features; None if it is not found."""
        if self._lost_ns is None or not self._local_map.keyframes:
            return None
        batch = self._round_robin.next_batch(sorted(self._local_map.keyframes, reverse=True))
        keyframes = [self._local_map.keyframes[n] for n in batch]
        return relocalisation.relocalise(keyframes, frame, self._rig, self._tracker_config, self._seed)
