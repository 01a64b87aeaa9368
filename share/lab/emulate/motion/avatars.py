"""Bodies of agents as others see them: their rigid parts, and poses of these derived from the path alone.

    path -> head (or base) -> trunk -> legs in step, feet on the floor

Each part has a frame of its own: x ahead, y left, z up, its origin where it hangs (a limb's upper joint, the
middle of the hips, the middle of the head; the floor under a robot; the middle of a drone). A person is made
for a height of 1 m and scaled: segment lengths by Drillis & Contini (1966), as in Winter, *Biomechanics and
Motor Control of Human Movement*. Its steps are found in the bob of the head: the phase of its analytic signal
(Gabor 1946) between 0.8 and 3 Hz, so that legs and head agree on recorded paths as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.lab.emulate.motion.track import min_jerk
from share.lab.emulate.motion.walk import CAMERA_AXES, NECK_TO_HEADSET_M, WALK_RATIO, axis_rotation
from share.lab.emulate.types import MotionPath
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Shape, box, concat_shapes, cylinder, prism
from share.types import F64, I64

Rng = np.random.Generator

THIGH, SHIN, ANKLE, HIP = 0.245, 0.246, 0.039, 0.53  # lengths, and height of the hip, over the body's height
UPPER_ARM, FOREARM, SHOULDER = 0.186, 0.200, 0.285  # the shoulder over the hip
SHOULDERS, HIPS = 0.110, 0.055  # half widths
EYE = 0.936  # height of the eyes
HEADSET_M = 0.10  # from the middle of the head to the headset's IMU


def person(rng: Rng, height: float) -> tuple[Shape, ...]:
    """Return head, torso, upper arms, forearms, thighs, shins, feet; the left one of each pair first. height:
    m."""
    h = height
    skin = Material("skin", gray=float(rng.uniform(90, 175)))
    shirt, trousers = (
        Material("fabric", int(rng.integers(1000)), float(rng.uniform(*gray)), contrast=1.4, metres=0.5)
        for gray in ((70, 190), (45, 110))
    )
    shoes = Material("rubber", int(rng.integers(1000)))
    arm = [_limb(UPPER_ARM * h, 0.050, 0.040, shirt, rng) for _ in range(2)]
    fore = [
        concat_shapes(_limb(FOREARM * h, 0.040, 0.030, skin, rng), _hand(FOREARM * h, skin)) for _ in range(2)
    ]
    thigh = [_limb(THIGH * h, 0.082, 0.060, trousers, rng) for _ in range(2)]
    shin = [_limb(SHIN * h, 0.060, 0.045, trousers, rng) for _ in range(2)]
    foot = [box((-0.07, -0.045, -ANKLE * h), (0.19, 0.045, 0.02), shoes, rng) for _ in range(2)]
    return (_head(skin, rng), _torso(h, shirt, trousers, rng), *arm, *fore, *thigh, *shin, *foot)


def robot(rng: Rng, height: float) -> tuple[Shape, ...]:
    """Return a body like a TurtleBot 4: a round base of 34 cm, a plate above it, a mast with a camera at
    `height` m."""
    dark = Material("plastic", int(rng.integers(1000)), gray=60, contrast=1.2)
    light = Material("plastic", int(rng.integers(1000)), gray=170)
    metal = Material("galvanised", int(rng.integers(1000)))
    label = Material("label", int(rng.integers(1000)))
    top = height - 0.03
    posts = [
        cylinder((x, y, 0.09), 0.008, 0.11, metal, axis="z", sides=8)
        for x in (-0.1, 0.1)
        for y in (-0.1, 0.1)
    ]
    return (
        concat_shapes(
            cylinder((0, 0, 0.015), 0.170, 0.075, dark, dark, sides=24, rng=rng),
            cylinder((0, 0, 0.090), 0.150, 0.012, light, light, sides=24, rng=rng),
            *posts,
            cylinder((0, 0, 0.195), 0.160, 0.008, light, light, sides=24, rng=rng),
            box((-0.06, -0.06, 0.105), (0.06, 0.06, 0.165), {"all": dark, "side": label}, rng),
            box((-0.10, -0.015, 0.203), (-0.07, 0.015, top), metal, rng),
            box((-0.10, -0.012, top - 0.02), (0.0, 0.012, top), metal, rng),
            box(
                (-0.015, -0.045, top),
                (0.010, 0.045, top + 0.05),
                {"all": metal, "+x": Material("screen")},
                rng,
            ),
            cylinder((0.06, 0, 0.203), 0.035, 0.04, dark, dark, sides=16, rng=rng),
        ),
    )


def drone(rng: Rng, height: float) -> tuple[Shape, ...]:
    """Return a small multicopter; its rotors are discs. height: unused."""
    dark = Material("plastic", int(rng.integers(1000)), gray=50)
    metal = Material("steel", int(rng.integers(1000)))
    parts = [
        box((-0.10, -0.06, -0.03), (0.10, 0.06, 0.04), {"all": dark, "side": Material("label")}, rng),
        box((0.10, -0.07, -0.02), (0.12, 0.07, 0.01), dark, rng),
    ]
    for k in range(6):
        a = np.pi / 6 + k * np.pi / 3
        arm = box((0.05, -0.012, 0.0), (0.25, 0.012, 0.018), metal, rng)
        rotor = cylinder((0.25, 0, 0.035), 0.095, 0.004, dark, dark, sides=16, rng=rng)
        parts += [part.placed_at(0, 0, 0, a) for part in (arm, rotor)]
    legs = [cylinder((x, y, -0.14), 0.006, 0.12, dark, sides=6) for x in (-0.07, 0.07) for y in (-0.06, 0.06)]
    return (concat_shapes(*parts + legs),)


BODY_SHAPES: dict[str, Callable[[Rng, float], tuple[Shape, ...]]] = {
    "person": person,
    "robot": robot,
    "drone": drone,
}


def _limb(length: float, upper: float, lower: float, skin: Material, rng: Rng) -> Shape:
    """Return a limb that hangs down from its joint."""
    round_end = cylinder((0, 0, -0.01), upper, 0.03, skin, skin, sides=10, rng=rng, top=0.6 * upper)
    return concat_shapes(
        cylinder((0, 0, -length), lower, length, skin, skin, sides=10, rng=rng, top=upper), round_end
    )


def _hand(forearm: float, skin: Material) -> Shape:
    return box((-0.03, -0.014, -forearm - 0.10), (0.035, 0.014, -forearm), skin)


def _torso(h: float, shirt: Material, trousers: Material, rng: Rng) -> Shape:
    """Return the torso from the hips up: slices of elliptic outline (half depth, half width, low, high in
    m)."""
    up = SHOULDER * h
    slices = [
        (0.115, 0.165, -0.08, 0.06, trousers),
        (0.105, 0.150, 0.06, 0.45 * up, shirt),
        (0.115, 0.165, 0.45 * up, 0.75 * up, shirt),
        (0.115, 0.180, 0.75 * up, up, shirt),
        (0.085, 0.120, up, up + 0.035, shirt),
        (0.050, 0.052, up + 0.035, up + 0.12, Material("skin")),
    ]
    angle = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    rings = [(np.column_stack([d * np.cos(angle), w * np.sin(angle)]), a, b, m) for d, w, a, b, m in slices]
    return concat_shapes(*[prism(ring, low, high, m, m, rng) for ring, low, high, m in rings])


def _head(skin: Material, rng: Rng) -> Shape:
    """Return a rounded head with hair and a headset before the eyes."""
    hair = Material("carpet", int(rng.integers(1000)), gray=float(rng.uniform(35, 120)))
    shell = Material("plastic", int(rng.integers(1000)), gray=45)
    levels = [(-0.12, 0.050), (-0.09, 0.072), (-0.03, 0.086), (0.04, 0.090), (0.09, 0.070), (0.12, 0.030)]
    parts = [
        cylinder((0, 0, low), r, high - low, skin if high < 0.05 else hair, None, sides=14, rng=rng, top=r2)
        for (low, r), (high, r2) in pairwise(levels)
    ]
    parts.append(cylinder((0, 0, 0.12), 0.030, 0.003, hair, hair, sides=14, rng=rng))
    goggles = box(
        (0.055, -0.085, -0.03), (0.125, 0.085, 0.045), {"all": shell, "+x": Material("screen")}, rng
    )
    camera = box((0.105, -0.045, 0.05), (0.130, 0.045, 0.075), Material("galvanised"), rng)
    strap = cylinder((0, 0, 0.0), 0.093, 0.03, shell, None, sides=14, rng=rng)
    return concat_shapes(*parts, goggles, camera, strap)


# Poses of the parts.

_RATE_HZ = 50
_TRUNK_SMOOTHING_S = 0.35  # sigma
_GAZE_WEIGHT = 0.35  # m/s; the trunk faces the direction of motion above this speed, the gaze below
_STEP_HZ = (0.8, 3.0)
_WALKING_SPEED = 0.45  # m/s, full gait from here on
_FOOT_LIFT_M = 0.11
_ARM_SWING_RAD = 0.55  # rad of swing at 1.4 m/s
_HEIGHT_RANGE_M = (1.3, 2.05)  # of a person


def avatar_shapes(body_kind: str, path: MotionPath, seed: tuple[int, ...]) -> tuple[Shape, ...]:
    """Return the parts of a `person`, `robot` or `drone`, each in its own frame."""
    return BODY_SHAPES[body_kind](np.random.default_rng(seed), body_height(body_kind, path))


def body_height(body_kind: str, path: MotionPath) -> float:
    """Return the height (m) of a person, from the height of the head, or of a robot's camera."""
    z = path.poses(_sample_stamps(path))[:, 2, 3]
    if body_kind != "person":
        return float(np.median(z))
    return float(np.clip(np.percentile(z, 90) / EYE, *_HEIGHT_RANGE_M))


