"""Where the parts of an agent's body are, told from its path alone.

    path -> head (or base) -> where the trunk must be -> legs in step, feet on the floor

A person's step is read off the bob of the head: the phase of its analytic signal (Gabor 1946) between
0.8 and 3 Hz, so that legs and head agree on recorded paths as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.lab.emulate.motion import figures
from share.lab.emulate.motion.figures import FIGURES
from share.lab.emulate.motion.gait import WALK_RATIO
from share.lab.emulate.motion.track import min_jerk
from share.lab.emulate.motion.walk import CAMERA_AXES, LEVER, turn
from share.lab.emulate.types import Path
from share.lab.emulate.world.mesh import Shape
from share.types import F64, I64

_RATE_HZ = 50
_SLOW_S = 0.35  # sigma of the trunk's smoothing
_LOOKS = 0.35  # m/s: walking faster than this, the trunk rather follows the way than the eyes
_STEP_HZ = (0.8, 3.0)
_WALKING = 0.45  # m/s, from which on one truly walks
_LIFT_M = 0.11
_ARMS = 0.55  # rad of swing at 1.4 m/s
_HEIGHT_M = (1.3, 2.05)  # of a person, by how high the head is carried


def shapes(look: str, path: Path, seed: tuple[int, ...]) -> tuple[Shape, ...]:
    """The parts of an agent that looks as `person`, `robot` or `drone`, each in its own frame."""
    return FIGURES[look](np.random.default_rng(seed), stature(look, path))


def stature(look: str, path: Path) -> float:
    """Height (m) of a person whose head is carried so high; of a robot's camera."""
    z = path.poses(_spread(path))[:, 2, 3]
    if look != "person":
        return float(np.median(z))
    return float(np.clip(np.percentile(z, 90) / figures.EYE, *_HEIGHT_M))


def _spread(path: Path) -> I64:
    """Some stamps (200,) over a path; in integers, for a float does not hold them."""
    return path.start_ns + np.linspace(0, path.end_ns - path.start_ns, 200).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Avatar:
    """The body of one agent along its path. T_body_cam0 (4, 4): how the camera sits on the path's body,
    which tells where it looks; None where the body has a camera's axes itself, as simulated ones have."""

    look: str
    path: Path
    T_body_cam0: F64 | None = None

    def parts(self, stamps_ns: I64) -> F64:
        """T_world_part (N, P, 4, 4), in the order of `shapes`. Raises ValueError outside the path's span."""
        return _BODIES[self.look](self, np.asarray(stamps_ns, np.int64))

    def facing(self, stamps_ns: I64) -> F64:
        """T_world_camera-place (N, 4, 4): where the body is, its axes ahead, left, up of its camera."""
        T = self.path.poses(stamps_ns)
        mount = np.eye(3) if self.T_body_cam0 is None else self.T_body_cam0[:3, :3]
        return se3.compose(T[:, :3, :3] @ mount @ CAMERA_AXES.T, T[:, :3, 3])


def _robot(avatar: Avatar, stamps: I64) -> F64:
    T = avatar.facing(stamps)
    R = turn(2, np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    return se3.compose(R, T[:, :3, 3] * (1, 1, 0))[:, None]


def _drone(avatar: Avatar, stamps: I64) -> F64:
    """Upright on average, and tilted as the body tilts."""
    up = avatar.facing(_spread(avatar.path))[:, 2, :3].mean(0)
    up /= np.linalg.norm(up)
    ahead = np.cross((0.0, 1.0, 0.0), up)
    ahead /= np.linalg.norm(ahead)
    R = np.stack([ahead, np.cross(up, ahead), up], axis=1)
    T = avatar.facing(stamps)
    return se3.compose(T[:, :3, :3] @ R, T[:, :3, 3])[:, None]


def _person(avatar: Avatar, stamps: I64) -> F64:
    height = stature("person", avatar.path)
    T = avatar.facing(stamps)
    head = se3.compose(T[:, :3, :3], T[:, :3, 3] - figures.HEADSET_M * T[:, :3, 0])
    walk = _Walk.of(avatar).at((stamps - avatar.path.start_ns) / 1e9)
    hip = np.column_stack([walk.xy, np.minimum(figures.HIP * height, head[:, 2, 3] - 0.36 * height)])
    trunk = _leaned(hip, head[:, :3, 3] - (0, 0, 0.13), walk.heading)
    torso = se3.compose(trunk, hip)
    arms = [_arm(torso, walk, height, side) for side in (1, -1)]
    legs = [_leg(hip, walk, height, side) for side in (1, -1)]
    order = [
        head,
        torso,
        *(arm[k] for k in range(2) for arm in arms),
        *(leg[k] for k in range(3) for leg in legs),
    ]
    return np.stack(order, axis=1)


_BODIES = {"person": _person, "robot": _robot, "drone": _drone}


@dataclass(frozen=True, eq=False)
class _Walk:
    """How the trunk moves: xy (N, 2) m, heading (N,) rad, speed (N,) m/s, phase (N,) rad of a step."""

    seconds: F64
    xy: F64
    heading: F64
    speed: F64
    phase: F64

    @staticmethod
    def of(avatar: Avatar) -> _Walk:
        from scipy.ndimage import gaussian_filter1d

        span = (avatar.path.end_ns - avatar.path.start_ns) / 1e9
        seconds = np.arange(int(span * _RATE_HZ) + 1) / _RATE_HZ
        T = avatar.facing(avatar.path.start_ns + np.round(seconds * 1e9).astype(np.int64))
        neck = T[:, :3, 3] - T[:, :3, :3] @ LEVER
        sigma = _SLOW_S * _RATE_HZ
        xy = gaussian_filter1d(neck[:, :2], sigma, axis=0, mode="nearest")
        v = np.gradient(xy, 1 / _RATE_HZ, axis=0)
        looks = T[:, :2, 0] / np.maximum(np.linalg.norm(T[:, :2, 0], axis=1, keepdims=True), 0.2)
        way = gaussian_filter1d(v + _LOOKS * looks, sigma, axis=0, mode="nearest")
        phase = np.unwrap(np.angle(-_band(neck[:, 2])))
        heading = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
        return _Walk(seconds, xy, heading, np.linalg.norm(v, axis=1), phase)

    def at(self, seconds: F64) -> _Walk:
        xy, *rest = (
            np.stack([np.interp(seconds, self.seconds, column) for column in np.atleast_2d(values.T)], axis=1)
            for values in (self.xy, self.heading, self.speed, self.phase)
        )
        return _Walk(seconds, xy, *(r[:, 0] for r in rest))


def _band(z: F64) -> NDArray[np.complex128]:
    """The analytic signal of what is quick as steps are in z (N,): no negative frequencies."""
    spectrum = np.fft.rfft(z - z.mean())
    hz = np.fft.rfftfreq(len(z), 1 / _RATE_HZ)
    spectrum[(hz < _STEP_HZ[0]) | (hz > _STEP_HZ[1])] = 0
    return np.fft.ifft(2 * spectrum, len(z))


def _leaned(hip: F64, neck: F64, heading: F64) -> F64:
    """Rotations (N, 3, 3) of a trunk that faces `heading` and reaches from hip to neck (N, 3) m."""
    up = neck - hip
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    left = np.cross(up, np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1))
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([np.cross(left, up), left, up], axis=2)


