"""A rig of two cameras and an IMU that dances before a board, by a motion known in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.lab.calibrate.corner_observations import BoardView
from share.lab.calibrate.corners import Detection
from share.lab.calibrate.target import AprilGrid, Target
from share.types import F64, I64, ImuBatch

NOISE = ImuNoise(2.4e-4, 1.5e-3, 1e-5, 1.5e-4, 200.0)  # a D435i's
TARGET = AprilGrid()
SHIFT_S = 0.0123
T_IMU_CAM0 = se3.exp(np.array([1.1, -0.9, 0.7, 0.031, -0.052, 0.017]))
T_CAM1_CAM0 = se3.exp(np.array([0.004, -0.01, 0.002, -0.06, 0.001, 0.0005]))
CAM0 = Camera(640, 480, 385.0, 385.0, 320.4, 239.6, (-0.05, 0.02, 1e-4, -2e-4))
CAM1 = Camera(640, 480, 386.0, 384.0, 318.0, 241.0, (-0.04, 0.01, 0.0, 1e-4))
GRAVITY = 9.81 * np.array([0.08, -0.99, 0.05]) / np.linalg.norm([0.08, -0.99, 0.05])  # the board hangs askew
START_NS = 1_600_000_000_000_000_000  # where floats no longer resolve nanoseconds
_STEP = 1e-4  # s, for derivatives by differences: exact to 1e-7


@dataclass(frozen=True, eq=False)
class Dance:
    """Sums of sines, up to about 2 rad/s and 1 m/s. axes (3,): how much the camera turns about each; what
    it looks at."""

    seed: int = 0
    axes: tuple[float, float, float] = (1.0, 1.0, 1.0)
    target: Target = TARGET

    def camera(self, t: F64) -> F64:
        """T_target_cam0 (N, 4, 4) at t (N,) s."""
        rng = np.random.default_rng((self.seed, 7))
        hz, phase = rng.uniform(0.15, 0.9, (4, 6)), rng.uniform(0, 6.28, (4, 6))
        waves = np.sin(2 * np.pi * hz[:, :, None] * t + phase[:, :, None]).sum(axis=0)
        middle = np.append(self.target.extent.mean(axis=0), 0.8)
        facing = se3.from_rt(np.diag([1.0, -1, -1]), middle)
        turn = 0.13 * waves[:3].T * self.axes
        return facing @ se3.from_rt(se3.so3_exp(turn), 0.06 * waves[3:].T)

    def body(self, t: F64) -> F64:
        """T_target_imu (N, 4, 4)."""
        return self.camera(t) @ se3.inverse(T_IMU_CAM0)

    def inertial(self, t: F64) -> tuple[F64, F64]:
        """Angular rate (N, 3) and specific force (N, 3), IMU's frame."""
        before, here, after = (self.body(t + s * _STEP) for s in (-1, 0, 1))
        rate = se3.so3_log(before[:, :3, :3].swapaxes(1, 2) @ after[:, :3, :3]) / (2 * _STEP)
        a = (before[:, :3, 3] - 2 * here[:, :3, 3] + after[:, :3, 3]) / _STEP**2
        return rate, np.einsum("nji,nj->ni", here[:, :3, :3], a - GRAVITY)


@dataclass(frozen=True, eq=False)
class Recorded:
    """What a calibration is given."""

    stamps_ns: I64
    views: list[BoardView]
    imu: ImuBatch
    rig: Rig


def record(
    dance: Dance,
    seconds: float = 20.0,
    noise_px: float = 0.1,
    hz: float = 10.0,
    wrong: float = 0.0,
    imu: ImuNoise | None = NOISE,
) -> Recorded:
    """wrong: share of corners found wrongly. imu: its noise; None is a perfect one."""
    rng = np.random.default_rng((dance.seed, 11))
    t = np.arange(0.2, seconds - 0.2, 1 / hz)
    poses = dance.camera(t + SHIFT_S)
    views = [BoardView(str(k), _seen(T, rng, noise_px, wrong)) for k, T in enumerate(poses)]
    rig = Rig(CAM0, np.eye(4), CAM1, T_CAM1_CAM0, imu=NOISE)
    return Recorded(_stamps(t), views, _imu(dance, seconds, rng, imu), rig)


def _stamps(t: F64) -> I64:
    return START_NS + np.round(t * 1e9).astype(np.int64)


def _seen(
    T_target_cam0: F64, rng: np.random.Generator, noise_px: float, wrong: float
) -> tuple[Detection, ...]:
    out = []
    for camera, mount in ((CAM0, np.eye(4)), (CAM1, T_CAM1_CAM0)):
        px = camera.project(se3.transform(mount @ se3.inverse(T_target_cam0), TARGET.corners))
        ids = np.flatnonzero(camera.is_inside(px, 3.0))
        noisy = px[ids] + rng.normal(0, noise_px, (len(ids), 2))
        spoilt = rng.random(len(ids)) < wrong
        noisy[spoilt] += rng.uniform(-8, 8, (int(spoilt.sum()), 2))
        out.append(Detection(ids, noisy))
    return tuple(out)


def _imu(dance: Dance, seconds: float, rng: np.random.Generator, noise: ImuNoise | None) -> ImuBatch:
    t = np.arange(0, seconds, 1 / NOISE.rate_hz)
    gyro, accel = dance.inertial(t)
    if noise is None:
        return ImuBatch(_stamps(t), gyro, accel)
    root = np.sqrt(noise.rate_hz)

    def flawed(true: F64, density: float, walk: float, bias: float) -> F64:
        walked = np.cumsum(rng.normal(0, walk / root, true.shape), axis=0)
        return true + rng.normal(0, density * root, true.shape) + walked + rng.normal(0, bias, 3)

    gyro = flawed(gyro, noise.gyro_density, noise.gyro_walk, 0.01)
    return ImuBatch(_stamps(t), gyro, flawed(accel, noise.accel_density, noise.accel_walk, 0.05))
