"""The filter alone, fed with what a front end would see: noise, and errors that last."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from helpers.imu_world import CAMERA, GRAVITY, NOISE, Path, imu_of, rig

from share.config import InertialConfig
from share.geometry import se3
from share.lab.emulate.sensor.imu import rotation_rates, vibration_acceleration
from share.odometry import feature_matching, filter
from share.odometry import state as filter_state
from share.odometry.imu_predictor import ImuBuffer
from share.odometry.imu_propagation import noise_with_vibration
from share.odometry.initial_depth import prior_from_neighbours
from share.odometry.landmarks import CORRELATED_SIGMA_PX
from share.odometry.state import CORE_SIZE, POSE, FilterState, initial_state
from share.types import ImuBatch

FRAME_HZ = 20
SHIPPED = InertialConfig()
LASTING_S = 1.0  # of a Gauss-Markov process with `CORRELATED_SIGMA_PX` of the world's


@dataclass
class Setup:
    """sigmas of the first state, wrong by as much; what is wrong with the calibration; how it is run."""

    seconds: float = 20.0
    features: int = 60
    mono: bool = False
    pose: tuple[float, float] = (
        0.01,
        1e-4,
    )  # tilt rad; position m (yaw too is 1e-4: there is no other origin)
    velocity: float = 0.05
    bg: float = 0.01
    ba: float = 0.05
    turn: float = 1e-6  # rad, of the extrinsic
    shift: float = 1e-6  # m
    offset: float = 1e-7  # s
    extrinsic_error: np.ndarray | None = None  # (6,); None: drawn
    offset_error: float | None = None
    path: dict[str, float] = field(default_factory=dict)
    sigma_px: float = 0.5  # white; more than is shipped
    imu_hz: float = 200.0
    phase: float = 0.0  # of an IMU's period, by which images come after a sample
    white: float = 0.0  # m/s^2, of each sample, beside the IMU's noise; turning goes with it
    machine: float = 0.0  # m/s^2, rms of a vibration as emulated


@dataclass
class Run:
    stamps: np.ndarray
    nees: np.ndarray  # (N, 2): orientation, position, 3 dof each, in a frame with z up
    nees_in_odom: np.ndarray  # (N, 2): the same of the motion since the filter began
    pose_errors: np.ndarray  # (N, 6) right
    state: FilterState
    extrinsics: np.ndarray  # (N, 7) errors: turn, shift, offset
    surprise: np.ndarray  # (N,) mean squared Mahalanobis distance over degrees of freedom


def run(seed: int, setup: Setup = Setup()) -> Run:  # noqa: B008
    rng = np.random.default_rng((seed, 9))
    path, sensors = Path(seed, **setup.path), rig()
    t_imu, noise = np.arange(0, setup.seconds + 0.5, 1 / setup.imu_hz), replace(NOISE, rate_hz=setup.imu_hz)
    imu, bg, ba = imu_of(path, t_imu, rng.normal(0, setup.bg, 3), rng.normal(0, setup.ba, 3), rng, noise)
    imu = _shaken(imu, t_imu, seed, setup, rng)
    samples = ImuBuffer()
    sigma = _sigmas(setup)
    world = _World(path, sensors, rng, setup)
    extrinsic = (
        setup.extrinsic_error if setup.extrinsic_error is not None else rng.normal(0, 1, 6) * sigma[15:21]
    )
    offset = setup.offset_error if setup.offset_error is not None else rng.normal(0, setup.offset)
    # The clock of the camera is behind by `offset`: a frame stamped t is taken at t + offset, IMU time.
    T0, v0 = path.poses(np.array([0.0]))[0], path.velocity(np.array([0.0]))[0]
    first = rng.normal(0, 1, CORE_SIZE) * sigma
    state = initial_state(0, T0, v0, bg[0], ba[0], sensors.T_body_cam0, sigma)
    first[15:] = 0
    filter.correct_means(state, np.r_[-first, -first[POSE]])
    state.T_body_cam = sensors.T_body_cam0 @ se3.exp(extrinsic)
    log, next_id, keyframe_at = [], 0, -np.inf
    for k in range(1, int(setup.seconds * FRAME_HZ)):
        stamp = k / FRAME_HZ + setup.phase / setup.imu_hz
        to_ns = round((stamp + state.timeshift_s) * 1e9)
        near = slice(*np.searchsorted(imu.stamps_ns, (state.stamp_ns - 10**7, to_ns + 10**7)))
        part = imu.take(near)
        samples.samples = imu.take(slice(int(np.searchsorted(imu.stamps_ns, to_ns)) + 1))
        rate = filter.propagate(
            state, part, to_ns, noise_with_vibration(noise, samples.latest(to_ns)), GRAVITY
        )
        taken = stamp + offset
        level = world.see(state, taken, rate)
        if len(state.feature_ids) < 0.7 * setup.features or stamp - keyframe_at > 1.0:
            keyframe_at = stamp
            host = filter_state.add_keyframe(state, k, rate)
            next_id = world.new(state, host, k, taken, setup.features - len(state.feature_ids), next_id)
            _forget_idle(state)
        true = path.poses(np.array([state.stamp_ns * 1e-9]))[0]
        error = se3.log(se3.inverse(state.T) @ true)
        to_body = se3.adjoint(se3.inverse(state.T))
        nees = _nees(error, to_body @ state.cov[POSE, POSE] @ to_body.T)
        motion = se3.inverse(state.T_origin) @ state.T
        error_in_odom = se3.log(se3.inverse(motion) @ se3.inverse(T0) @ true)
        nees += _nees(error_in_odom, filter.motion_cov_since_origin(state))
        calib = se3.log(se3.inverse(state.T_body_cam) @ sensors.T_body_cam0)
        log.append((stamp, *nees, *error, *calib, state.timeshift_s - offset, level))
    out = np.array(log)
    return Run(out[:, 0], out[:, 1:3], out[:, 3:5], out[:, 5:11], state, out[:, 11:18], out[:, 18])


def _nees(error: np.ndarray, cov: np.ndarray) -> list[float]:
    return [error[part] @ np.linalg.solve(cov[part, part], error[part]) for part in (slice(3), slice(3, 6))]


def _shaken(imu: ImuBatch, t: np.ndarray, seed: int, setup: Setup, rng) -> ImuBatch:
    extra = np.zeros((len(t), 3))
    if setup.white:
        extra += rng.normal(0, setup.white, extra.shape)
    if setup.machine:
        extra += vibration_acceleration(t, setup.machine, (seed, 3))
    return ImuBatch(imu.stamps_ns, imu.gyro + rotation_rates(extra), imu.accel + extra)


def _sigmas(setup: Setup) -> np.ndarray:
    out = np.zeros(CORE_SIZE)
    out[0:2], out[2] = setup.pose[0], 1e-4
    out[3:6] = setup.pose[1]
    out[6:9], out[9:12], out[12:15] = setup.velocity, setup.bg, setup.ba
    out[15:18], out[18:21], out[21] = setup.turn, setup.shift, setup.offset
    return out


def _forget_idle(state: FilterState) -> None:
    busy = np.unique(state.anchor)
    idle = np.setdiff1d(np.arange(len(state.keyframe_ids)), busy)
    filter_state.drop_keyframes(state, state.keyframe_ids[idle])


class _World:
    """Points that come and go with the features."""

    def __init__(self, path, sensors, rng, setup):
        self._eyes = (None,) if setup.mono else (None, sensors.T_cam1_cam0)
        self._mono, self._sigma_px = setup.mono, setup.sigma_px
        self._px = np.zeros((0, 2), np.float32)
        self._path, self._rig, self._rng = path, sensors, rng
        self._points, self._lasting = {}, {}

    def _camera(self, taken):
        return self._path.poses(np.array([taken]))[0] @ self._rig.T_body_cam0

    def see(self, state, taken, rate):
        """Update with all that are in view; the others are lost. Mean surprise a degree of freedom."""
        if len(state.feature_ids) == 0:
            return 1.0
        points = np.array([self._points[i] for i in state.feature_ids])
        lasting = self._what_lasts(state.feature_ids)
        seen = []
        for T_right_left in self._eyes:
            T = se3.inverse(self._camera(taken))
            T = T if T_right_left is None else T_right_left @ T
            px = CAMERA.project(se3.transform(T, points))
            px += self._rng.normal(0, self._sigma_px, px.shape) + lasting
            seen.append(np.where(CAMERA.is_inside(np.nan_to_num(px, nan=-1e9))[:, None], px, np.nan))
        inside = ~np.isnan([px[:, 0] for px in seen]).any(axis=0)
        which = np.flatnonzero(inside)
        sigma = np.full(len(which), self._sigma_px / CAMERA.focal)
        lasts = np.full(len(which), CORRELATED_SIGMA_PX / CAMERA.focal)
        first, *others = (
            filter.feature_measurements(
                state,
                which,
                feature_matching.predict(state, which, T),
                CAMERA.normalise(px[which]),
                sigma,
                lasts,
                rate,
            )
            for px, T in zip(seen, self._eyes, strict=True)
        )
        rows = first.concatenate(*others)
        rows = rows.take(np.argsort(rows.anchor, kind="stable"))
        level = 1.0
        if len(which):
            level = filter.update(state, rows, *filter.innovation_covariance(state, rows)) / (
                2 * len(rows.feature)
            )
        filter_state.keep_features(state, inside)
        self._px = seen[0][inside].astype(np.float32)
        return level

    def _what_lasts(self, ids):
        """px (N, 2), a frame later."""
        kept = np.exp(-1 / FRAME_HZ / LASTING_S)
        fresh = self._rng.normal(0, CORRELATED_SIGMA_PX * np.sqrt(1 - kept**2), (len(ids), 2))
        for i, news in zip(ids.tolist(), fresh, strict=True):
            self._lasting[i] = kept * self._lasting.get(i, np.zeros(2)) + news
        return np.array([self._lasting[i] for i in ids.tolist()])

    def new(self, state, host, k, taken, count, next_id):
        if count <= 0:
            return next_id
        px = self._rng.uniform((5, 5), (634, 474), (count, 2))
        uv, z = CAMERA.normalise(px), self._rng.uniform(1.5, 6.0, count)
        in_cam = np.column_stack([uv, np.ones(count)]) * z[:, None]
        for i, p in enumerate(se3.transform(self._camera(taken), in_cam)):
            self._points[next_id + i] = p
        ids = np.arange(next_id, next_id + count)
        if self._mono:
            g = prior_from_neighbours(state, px.astype(np.float32), self._px)
            filter_state.add_features(
                state, ids, np.full(count, host), uv, g.rho, g.sigma, g.J_existing, g.common_sigma
            )
            return next_id + count
        sigma = self._sigma_px / CAMERA.fx / self._rig.baseline
        rho = np.maximum(1 / z + self._rng.normal(0, sigma, count), 0.02)
        hosts = np.full(count, host)
        filter_state.add_features(
            state, np.arange(next_id, next_id + count), hosts, uv, rho, np.full(count, sigma)
        )
        return next_id + count
