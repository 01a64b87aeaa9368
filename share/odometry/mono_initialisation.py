"""Scale initialisation of a single camera: keep a window of frames, and fit it repeatedly until the scale
is known."""

from __future__ import annotations

import copy

import numpy as np

from share.config import InertialConfig
from share.geometry.camera import Camera, ImuNoise, rays
from share.odometry import filter, mono_bundle
from share.odometry.feature_matching import anchors_in_camera
from share.odometry.initial_depth import FEATURE_SPREAD, MEAN_RHO, ROOM_LOG_SIGMA
from share.odometry.landmarks import CORRELATED_SIGMA_PX, LandmarkMap
from share.odometry.mono_bundle import FRAME_SIZE, BundleModel, BundleSolution, WindowFrame
from share.odometry.state import CORE_SIZE, EXTRINSIC, ORIGIN, FilterState
from share.odometry.visual_update import COMMON_COV
from share.types import F64, ImuBatch

_FRAME_GAP_NS = 90_000_000  # minimum between frames of the window that are no keyframes
_SOLVE_PERIOD = 4  # frames between fits
_MIN_FRAMES = 12  # before the first fit
_MIN_PARALLAX_PX = 2.0  # of at least a quarter of the features, without rotation, for a fit
_MAX_WINDOW_NS = 2_500_000_000
_NOISE_SCALE = 2.0  # of a coordinate's sigma, because errors of a patch last from frame to frame
# A fit is accepted with
_MAX_SCALE_SIGMA = 0.03  # relative
_MIN_BASELINE_PX = 15.0  # baseline over depth, times the focal length
_MAX_COST = 1.0  # mean of an observation, squared sigmas
_UNKNOWN_SCALE_SIGMA = 0.1  # relative
_GAUGE_SIGMA = 1e-3  # rad, 1/m


class MonoWindow:
    """Frames since the first keyframe."""

    def __init__(self, first: FilterState, camera: Camera, noise: ImuNoise, config: InertialConfig) -> None:
        sigma = _NOISE_SCALE * float(np.hypot(config.sigma_px, CORRELATED_SIGMA_PX)) / camera.focal
        self._first, self._camera = copy.deepcopy(first), camera
        self._model = BundleModel(
            noise, config.gravity, sigma, COMMON_COV, MEAN_RHO, ROOM_LOG_SIGMA, FEATURE_SPREAD
        )
        self._frames: list[WindowFrame] = []
        self._add(first, ImuBatch.empty(), np.zeros((0, 2)), is_keyframe=True)

    @property
    def is_full(self) -> bool:
        """Whether no fit was accepted in `_MAX_WINDOW_NS`."""
        return self.last_ns - self._frames[0].stamp_ns > _MAX_WINDOW_NS

    @property
    def last_ns(self) -> int:
        """IMU time of the last frame."""
        return self._frames[-1].stamp_ns

    def wants_frame(self, stamp_ns: int) -> bool:
        """Return whether it is time for another frame."""
        return stamp_ns - self.last_ns > _FRAME_GAP_NS

    def try_solve(self, landmarks: LandmarkMap, imu: ImuBatch, is_keyframe: bool) -> bool:
        """Add the frame just tracked, with the IMU samples since the last, and fit if it is time.

        A fit that is good enough replaces state and covariance. Return whether the scale is known.
        is_keyframe: the frame is the newest keyframe.
        """
        uv = self._camera.normalise(landmarks.appearance.last_px.astype(np.float64))
        self._add(landmarks.state, imu, uv, is_keyframe)
        n = len(self._frames)
        if n < _MIN_FRAMES or n % _SOLVE_PERIOD or self._parallax_px(landmarks.state, uv) < _MIN_PARALLAX_PX:
            return False
        try:
            solution = mono_bundle.solve_bundle(self._frames, self._first, self._model)
        except np.linalg.LinAlgError:
            return False
        if solution.relative_baseline * self._camera.focal < _MIN_BASELINE_PX or solution.cost > _MAX_COST:
            return False
        self._apply_solution(landmarks, solution)
        return filter.scale_sigma(landmarks.state) < _MAX_SCALE_SIGMA

    def _add(self, s: FilterState, imu: ImuBatch, uv: F64, is_keyframe: bool) -> None:
        keyframe_id, part = int(s.keyframe_ids[-1]) if is_keyframe else -1, slice(len(uv))
        anchors = s.keyframe_ids[s.anchor[part]]
        self._frames.append(
            WindowFrame(s.stamp_ns, imu, keyframe_id, s.feature_ids[part], anchors, s.ray[part], uv)
        )

    def _parallax_px(self, s: FilterState, uv: F64) -> float:
        """Return the motion of features since their anchors saw them, without the effect of rotation: the
        third quartile."""
        q = (anchors_in_camera(s)[:, :3, :3] @ rays(s.ray)[:, :, None])[:, :, 0]
        distance = np.linalg.norm(
            self._camera.to_image_plane(q[:, :2] / q[:, 2:]) - self._camera.to_image_plane(uv), axis=1
        )
        return float(np.quantile(distance, 0.75)) * self._camera.focal if len(distance) else 0.0

    def _apply_solution(self, landmarks: LandmarkMap, solution: BundleSolution) -> None:
        landmarks.drop_dormant()
        s, last = landmarks.state, FRAME_SIZE * (len(self._frames) - 1)
        landmarks.keep_features(np.isin(s.feature_ids, solution.feature_ids))
        frame_of_keyframe = {
            frame.keyframe_id: k for k, frame in enumerate(self._frames) if frame.keyframe_id >= 0
        }
        frame = np.array([frame_of_keyframe[k] for k in s.keyframe_ids.tolist()])
        indices = np.searchsorted(solution.feature_ids, s.feature_ids)
        poses = (FRAME_SIZE * frame[:, None] + np.arange(6)).ravel()
        columns = np.r_[last : last + FRAME_SIZE + 6, 0:6, poses, last + FRAME_SIZE + 6 + indices]
        calibration = slice(EXTRINSIC.start, CORE_SIZE)
        fitted = np.r_[0 : EXTRINSIC.start, ORIGIN.start : s.size]
        s.cov = np.zeros((s.size, s.size))
        s.cov[np.ix_(fitted, fitted)] = solution.cov[np.ix_(columns, columns)]
        s.cov[calibration, calibration] = self._first.cov[calibration, calibration]
        s.T, s.v, s.bg, s.ba = solution.T[-1], solution.v[-1], solution.bg, solution.ba
        s.T_origin, s.keyframe_poses, s.rho = solution.T[0], solution.T[frame], solution.rho[indices]


def start_mono_window(
    first: FilterState, camera: Camera, noise: ImuNoise, config: InertialConfig
) -> MonoWindow | None:
    """Return a window where depth is unknown, None where it was measured.

    Until the window is solved the filter uses camera and gyro only; tilt and the mean inverse depth are
    fixed.
    """
    if filter.scale_sigma(first) < _UNKNOWN_SCALE_SIGMA:
        return None
    window = MonoWindow(first, camera, noise, config)
    _fix_gauge(first)
    return window


def _fix_gauge(state: FilterState) -> None:
    H = np.zeros((3, state.size))
    H[0, 0] = H[1, 1] = 1
    H[2, state.features_start :] = 1 / len(state.feature_ids)
    filter.isotropic_update(state, np.zeros(3), H, _GAUGE_SIGMA)
