"""A furnished floor, motions on it, and an integrator of what their IMU would measure."""

import functools

import numpy as np
from scipy.integrate import cumulative_simpson
from scipy.interpolate import make_interp_spline
from scipy.ndimage import distance_transform_edt

from share.geometry import se3
from share.lab.emulate.motion import robot, walk
from share.lab.emulate.motion.crowd import FloorGraphs, MotionPreferences, plan_motion
from share.lab.emulate.motion.route import Floor
from share.lab.emulate.types import GRAVITY, START_NS

BLOCKS = ((0, 0, 9, 0.6), (0, 5.4, 9, 6), (0, 2, 0.5, 4), (4, 2.6, 5.2, 3.4), (7, 3, 7.5, 3.5))
SECONDS = 30.0


def floor(size=(9.0, 6.0), blocks=BLOCKS, step=0.1):
    """Walls around, and axis-aligned blocks (x, y, x, y) m."""
    x, y = np.meshgrid(*(np.arange(round(s / step) + 1) * step for s in size), indexing="ij")
    free = np.ones(x.shape, bool)
    for a, b, c, d in blocks:
        free &= ~((x >= a) & (x <= c) & (y >= b) & (y <= d))
    free[[0, -1]] = free[:, [0, -1]] = False
    return Floor(distance_transform_edt(free) * step, step)


@functools.cache
def track(look, seed=1, speed=0.9, pauses=2.0):
    _, found = plan_motion(FloorGraphs(floor()), MotionPreferences(look, speed, pauses), (), SECONDS, (seed,))
    return found


@functools.cache
def person(seed=1, speed=0.9, turns=2.6):
    rng = np.random.default_rng(seed)
    things = rng.uniform((0, 0, 0.3), (9, 6, 2.3), (100, 3))
    return walk.headset_path(track("person", seed, speed), 1.7, turns, things, [], START_NS, rng)


@functools.cache
def driver(seed=1, vibration=0.4, speed=0.35):
    return robot.imu_path(track("robot", seed, speed), 0.35, vibration, START_NS, np.random.default_rng(seed))


def every(path, hz, seconds=None):
    end = path.end_ns if seconds is None else path.start_ns + round(seconds * 1e9)
    return np.arange(path.start_ns, end + 1, round(1e9 / hz))


def integrated(path, hz, seconds):
    """T_world_body (4, 4) after `seconds`, from the true start and IMU samples at `hz`: both made
    continuous by quintic splines; rotation by the fourth-order Magnus expansion."""
    stamps = every(path, hz, seconds)
    t = (stamps - stamps[0]) / 1e9
    gyro, force = (make_interp_spline(t, v, k=5) for v in path.inertial(stamps))
    h = 1 / 2000
    fine = np.arange(round(t[-1] / h) + 1) * h
    c = np.sqrt(3) / 6
    w1, w2 = gyro(fine[:-1] + (0.5 - c) * h), gyro(fine[:-1] + (0.5 + c) * h)
    steps = se3.so3_exp(h / 2 * (w1 + w2) - np.sqrt(3) * h**2 / 12 * np.cross(w2, w1))
    R = np.empty((len(fine), 3, 3))
    R[0] = path.poses(stamps[:1])[0, :3, :3]
    for k, step in enumerate(steps):
        R[k + 1] = R[k] @ step
    a = np.einsum("nij,nj->ni", R, force(fine)) - (0, 0, GRAVITY)
    v = path.velocity(stamps[:1]) + cumulative_simpson(a, x=fine, axis=0, initial=0)
    p = path.poses(stamps[:1])[:, :3, 3] + cumulative_simpson(v, x=fine, axis=0, initial=0)
    return se3.from_rt(R[-1], p[-1])
