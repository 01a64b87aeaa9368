"""A world of points, a smooth path through it, and what a perfect or a noisy rig measures there."""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.types import ImuBatch

GRAVITY = 9.81
NOISE = ImuNoise(1.7e-4, 2.0e-3, 2.0e-5, 3.0e-4, 200.0)
CAMERA = Camera(640, 480, 385.0, 385.0, 319.5, 239.5)
_H = 1e-3  # s, of differences


def rig(baseline=0.05):
    T_body_cam = se3.exp(np.array([0.02, -0.03, 0.01, 0.01, -0.02, 0.03]))
    T_body_cam[:3, :3] = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ T_body_cam[:3, :3]
    T_right_left = se3.from_rt(np.eye(3), np.array([-baseline, 0, 0]))
    return Rig(CAMERA, T_body_cam, CAMERA, T_right_left, imu=NOISE)


class Path:
    """Sines of a few metres and a fraction of a turn; `seed` chooses them."""

    def __init__(self, seed, size=1.0, turn=0.5):
        rng = np.random.default_rng((seed, 1))
        self._a = rng.uniform(0.3, 1.0, (4, 3)) * size * np.array([1.0, 1.0, 0.25]) / 2
        self._w = rng.uniform(0.5, 2.5, (4, 3))
        self._f = rng.uniform(0, 2 * np.pi, (4, 3))
        self._b = rng.uniform(0.2, 1.0, (3, 3)) * turn / 2
        self._u = rng.uniform(0.3, 2.0, (3, 3))
        self._g = rng.uniform(0, 2 * np.pi, (3, 3))

    def poses(self, t):
        t = np.asarray(t, np.float64)[..., None, None]
        p = (self._a * np.sin(self._w * t + self._f)).sum(axis=-2)
        phi = (self._b * np.sin(self._u * t + self._g)).sum(axis=-2)
        return se3.from_rt(se3.so3_exp(phi), p)

    def velocity(self, t):
        return (self.poses(t + _H)[..., :3, 3] - self.poses(t - _H)[..., :3, 3]) / (2 * _H)

    def inertial(self, t):
        before, now, after = (self.poses(t + d) for d in (-_H, 0.0, _H))
        rate = se3.so3_log(np.swapaxes(before[..., :3, :3], -1, -2) @ after[..., :3, :3]) / (2 * _H)
        a = (after[..., :3, 3] - 2 * now[..., :3, 3] + before[..., :3, 3]) / _H**2
        a[..., 2] += GRAVITY
        return rate, (np.swapaxes(now[..., :3, :3], -1, -2) @ a[..., None])[..., 0]


def imu_of(path, t, bg=0.0, ba=0.0, rng=None, noise=NOISE):
    """Samples at t (N,) s; with `rng`, noise and walking biases."""
    rate, force = path.inertial(t)
    n, dt = len(t), 1 / noise.rate_hz
    bg, ba = (np.broadcast_to(b, (n, 3)).astype(float) for b in (bg, ba))
    if rng is not None:
        bg = bg + np.cumsum(rng.normal(0, noise.gyro_walk * np.sqrt(dt), (n, 3)), axis=0)
        ba = ba + np.cumsum(rng.normal(0, noise.accel_walk * np.sqrt(dt), (n, 3)), axis=0)
        rate = rate + rng.normal(0, noise.gyro_density / np.sqrt(dt), (n, 3))
        force = force + rng.normal(0, noise.accel_density / np.sqrt(dt), (n, 3))
    stamps = np.rint(t * 1e9).astype(np.int64)
    return ImuBatch(stamps, rate + bg, force + ba), bg, ba
