"""A body whose motion is known in closed form, the IMU it carries and the mocap that watches it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.mocap.trajectory import MocapTrajectory
from share.types import F64, I64, ImuBatch

NOISE = ImuNoise(1.7e-4, 2e-3, 2e-5, 3e-3, 200.0)
G = 9.81
UP_G = np.array([0, 0, G])
START_NS = 1_600_000_000_000_000_000  # where floats no longer resolve nanoseconds
BODY = se3.exp(np.array([0.3, -2.1, 0.7, 0.04, -0.09, 0.06]))  # T_body_mocap
TILT = np.radians([0.4, -0.7])
_STEP = 1e-4  # s, for derivatives by differences: exact to 1e-7


@dataclass(frozen=True, eq=False)
class Motion:
    """Sums of sines: up to about 1.5 m/s and 2 rad/s. planar: turns about the vertical only."""

    seed: int = 1
    planar: bool = False

    def pose(self, t: F64) -> F64:
        """T_world_body (N, 4, 4) at t (N,) s."""
        rng = np.random.default_rng((self.seed, 7))
        hz, phase = rng.uniform(0.1, 0.6, (3, 6)), rng.uniform(0, 6.28, (3, 6))
        waves = np.sin(2 * np.pi * hz[:, :, None] * t + phase[:, :, None])
        p = 0.3 * waves[:, :3].sum(1).T + (2.0, 1.0, 1.5)
        angles = 0.35 * waves[:, 3:].sum(1).T
        roll_pitch = angles * (1, 1, 0) * (not self.planar)
        return se3.from_rt(se3.so3_exp(angles * (0, 0, 1.5)) @ se3.so3_exp(roll_pitch), p)

    def inertial(self, t: F64) -> tuple[F64, F64]:
        """Angular rate (N, 3) and specific force (N, 3), body frame."""
        before, here, after = (self.pose(t + s * _STEP) for s in (-1, 0, 1))
        rate = se3.so3_log(before[:, :3, :3].swapaxes(1, 2) @ after[:, :3, :3]) / (2 * _STEP)
        a = (before[:, :3, 3] - 2 * here[:, :3, 3] + after[:, :3, 3]) / _STEP**2
        return rate, np.einsum("nji,nj->ni", here[:, :3, :3], a + UP_G)


def stamps(seconds: float, hz: float, start_s: float = 0.0) -> I64:
    return START_NS + np.round(np.arange(start_s, seconds, 1 / hz) * 1e9).astype(np.int64)


def record_imu(motion: Motion, seconds: float, noise: ImuNoise | None = NOISE, seed: int = 0) -> ImuBatch:
    """What an IMU records: with white noise and walking biases, or without any."""
    t = stamps(seconds, 200)
    gyro, accel = motion.inertial((t - START_NS) * 1e-9)
    if noise is not None:
        rng = np.random.default_rng((seed, 1))

        def flawed(density: float, walk: float, bias: float) -> F64:
            steps = rng.normal(0, walk / np.sqrt(200), (len(t), 3))
            return (
                rng.normal(0, bias, 3) + steps.cumsum(0) + rng.normal(0, density * np.sqrt(200), (len(t), 3))
            )

        gyro = gyro + flawed(noise.gyro_density, noise.gyro_walk, 0.02)
        accel = accel + flawed(noise.accel_density, noise.accel_walk, 0.05)
    return ImuBatch(t, gyro, accel)


def record_mocap(
    motion: Motion,
    seconds: float,
    offset_ns: int = 0,
    sigma: tuple[float, float] = (0.002, np.radians(0.2)),
    seed: int = 0,
    hz: float = 100.0,
    gaps: tuple[tuple[float, float], ...] = (),
    drift: float = 0.0,
) -> MocapTrajectory:
    """Poses of the mocap's body, stamped with a clock that is `offset_ns` behind the IMU's
    in the middle, and more so by `drift` s a second. sigma: m, rad. gaps: s, where it sees nothing."""
    t = stamps(seconds - 0.3, hz, 0.3)
    s = (t - START_NS) * 1e-9
    rng = np.random.default_rng((seed, 2))
    T = se3.from_rt(se3.so3_exp(np.append(TILT, 0.0)), np.zeros(3)) @ motion.pose(s) @ BODY
    T[:, :3, :3] = T[:, :3, :3] @ se3.so3_exp(rng.normal(0, sigma[1], (len(t), 3)))
    T[:, :3, 3] += rng.normal(0, sigma[0], (len(t), 3))
    keep = ~np.any([(s > a) & (s < b) for a, b in gaps], axis=0) if gaps else np.ones(len(t), bool)
    late = offset_ns + np.round(drift * (t - START_NS - seconds * 5e8)).astype(np.int64)
    return MocapTrajectory((t - late)[keep], T[keep])
