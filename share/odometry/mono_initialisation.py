"""What a single camera sees until its scale is known: kept for a while, and fitted again and again."""

from __future__ import annotations

import copy

import numpy as np

from share.config import InertialConfig
from share.geometry.camera import Camera, ImuNoise, rays
from share.odometry import filter, mono_bundle
from share.odometry.depth_prior import DIFFER, ROOM, ROOMS
from share.odometry.imu_buffer import coasting
from share.odometry.landmarks import Scene
from share.odometry.measurement import hosts_in_camera
from share.odometry.mono_bundle import Fit, Model, Shot
from share.odometry.normal_equations import SHOT
from share.odometry.state import CORE, EXTRINSIC, State
from share.types import F64, ImuBatch

_APART_NS = 90_000_000  # between shots that are no keyframes
_FITTED, _FEWEST = 4, 12  # shots from one fit to the next, and before the first
_MOVED_PX = 2.0  # of a quarter of the features at least, beside what turning does: less is not worth a fit
_LONGEST_NS = 2_500_000_000
_LASTING = 2.0  # times the sigma of a coordinate: what a patch is off by stays, sights are no news each time
_SURE, _FAR_PX, _COST = 0.03, 15.0, 1.0  # a fit's scale, how far it came as an image shows it, and its cost
_UNKNOWN = 0.1  # relative sigma of scale
_TASTE = 1e-3  # rad, 1/m


class Window:
    """Shots since the beginning, which was a keyframe."""

    def __init__(
        self, first: State, camera: Camera, noise: ImuNoise, config: InertialConfig, common: F64
    ) -> None:
        sigma = _LASTING * float(np.hypot(config.sigma_px, config.lasting_px)) / camera.focal
        self._first, self._camera = copy.deepcopy(first), camera
        self._model = Model(noise, config.gravity, sigma, common, ROOM, ROOMS, DIFFER)
        self._shots: list[Shot] = []
        self._add(first, ImuBatch.empty(), np.zeros((0, 2)), anchored=True)

    @property
    def full(self) -> bool:
        """Nothing has come of it."""
        return self.last_ns - self._shots[0].stamp_ns > _LONGEST_NS

    @property
    def last_ns(self) -> int:
        """IMU time of the last shot."""
        return self._shots[-1].stamp_ns

    def wants(self, stamp_ns: int) -> bool:
        """Whether it is time for a shot."""
        return stamp_ns - self.last_ns > _APART_NS

    def solved(self, scene: Scene, imu: ImuBatch, anchored: bool) -> bool:
        """After the frame just tracked, with the IMU since the last shot; anchored: as newest keyframe.
        Whether the scale is known now; then the scene is set to what was fitted."""
        uv = self._camera.normalise(scene.looks.px.astype(np.float64))
        self._add(scene.state, imu, uv, anchored)
        n = len(self._shots)
        if n < _FEWEST or n % _FITTED or self._moved_px(scene.state, uv) < _MOVED_PX:
            return False
        try:
            fit = mono_bundle.fit(self._shots, self._first, self._model)
        except np.linalg.LinAlgError:
            return False
        if fit.moved * self._camera.focal < _FAR_PX or fit.cost > _COST:
            return False
        self._adopt(scene, fit)
        return filter.scale_sigma(scene.state) < _SURE

    def _add(self, s: State, imu: ImuBatch, uv: F64, anchored: bool) -> None:
        keyframe, seen = int(s.keyframes[-1]) if anchored else -1, slice(len(uv))
        hosts = s.keyframes[s.host[seen]]
        self._shots.append(Shot(s.stamp_ns, imu, keyframe, s.ids[seen], hosts, s.ray[seen], uv))

    def _moved_px(self, s: State, uv: F64) -> float:
        """How far features have moved since their keyframes saw them, less what turning did."""
        q = (hosts_in_camera(s)[:, :3, :3] @ rays(s.ray)[:, :, None])[:, :, 0]
        moved = np.linalg.norm(self._camera.evened(q[:, :2] / q[:, 2:]) - self._camera.evened(uv), axis=1)
        return float(np.quantile(moved, 0.75)) * self._camera.focal if len(moved) else 0.0

    def _adopt(self, scene: Scene, fit: Fit) -> None:
        scene.forget_asleep()
        s, last = scene.state, SHOT * (len(self._shots) - 1)
        scene.keep(np.isin(s.ids, fit.ids))
        numbers = {shot.keyframe: k for k, shot in enumerate(self._shots) if shot.keyframe >= 0}
        shot = np.array([numbers[k] for k in s.keyframes.tolist()])
        which = np.searchsorted(fit.ids, s.ids)
        poses = (SHOT * shot[:, None] + np.arange(6)).ravel()
        columns = np.r_[last : last + SHOT + 6, poses, last + SHOT + 6 + which]
        calibration, fitted = slice(EXTRINSIC.start, CORE), np.r_[0 : EXTRINSIC.start, CORE : s.size]
        s.cov = np.zeros((s.size, s.size))
        s.cov[np.ix_(fitted, fitted)] = fit.cov[np.ix_(columns, columns)]
        s.cov[calibration, calibration] = self._first.cov[calibration, calibration]
        s.T, s.v, s.bg, s.ba = fit.T[-1], fit.v[-1], fit.bg, fit.ba
        s.poses, s.rho = fit.T[shot], fit.rho[which]


def window_for(
    first: State, camera: Camera, noise: ImuNoise, config: InertialConfig, common: F64
) -> Window | None:
    """None where depth was measured. Else the filter goes by camera and gyro until the window is solved:
    up, and how far the room is, are as they are."""
    if filter.scale_sigma(first) < _UNKNOWN:
        return None
    window = Window(first, camera, noise, config, common)
    _by_camera(first)
    return window


def _by_camera(state: State) -> None:
    H = np.zeros((3, state.size))
    H[0, 0] = H[1, 1] = 1
    H[2, state.features_at :] = 1 / len(state.ids)
    filter.learn(state, np.zeros(3), H, _TASTE)


def without_force(state: State, imu: ImuBatch, to_ns: int, gravity: float) -> ImuBatch:
    """What an IMU would say of a body that turns as this one did and keeps its velocity."""
    return coasting(state, imu.gyro.mean(axis=0) - state.bg, to_ns, gravity)