def _sample_stamps(path: MotionPath) -> I64:
    """Return stamps (200,) spread over a path; integers, since float64 does not hold them."""
    return path.start_ns + np.linspace(0, path.end_ns - path.start_ns, 200).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Avatar:
    """The body of one agent along its path. T_body_cam0 (4, 4): the camera's pose on the body, which gives
    its viewing direction; None where the body has camera axes, as simulated bodies have."""

    body_kind: str
    path: MotionPath
    T_body_cam0: F64 | None = None

    def part_poses(self, stamps_ns: I64) -> F64:
        """Return T_world_part (N, P, 4, 4), in the order of `avatar_shapes`. Raises ValueError outside the
        path's span."""
        return _PART_FUNCTIONS[self.body_kind](self, np.asarray(stamps_ns, np.int64))

    def facing_poses(self, stamps_ns: I64) -> F64:
        """Return (N, 4, 4): the body's position, with the axes ahead, left, up of its camera."""
        T = self.path.poses(stamps_ns)
        mount = np.eye(3) if self.T_body_cam0 is None else self.T_body_cam0[:3, :3]
        return se3.from_rt(T[:, :3, :3] @ mount @ CAMERA_AXES.T, T[:, :3, 3])


def _robot_parts(avatar: Avatar, stamps: I64) -> F64:
    T = avatar.facing_poses(stamps)
    R = axis_rotation(2, np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    return se3.from_rt(R, T[:, :3, 3] * (1, 1, 0))[:, None]


def _drone_parts(avatar: Avatar, stamps: I64) -> F64:
    """Return T_world_part (N, 1, 4, 4): upright on average, tilted as the body tilts."""
    up = avatar.facing_poses(_sample_stamps(avatar.path))[:, 2, :3].mean(0)
    up /= np.linalg.norm(up)
    ahead = np.cross((0.0, 1.0, 0.0), up)
    ahead /= np.linalg.norm(ahead)
    R = np.stack([ahead, np.cross(up, ahead), up], axis=1)
    T = avatar.facing_poses(stamps)
    return se3.from_rt(T[:, :3, :3] @ R, T[:, :3, 3])[:, None]


def _person_parts(avatar: Avatar, stamps: I64) -> F64:
    height = body_height("person", avatar.path)
    T = avatar.facing_poses(stamps)
    head = se3.from_rt(T[:, :3, :3], T[:, :3, 3] - HEADSET_M * T[:, :3, 0])
    walk = _TrunkMotion.from_avatar(avatar).interpolate((stamps - avatar.path.start_ns) / 1e9)
    hip = np.column_stack([walk.xy, np.minimum(HIP * height, head[:, 2, 3] - 0.36 * height)])
    trunk = _trunk_rotations(hip, head[:, :3, 3] - (0, 0, 0.13), walk.heading)
    torso = se3.from_rt(trunk, hip)
    arms = [_arm_poses(torso, walk, height, side) for side in (1, -1)]
    legs = [_leg_poses(hip, walk, height, side) for side in (1, -1)]
    order = [
        head,
        torso,
        *(arm[k] for k in range(2) for arm in arms),
        *(leg[k] for k in range(3) for leg in legs),
    ]
    return np.stack(order, axis=1)


_PART_FUNCTIONS = {"person": _person_parts, "robot": _robot_parts, "drone": _drone_parts}


@dataclass(frozen=True, eq=False)
class _TrunkMotion:
    """Motion of the trunk: xy (N, 2) m, heading (N,) rad, speed (N,) m/s, phase (N,) rad of a step."""

    seconds: F64
    xy: F64
    heading: F64
    speed: F64
    phase: F64

    @staticmethod
    def from_avatar(avatar: Avatar) -> _TrunkMotion:
        from scipy.ndimage import gaussian_filter1d

        span = (avatar.path.end_ns - avatar.path.start_ns) / 1e9
        seconds = np.arange(int(span * _RATE_HZ) + 1) / _RATE_HZ
        T = avatar.facing_poses(avatar.path.start_ns + np.round(seconds * 1e9).astype(np.int64))
        neck = T[:, :3, 3] - T[:, :3, :3] @ NECK_TO_HEADSET_M
        sigma = _TRUNK_SMOOTHING_S * _RATE_HZ
        xy = gaussian_filter1d(neck[:, :2], sigma, axis=0, mode="nearest")
        v = np.gradient(xy, 1 / _RATE_HZ, axis=0)
        gaze = T[:, :2, 0] / np.maximum(np.linalg.norm(T[:, :2, 0], axis=1, keepdims=True), 0.2)
        facing = gaussian_filter1d(v + _GAZE_WEIGHT * gaze, sigma, axis=0, mode="nearest")
        phase = np.unwrap(np.angle(-_analytic_step_signal(neck[:, 2])))
        heading = np.unwrap(np.arctan2(facing[:, 1], facing[:, 0]))
        return _TrunkMotion(seconds, xy, heading, np.linalg.norm(v, axis=1), phase)

    def interpolate(self, seconds: F64) -> _TrunkMotion:
        xy, *rest = (
            np.stack([np.interp(seconds, self.seconds, column) for column in np.atleast_2d(values.T)], axis=1)
            for values in (self.xy, self.heading, self.speed, self.phase)
        )
        return _TrunkMotion(seconds, xy, *(r[:, 0] for r in rest))


def _analytic_step_signal(z: F64) -> NDArray[np.complex128]:
    """Return the analytic signal (no negative frequencies) of z (N,), band-passed to step frequencies."""
    spectrum = np.fft.rfft(z - z.mean())
    hz = np.fft.rfftfreq(len(z), 1 / _RATE_HZ)
    spectrum[(hz < _STEP_HZ[0]) | (hz > _STEP_HZ[1])] = 0
    return np.fft.ifft(2 * spectrum, len(z))


def _trunk_rotations(hip: F64, neck: F64, heading: F64) -> F64:
    """Return rotations (N, 3, 3) of a trunk that faces `heading` and reaches from hip to neck (N, 3) m."""
    up = neck - hip
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    left = np.cross(up, np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1))
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([np.cross(left, up), left, up], axis=2)