def _arm(torso: F64, walk: _Walk, height: float, side: int) -> tuple[F64, F64]:
    """Upper arm and forearm; an arm swings with the opposite leg."""
    swing = _ARMS * (walk.speed / 1.4).clip(0, 1.3) * _stride(walk, -side)
    shoulder = np.array([0.0, side * figures.SHOULDERS * height, (figures.SHOULDER - 0.02) * height])
    upper = _jointed(torso, shoulder, swing)
    bend = 0.25 + 0.5 * (swing.clip(0) + 0.2 * (walk.speed / 1.4).clip(0, 1))
    return upper, _jointed(upper, np.array([0.0, 0.0, -figures.UPPER_ARM * height]), bend)


def _stride(walk: _Walk, side: int) -> F64:
    """-1 .. 1: how far ahead the foot of a side is."""
    return side * np.cos(walk.phase / 2)


def _leg(hip: F64, walk: _Walk, height: float, side: int) -> tuple[F64, F64, F64]:
    """Thigh, shin and foot: the foot stands while the body passes over it, then swings ahead."""
    thigh, shin = figures.THIGH * height, figures.SHIN * height
    level = turn(2, walk.heading)
    joint = hip + level @ np.array([0.0, side * figures.HIPS * height, 0.0])
    ankle_x, lift = _step(walk, side)
    ahead, down = ankle_x, joint[:, 2] - figures.ANKLE * height - lift
    reach = np.hypot(ahead, down).clip(0.2, 0.999 * (thigh + shin))
    knee = np.pi - np.arccos(((thigh**2 + shin**2 - reach**2) / (2 * thigh * shin)).clip(-1, 1))
    inner = np.arccos(((thigh**2 + reach**2 - shin**2) / (2 * thigh * reach)).clip(-1, 1))
    up = np.arctan2(ahead, down) + inner
    upper = se3.compose(level @ turn(1, -up), joint)
    lower = _jointed(upper, np.array([0.0, 0.0, -thigh]), -knee)
    ankle = lower[:, :3, 3] + lower[:, :3, :3] @ np.array([0.0, 0.0, -shin])
    toes_down = 3.0 * lift
    return upper, lower, se3.compose(level @ turn(1, toes_down), ankle)


def _step(walk: _Walk, side: int) -> tuple[F64, F64]:
    """How far ahead of the hip the ankle is, and how far above the floor (N,) m."""
    vigour = min_jerk(walk.speed / _WALKING)
    length = np.sqrt(WALK_RATIO * walk.speed) * vigour
    share = (walk.phase / (4 * np.pi) + (0.0 if side > 0 else 0.5)) % 1.0
    swing = min_jerk(2 * share - 1)
    ahead = length * np.where(share < 0.5, 0.5 - 2 * share, swing - 0.5)
    return ahead, _LIFT_M * vigour * np.where(share < 0.5, 0.0, np.sin(2 * np.pi * share) ** 2)


def _jointed(parent: F64, joint: F64, angle: F64) -> F64:
    """A limb (N, 4, 4) hung at `joint` (3,) m of its parent, turned ahead by `angle` (N,) rad."""
    R = parent[:, :3, :3] @ turn(1, -angle)
    return se3.compose(R, parent[:, :3, 3] + parent[:, :3, :3] @ joint)
