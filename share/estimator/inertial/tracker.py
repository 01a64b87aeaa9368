"""Odometry by cameras and IMU: a headset's own.

A frame's way: IMU -> propagate -> where features should be -> find them by their patches -> gate ->
update. A keyframe, after its pose is out: the pose joins the state, free corners become its features.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.estimator.inertial import ekf, features, find
from share.estimator.inertial.beginning import first_state
from share.estimator.inertial.features import Looks
from share.estimator.inertial.memory import Memory
from share.estimator.inertial.state import State
from share.estimator.visual import TrackResult
from share.geometry import se3
from share.geometry.camera import ImuNoise, Rig
from share.types import F64, U8, Candidate, Frame, ImuBatch, TrackState
from share.vision import corners
from share.vision.depth import from_depth_camera, from_stereo
from share.vision.view import make_view


class InertialTracker:
    """Feed frames in order to `track`. Deterministic: the same frames give the same poses."""

    def __init__(self, rig: Rig, config: InertialConfig) -> None:
        assert rig.imu is not None
        self._rig, self._config = rig, config
        n, k = rig.imu, config.imu_noise
        self._noise = ImuNoise(
            n.gyro_density * k, n.accel_density * k, n.gyro_walk * k, n.accel_walk * k, n.rate_hz
        )
        self._imu = ImuBatch.empty()
        self._state: State | None = None
        self._looks: Looks = features.none()
        self._memory = Memory()
        self._image: U8 | None = None
        self._rate = np.zeros(3)
        self._next_feature = self._next_keyframe = 0
        self._keyframe_ns = 0
        self._T_keyframe = np.eye(4)

    @property
    def state(self) -> State | None:
        """The filter's; for those who look into it."""
        return self._state

    def track(self, frame: Frame) -> TrackResult:
        """The pose of this frame, causal. Frames must come with rising stamps."""
        self._remember(frame.imu)
        result = self._start(frame) if self._state is None else self._follow(frame, self._state)
        self._image = frame.image0
        return result

    def keyframe(self, frame: Frame) -> Candidate:
        """Make the frame just tracked a keyframe; call it where `track` said so. What it shows to others."""
        s = self._state
        assert s is not None
        new_stretch = self._next_keyframe == 0
        host = ekf.add_keyframe(s, self._next_keyframe, self._rate)
        self._next_keyframe += 1
        self._wake(frame, s)
        self._add_features(frame, s, host)
        self._forget(s)
        self._keyframe_ns, self._T_keyframe = frame.stamp_ns, s.T.copy()
        view = make_view(frame, self._rig, self._config.view_features)
        return Candidate(s.T, ekf.pose_cov(s), s.T[2, :3], view, new_stretch)

    # ------------------------------------------------------------------ the usual frame

    def _follow(self, frame: Frame, s: State) -> TrackResult:
        self._rate = ekf.propagate(
            s, self._samples(s, frame), self._imu_time(s, frame), self._noise, self._config.gravity
        )
        left = find.seek(frame.image0, self._rig.cam0, s, self._looks, self._config)
        if self._image is not None:
            find.rescue(self._image, frame.image0, self._rig.cam0, s, self._looks, left, self._config)
        seen = self._update(frame, s, left)
        self._looks.px[left.found] = left.px[left.found]
        self._looks.age[seen] += 1
        features.learn_slant(self._looks, np.flatnonzero(seen), left.error[seen], left.along[seen])
        self._memory.sleep(s, self._looks, np.flatnonzero(~left.found))
        self._keep(s, seen)
        count = int(seen.sum())
        state = TrackState.OK if count >= self._config.weak else TrackState.WEAK
        if count < self._config.blind:
            state = TrackState.INERTIAL_ONLY
        return TrackResult(state, self._pose(s), self._wants_keyframe(frame, s, count), count)

    def _update(self, frame: Frame, s: State, left: find.Sought) -> NDArray[np.bool_]:
        """Which features (N,) were seen and believed."""
        sights = [self._sight(s, left, None)]
        if frame.image1 is not None and self._rig.cam1 is not None:
            T = self._rig.T_cam1_cam0
            right = find.seek(frame.image1, self._rig.cam1, s, self._looks, self._config, T)
            right.found[~left.found] = False
            sights.append(self._sight(s, right, T))
        rows = ekf.join(*sights)
        rows = rows.take(np.argsort(rows.host, kind="stable"))
        seen = np.zeros(len(s.ids), bool)
        if len(rows.which) == 0:
            return seen
        PHt, S = ekf.gains(s, rows)
        good = ekf.surprise(rows, S) < self._config.gate
        bad = np.zeros(len(s.ids), bool)
        bad[rows.which[~good]] = True  # one camera's doubt is enough
        good &= ~bad[rows.which]
        twice = np.repeat(good, 2)
        if good.any():
            ekf.update(s, rows.take(good), PHt[:, twice], S[np.ix_(twice, twice)])
        seen[rows.which[good]] = True
        return seen

    def _sight(self, s: State, sought: find.Sought, T_right_left: F64 | None) -> ekf.Sight:
        camera = self._rig.cam0 if T_right_left is None else self._rig.cam1
        assert camera is not None
        which = np.flatnonzero(sought.found)
        uv = camera.normalise(sought.px[which].astype(np.float64))
        sigma = np.full(len(which), self._config.sigma_px / camera.focal)
        return ekf.sight(s, which, uv, sigma, self._rate, T_right_left)

    def _pose(self, s: State) -> F64:
        """At the frame's stamp, IMU time: the state is where the image was taken."""
        return se3.exp(-ekf.twist(s, self._rate) * s.offset_s) @ s.T

    def _wants_keyframe(self, frame: Frame, s: State, count: int) -> bool:
        config = self._config
        if frame.stamp_ns - self._keyframe_ns < config.keyframe_gap_s * 1e9:
            return False
        motion = se3.log(se3.inverse(self._T_keyframe) @ s.T)
        return bool(
            np.linalg.norm(motion[3:]) > config.keyframe_m
            or np.linalg.norm(motion[:3]) > config.keyframe_rad
            or count < config.keyframe_seen * config.features
        )

    # ------------------------------------------------------------------ what comes and goes

    def _add_features(self, frame: Frame, s: State, host: int) -> None:
        config, camera = self._config, self._rig.cam0
        px = corners.detect(frame.image0, self._looks.px, config.features - len(s.ids), config.spacing_px)
        ray = camera.normalise(px.astype(np.float64))
        rho, sigma = self._inverse_depth(frame, px, ray)
        known = ~np.isnan(rho)
        px, ray, rho, sigma = px[known], ray[known], rho[known], sigma[known]
        ids = np.arange(self._next_feature, self._next_feature + len(px))
        self._next_feature += len(px)
        ekf.add_features(s, ids, host, ray, rho, sigma)
        self._looks = self._looks.join(features.looks(frame.image0, camera, px, ray, rho))

    def _inverse_depth(self, frame: Frame, px: NDArray[np.float32], ray: F64) -> tuple[F64, F64]:
        """1/m (N,), NaN unknown, and sigma."""
        if frame.image1 is not None and self._rig.cam1 is not None:
            z = from_stereo(frame.image0, frame.image1, self._rig, px, ray)
            sigma = self._config.sigma_px / self._rig.cam0.focal / self._rig.baseline
        else:
            assert frame.depth is not None
            z = from_depth_camera(frame.depth, self._rig, ray)
            sigma = 0.3 / (self._rig.cam0.focal * 0.05)
        return 1 / z, np.full(len(z), sigma)

    def _keep(self, s: State, keep: NDArray[np.bool_]) -> None:
        ekf.keep_features(s, keep)
        self._looks = self._looks.take(keep)

    def _wake(self, frame: Frame, s: State) -> None:
        """Features seen from about here before, where they lie as near as the filter knows."""
        config = self._config
        asked = 0
        for k, asleep in self._memory.near(s, config.recall_m, config.recall_rad):
            if asked >= config.recall:
                break
            before = len(s.ids)
            asked += len(asleep.ids)
            ekf.add_features(s, asleep.ids, k, asleep.ray, asleep.rho, asleep.sigma)
            self._looks = self._looks.join(asleep.looks)
            sought = find.seek(frame.image0, self._rig.cam0, s, self._looks, config, fresh=before)
            rows = self._sight(s, sought, None)
            good = np.ones(len(s.ids), bool)
            good[before:] = False
            if len(rows.which):
                _, S = ekf.gains(s, rows)
                good[rows.which[ekf.surprise(rows, S) < config.gate]] = True
            self._memory.wake(int(s.keyframes[k]), s.ids[good & (np.arange(len(good)) >= before)])
            self._looks.px[sought.found] = sought.px[sought.found]
            self._keep(s, good)

    def _forget(self, s: State) -> None:
        """Keyframes whose features are all gone, and, where there are too many, the most redundant ones."""
        busy = np.isin(np.arange(len(s.keyframes)), s.host)
        remembered = np.array([self._memory.has(int(k)) for k in s.keyframes], bool)
        leave = ~busy & ~remembered
        leave[-1] = False
        while len(s.keyframes) - leave.sum() > self._config.max_keyframes:
            left = np.flatnonzero(~leave)
            apart = se3.log(se3.inverse(s.poses[left, None]) @ s.poses[None, left])
            cost = np.linalg.norm(apart[..., 3:], axis=-1) + np.linalg.norm(apart[..., :3], axis=-1)
            cost[np.diag_indices(len(left))] = np.inf
            nearest = cost.min(axis=1) + 100.0 * busy[left]
            nearest[-1] = np.inf
            leave[left[np.argmin(nearest)]] = True
        self._memory.forget(s.keyframes[leave])
        self._drop_keyframes(s, leave)

    def _drop_keyframes(self, s: State, leave: NDArray[np.bool_]) -> None:
        self._looks = self._looks.take(~leave[s.host])
        ekf.drop_keyframes(s, s.keyframes[leave])

    # ------------------------------------------------------------------ time

    def _remember(self, imu: ImuBatch) -> None:
        old, keep = self._imu, slice(-400, None)
        self._imu = ImuBatch(
            np.concatenate([old.stamps_ns[keep], imu.stamps_ns]),
            np.concatenate([old.gyro[keep], imu.gyro]),
            np.concatenate([old.accel[keep], imu.accel]),
        )

    def _imu_time(self, s: State, frame: Frame) -> int:
        return frame.stamp_ns + round(s.offset_s * 1e9)

    def _samples(self, s: State, frame: Frame) -> ImuBatch:
        stamps = self._imu.stamps_ns
        first = max(int(np.searchsorted(stamps, s.stamp_ns, side="right")) - 1, 0)
        last = int(np.searchsorted(stamps, self._imu_time(s, frame))) + 1
        return ImuBatch(stamps[first:last], self._imu.gyro[first:last], self._imu.accel[first:last])

    # ------------------------------------------------------------------ beginnings

    def _start(self, frame: Frame) -> TrackResult:
        self._state = first_state(frame.stamp_ns, self._imu, self._rig, self._config)
        if self._state is None:
            return TrackResult(TrackState.INITIALISING, None)
        self._rate = self._imu.gyro[-1] - self._state.bg
        return TrackResult(TrackState.OK, self._pose(self._state), True, 0, True)
