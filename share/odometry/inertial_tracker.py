"""Odometry by cameras and IMU.

A frame: propagate by the IMU -> predict the features -> match their patches -> gate -> update. The work of
keyframes (`keyframes`) is done after the pose is published. Without IMU samples the body is taken to keep its
velocity; without features the IMU carries the pose for a while.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import ImuBias, Rig
from share.odometry import filter, initialisation, relocalisation, visual_update
from share.odometry.feature_appearance import Appearance
from share.odometry.feature_matching import FeatureMatches
from share.odometry.health import (
    MIN_OK_FEATURES,
    MIN_POSE_FEATURES,
    DivergenceMonitor,
    ImageImuConsistency,
    is_plausible,
    pose_state,
)
from share.odometry.imu_predictor import ImuPredictor, ImuStatus, mean_angular_rate
from share.odometry.keyframes import KeyframeWork
from share.odometry.landmarks import LandmarkMap
from share.odometry.levelling import level
from share.odometry.mono_initialisation import MonoWindow, start_mono_window
from share.odometry.relocalisation import LocalMap
from share.odometry.rest_detection import RestDetector
from share.odometry.state import FilterState, move, pose_at_stamp
from share.odometry.tilt_realignment import TiltRealignment
from share.odometry.track_result import TrackResult, finite_median
from share.types import (
    F64,
    FeatureStatistics,
    Frame,
    ImuBatch,
    OdometryKeyframe,
    TrackState,
    View,
    WaitReason,
)
from share.vision import corners
from share.vision.depth import measures_depth

_LONG_GAP_NS = 250_000_000  # between frames; integration over more is worse than the IMU's noise model says
_MAX_IMU_WAIT_FRAMES = 10  # without an IMU sample, after which the tracker begins without IMU
_MIN_PROVEN = MIN_OK_FEATURES // 2  # proven static features, without which no first pose is published
_ZERO_VELOCITY_SIGMA = 0.02  # m/s, at rest
_MAX_UP_SIGMA_RAD = np.radians(3.0)  # tilt sigma up to which the up direction is published


class InertialTracker:
    """Feed frames in order to `track`. Deterministic: the same frames give the same poses."""

    def __init__(self, rig: Rig, config: InertialConfig, bias: ImuBias | None = None) -> None:
        """bias: of the IMU, as estimated by an earlier run. Raises ValueError without an IMU."""
        if rig.imu is None:
            raise ValueError("the rig has no IMU; use VisualTracker")
        self._rig, self._config = rig, config
        self._bias = initialisation.unknown_bias(config) if bias is None else bias
        self._has_bias, self.has_dropped_bias = bias is not None, False  # dropped: contradicted at rest
        self._imu = ImuPredictor(rig.imu, config)
        self._rest = RestDetector()
        self._landmarks: LandmarkMap | None = None
        self._mono_window: MonoWindow | None = None  # of a single camera, until the scale is known
        self._last_frame: Frame | None = None
        self._is_finished = True  # `finish_keyframe` was called after the last frame
        self._divergence = DivergenceMonitor()
        self._consistency = ImageImuConsistency()
        self._imu_wait_frames = 0  # without an IMU sample
        self._start_ns, self._has_published = 0, False
        self._knows_up = False  # the state began with IMU samples, or was levelled by some
        self._odom_is_level = False  # so was some state of this segment
        self._new_segment = False  # the next keyframe begins a segment
        self._keyframes = KeyframeWork(config)
        self._realignment = TiltRealignment()
        self._start_cov: F64 | None = None  # of the pose in odom where the filter began; None: exact
        self._local_map = LocalMap()  # for relocalisation
        self._round_robin = relocalisation.RoundRobin()
        self._lost_ns: int | None = None

    @property
    def state(self) -> FilterState | None:
        """The filter's state; None before the start and once it was discarded as LOST."""
        return self._landmarks.state if self._landmarks else None

    @property
    def bias(self) -> ImuBias | None:
        """The estimated IMU bias; None where it is not worth storing."""
        if self._landmarks is None or not (
            self._has_published and self._knows_up and self._consistency.is_consistent
        ):
            return None
        return initialisation.estimated_bias(self._landmarks.state, self._config)

    @property
    def appearance(self) -> Appearance | None:
        """The appearance of the state's features."""
        return self._landmarks.appearance if self._landmarks else None

    def track(self, frame: Frame) -> TrackResult:
        """Return the causal pose of this frame. Frames must come with rising stamps."""
        self.finish_keyframe()
        self._imu.buffer.add(frame.imu)
        if self._landmarks is None or self._last_frame is None:
            result = self._begin_state(frame)
        else:
            result = self._track_frame(frame, self._last_frame, self._landmarks)
        self._last_frame, self._is_finished = frame, False
        return result

    def make_keyframe(self, frame: Frame) -> OdometryKeyframe:
        """Return the frame just tracked as a keyframe to publish; call it where `track` says that one is
        ready."""
        assert self._landmarks is not None
        new_segment, self._new_segment = self._new_segment, False
        published = self._keyframes.publish(self._landmarks, new_segment)
        knows_up = self._knows_up and published.tilt_sigma < _MAX_UP_SIGMA_RAD
        return OdometryKeyframe(
            self._realignment.published_pose(published.T_odom_body),
            published.T_previous_body,
            published.cov,
            published.T_odom_body[2, :3] if knows_up else np.zeros(3),
            published.tilt_sigma / np.sqrt(2),  # of both angles -> of each
            View.empty(),
            new_segment,
            published.surfaces.with_image(frame.image0),
            published.earlier,
        )

    def finish_keyframe(self) -> None:
        """Run a slice of the pending keyframe work: new features, the local map.

        Call it when the pose, and the keyframe if one is ready, are sent; otherwise the next `track` calls it
        first.
        """
        if self._landmarks is None or self._last_frame is None or self._is_finished:
            return
        self._is_finished = True
        s = self._landmarks.state
        offered = self._keyframes.process_pending(self._landmarks, self._last_frame, self._imu.rate)
        if offered is not None and not self._divergence.is_suspected:
            T_odom_body = s.keyframe_poses[filter.keyframe_index(s, offered.keyframe_id)]
            self._local_map.add_keyframe(offered.frame.image0, T_odom_body @ s.T_body_cam)
            self._local_map.set_surfaces(offered.surfaces.with_image(None))

    def feature_statistics(self) -> FeatureStatistics:
        """Return the statistics of the frame just tracked, which must have a pose."""
        assert self._landmarks is not None
        return self._landmarks.feature_statistics()

    def reset_after_failure(self, frame: Frame) -> None:
        """Start again: something failed in or after `frame`, the last, and the state may be corrupt."""
        self._mono_window = None
        self._declare_lost(frame)
        self._last_frame = frame

    @property
    def rejected_imu_samples(self) -> int:
        """The number of IMU samples rejected."""
        return self._imu.buffer.outliers.rejected_count

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

    # A frame without a state: at the beginning, and after a loss

    def _begin_state(self, frame: Frame) -> TrackResult:
        """Try to begin the filter with this frame.

        The first state is at odom's origin, z up. After a loss it is at the pose found by relocalisation;
        only after NEW_SEGMENT_S without one it is at the origin again, in a new segment.
        """
        T_odom_cam = self._relocalise(frame)
        if T_odom_cam is None and self._awaits_relocalisation(frame.stamp_ns):
            return TrackResult(TrackState.LOST, None)
        waiting_state = TrackState.INITIALISING if self._lost_ns is None else TrackState.LOST
        state = self._first_state(frame.stamp_ns, T_odom_cam is not None)
        if state is None:
            return TrackResult(waiting_state, None, waiting_for=WaitReason.IMU)
        if T_odom_cam is not None:
            move(state, T_odom_cam @ se3.inverse(self._rig.T_body_cam0))
        landmarks = LandmarkMap(state, self._rig, self._config)
        self._imu.restart(state)
        self._keyframes.add_and_finish(frame, landmarks, self._imu.rate)
        if len(state.feature_ids) < MIN_OK_FEATURES:
            return TrackResult(waiting_state, None, waiting_for=WaitReason.VIEW)
        self._adopt_state(landmarks, new_segment=T_odom_cam is None)
        count = len(state.feature_ids)
        if self._mono_window is not None or not self._is_publishable(state, count):
            return self._waiting_result(state, count)
        return self._publish(frame, landmarks, TrackState.OK, True, count)

    def _relocalise(self, frame: Frame) -> F64 | None:
        """Return T_odom_cam (4, 4) of a LOST frame by its ORB features; None if it is not found."""
        if self._lost_ns is None or not self._local_map.keyframes:
            return None
        batch = self._round_robin.next_batch(sorted(self._local_map.keyframes, reverse=True))
        keyframes = [self._local_map.keyframes[n] for n in batch]
        return relocalisation.relocalise(keyframes, frame, self._rig)

    def _awaits_relocalisation(self, stamp_ns: int) -> bool:
        """Return whether the loss is so recent that no new segment begins yet."""
        if self._lost_ns is None:
            return False
        return 0 < stamp_ns - self._lost_ns < relocalisation.NEW_SEGMENT_S * 1e9

    def _first_state(self, stamp_ns: int, is_found: bool) -> FilterState | None:
        """Return a state at odom's origin, z up: by the IMU, or after frames without a sample by the camera
        alone; None while samples may still come. is_found: relocalised, so the map tells what is up."""
        samples = self._imu.buffer.samples
        if self._has_bias and initialisation.rest_contradicts(self._bias, samples, self._config):
            self._bias, self._has_bias = initialisation.unknown_bias(self._config), False
            self.has_dropped_bias = True
        state = initialisation.state_from_imu(stamp_ns, samples, self._rig, self._config, self._bias)
        self._knows_up = state is not None
        if state is not None:
            return state
        self._imu_wait_frames += 1
        is_silent = is_found and self._imu.has_fallen_silent(stamp_ns + self._rig.timeshift_ns)
        if self._imu_wait_frames < _MAX_IMU_WAIT_FRAMES and not is_silent:
            return None
        return initialisation.state_from_camera(stamp_ns, self._rig, self._bias)

    def _adopt_state(self, landmarks: LandmarkMap, new_segment: bool) -> None:
        """Track from this state on. Its pose is published once it has converged."""
        s = landmarks.state
        self._landmarks, self._has_published, self._lost_ns = landmarks, False, None
        self._start_ns = s.stamp_ns  # by the IMU's clock
        self._start_cov = None if new_segment else relocalisation.POSE_COV
        self._mono_window = start_mono_window(s, self._rig.cam0, self._imu.noise, self._config)
        self._rest = RestDetector()
        self._new_segment = new_segment
        if new_segment:
            self._local_map, self._odom_is_level = LocalMap(), self._knows_up
        self._knows_up = self._knows_up and self._odom_is_level

    # A frame with a state

    def _track_frame(self, frame: Frame, last_frame: Frame, landmarks: LandmarkMap) -> TrackResult:
        s, T_before, interval_ns = landmarks.state, landmarks.state.T, frame.stamp_ns - last_frame.stamp_ns
        if not self._odom_is_level and self._mono_window is None:
            self._level(s)
        imu = self._predict(frame, s)
        matches = landmarks.match_features(frame, last_frame.image0, interval_ns * 1e-9)
        visual_update.mark_dynamic(landmarks, matches, self._rig.cam0, self._imu.rate)
        if self._rest.is_at_rest(s, matches.uv, matches.is_found & ~matches.is_dynamic, imu.is_still):
            filter.zero_velocity_update(s, _ZERO_VELOCITY_SIGMA)
        inliers, nis = self._update(landmarks, matches, interval_ns)
        count = int(inliers.sum())
        if not imu.has_gyro:
            self._imu.rate = mean_angular_rate(T_before, s.T, interval_ns)
        elif self._mono_window is None:
            self._consistency.add(nis, interval_ns * 1e-9)
        is_textured = count >= MIN_POSE_FEATURES or corners.count_fast(frame.image0) >= MIN_OK_FEATURES
        if not self._check_health(s, matches, count, is_textured, interval_ns):
            return self._declare_lost(frame)
        state = self._track_state(s, count, imu)
        if state is TrackState.LOST:  # neither features nor IMU: the filter goes on
            return TrackResult(state, None)
        wants_keyframe = is_textured and self._keyframes.wants_keyframe(frame.stamp_ns, s.T, count)
        if state is TrackState.INITIALISING:
            if not self._advance_mono_window(frame, landmarks, wants_keyframe):
                return self._waiting_result(s, count)
            state, wants_keyframe = TrackState.OK, True
        result = self._publish(frame, landmarks, state, wants_keyframe, count)
        found_count = int((matches.is_found | inliers).sum())
        return replace(result, found_count=found_count, median_nis=finite_median(nis))

    def _predict(self, frame: Frame, s: FilterState) -> ImuStatus:
        """Propagate the state to the time of the frame's image."""
        image_ns = frame.stamp_ns + round(s.timeshift_s * 1e9)  # IMU time
        gyro_only = self._mono_window is not None or not self._odom_is_level
        return self._imu.predict(s, image_ns, gyro_only)

    def _level(self, s: FilterState) -> None:
        """Learn which way is up, of a state that began without IMU, once samples come."""
        T_new_old = level(s, self._imu.buffer.samples, self._bias, self._config.gravity)
        if T_new_old is not None:
            self._knows_up, self._odom_is_level, self._rest = True, True, RestDetector()
            self._local_map.turn(T_new_old)
            self._keyframes.turn(T_new_old)

    def _update(
        self, landmarks: LandmarkMap, matches: FeatureMatches, interval_ns: int
    ) -> tuple[NDArray[np.bool_], F64]:
        """Update state and features with the matches. Return the inliers (N,) and the NIS of the
        measurements."""
        is_after_gap = interval_ns > _LONG_GAP_NS
        is_suspect = self._imu.buffer.outliers.is_suspect(landmarks.state.stamp_ns)
        inliers, nis = visual_update.update(
            landmarks, matches, self._rig.cam0, self._imu.rate, is_after_gap, is_suspect
        )
        landmarks.record_frame(matches, inliers)
        return inliers, nis

    def _check_health(
        self, s: FilterState, matches: FeatureMatches, count: int, is_textured: bool, interval_ns: int
    ) -> bool:
        """Return whether the state is plausible, and the images do not contradict it for long."""
        in_view, found_count = matches.in_view_count(self._rig.cam0), int(matches.is_found.sum())
        self._divergence.add(is_textured, in_view, found_count, count, interval_ns * 1e-9)
        return not self._divergence.has_diverged and is_plausible(
            s, self._config.max_speed_m_s, self._divergence.blind_drift_m
        )

    def _advance_mono_window(self, frame: Frame, landmarks: LandmarkMap, is_keyframe: bool) -> bool:
        """Return whether a single camera's window gives the scale, and the state has converged. is_keyframe:
        the frame becomes a keyframe of it."""
        if is_keyframe:
            self._keyframes.add_and_finish(frame, landmarks, self._imu.rate)
        window, s = self._mono_window, landmarks.state
        if window is None or not (is_keyframe or window.wants_frame(s.stamp_ns)):
            return False
        imu = self._imu.samples(window.last_ns, s.stamp_ns)
        if imu is None or not self._odom_is_level or window.is_full or measures_depth(frame, self._rig):
            self._landmarks = self._mono_window = None  # start again
            return False
        return window.try_solve(landmarks, imu, is_keyframe) and initialisation.has_converged(s)

    def _publish(
        self, frame: Frame, landmarks: LandmarkMap, state: TrackState, wants_keyframe: bool, count: int
    ) -> TrackResult:
        s = landmarks.state
        is_first, self._has_published, self._mono_window = not self._has_published, True, None
        new_segment = is_first and self._new_segment
        if is_first:
            self._realignment.start(s, new_segment)
        else:
            self._realignment.update(s)
        pose = self._realignment.published_pose(pose_at_stamp(s, self._imu.rate))
        cov = filter.motion_cov_since_origin(s)
        if self._start_cov is not None:
            cov = se3.compose_cov(se3.inverse(s.T_origin) @ s.T, self._start_cov, cov)
        if wants_keyframe or is_first:
            publish = is_first or self._keyframes.may_publish(frame.stamp_ns)
            self._divergence.add_keyframe(filter.drift_m(s), count)
            self._keyframes.add(frame, landmarks, self._imu.rate, count < MIN_OK_FEATURES, publish)
        is_ready = self._keyframes.is_ready
        return TrackResult(
            state,
            pose,
            is_ready,
            count,
            new_segment,
            cov,
            self._consistency.is_consistent,
            velocity=self._realignment.T_odom_filter[:3, :3] @ s.v,
            angular_velocity=self._imu.rate.copy(),
        )

    def _track_state(self, s: FilterState, count: int, imu: ImuStatus) -> TrackState:
        has_imu = imu.has_samples and self._odom_is_level and not (imu.has_rejected and self._has_published)
        if self._mono_window is not None or (
            has_imu and not self._has_published and not self._is_publishable(s, count)
        ):
            return TrackState.INITIALISING
        return pose_state(count, has_imu)

    def _is_publishable(self, s: FilterState, count: int) -> bool:
        """Return whether a first pose can be published, of a frame with `count` features in use. The velocity
        must rest on static features."""
        waited_s = (s.stamp_ns - self._start_ns) * 1e-9
        return self._sees_the_room(count) and initialisation.is_publishable(s, waited_s, self._new_segment)

    def _sees_the_room(self, count: int) -> bool:
        is_static = self._landmarks is None or self._landmarks.is_static(_MIN_PROVEN)
        return is_static and count >= MIN_POSE_FEATURES

    def _waiting_result(self, s: FilterState, count: int) -> TrackResult:
        if self._mono_window is not None:
            reason = WaitReason.SCALE
        else:
            reason = initialisation.waiting_for(s) if self._sees_the_room(count) else WaitReason.VIEW
        return TrackResult(TrackState.INITIALISING, None, waiting_for=reason)

    def _declare_lost(self, frame: Frame) -> TrackResult:
        """Discard the filter."""
        self._landmarks, self._divergence = None, DivergenceMonitor()
        self._keyframes.reset()
        if self._mono_window is not None:  # no pose was published yet
            return TrackResult(TrackState.INITIALISING, None, waiting_for=WaitReason.SCALE)
        self._has_published, self._lost_ns = False, frame.stamp_ns
        return TrackResult(TrackState.LOST, None)