def _arm_poses(torso: F64, walk: _TrunkMotion, height: float, side: int) -> tuple[F64, F64]:
    """Return poses of upper arm and forearm; an arm swings with the opposite leg."""
    swing = _ARM_SWING_RAD * (walk.speed / 1.4).clip(0, 1.3) * _foot_position(walk, -side)
    shoulder = np.array([0.0, side * SHOULDERS * height, (SHOULDER - 0.02) * height])
    upper = _hang_limb(torso, shoulder, swing)
    bend = 0.25 + 0.5 * (swing.clip(0) + 0.2 * (walk.speed / 1.4).clip(0, 1))
    return upper, _hang_limb(upper, np.array([0.0, 0.0, -UPPER_ARM * height]), bend)


def _foot_position(walk: _TrunkMotion, side: int) -> F64:
    """Return how far ahead a side's foot is, -1 .. 1."""
    return side * np.cos(walk.phase / 2)


def _leg_poses(hip: F64, walk: _TrunkMotion, height: float, side: int) -> tuple[F64, F64, F64]:
    """Return poses of thigh, shin and foot: the foot stands while the body passes over it, then swings
    ahead."""
    thigh, shin = THIGH * height, SHIN * height
    level = axis_rotation(2, walk.heading)
    joint = hip + level @ np.array([0.0, side * HIPS * height, 0.0])
    ankle_x, lift = _ankle_motion(walk, side)
    ahead, down = ankle_x, joint[:, 2] - ANKLE * height - lift
    reach = np.hypot(ahead, down).clip(0.2, 0.999 * (thigh + shin))
    knee = np.pi - np.arccos(((thigh**2 + shin**2 - reach**2) / (2 * thigh * shin)).clip(-1, 1))
    inner = np.arccos(((thigh**2 + reach**2 - shin**2) / (2 * thigh * reach)).clip(-1, 1))
    up = np.arctan2(ahead, down) + inner
    upper = se3.from_rt(level @ axis_rotation(1, -up), joint)
    lower = _hang_limb(upper, np.array([0.0, 0.0, -thigh]), -knee)
    ankle = lower[:, :3, 3] + lower[:, :3, :3] @ np.array([0.0, 0.0, -shin])
    toes_down = 3.0 * lift
    return upper, lower, se3.from_rt(level @ axis_rotation(1, toes_down), ankle)


def _ankle_motion(walk: _TrunkMotion, side: int) -> tuple[F64, F64]:
    """Return how far the ankle is ahead of the hip and above the floor, (N,) m each."""
    vigour = min_jerk(walk.speed / _WALKING_SPEED)
    length = np.sqrt(WALK_RATIO * walk.speed) * vigour
    share = (walk.phase / (4 * np.pi) + (0.0 if side > 0 else 0.5)) % 1.0
    swing = min_jerk(2 * share - 1)
    ahead = length * np.where(share < 0.5, 0.5 - 2 * share, swing - 0.5)
    return ahead, _FOOT_LIFT_M * vigour * np.where(share < 0.5, 0.0, np.sin(2 * np.pi * share) ** 2)


def _hang_limb(parent: F64, joint: F64, angle: F64) -> F64:
    """Return the pose (N, 4, 4) of a limb hung at `joint` (3,) m of its parent, pitched ahead by `angle` (N,)
    rad."""
    R = parent[:, :3, :3] @ axis_rotation(1, -angle)
    return se3.from_rt(R, parent[:, :3, 3] + parent[:, :3, :3] @ joint)
