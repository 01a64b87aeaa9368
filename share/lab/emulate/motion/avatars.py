"""Poses of the parts of an agent's body, derived from its path alone.

    path -> head (or base) -> trunk -> legs in step, feet on the floor

A person's steps are found in the bob of the head: the phase of its analytic signal (Gabor 1946) between 0.8
and 3 Hz, so that legs and head agree on recorded paths as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.lab.emulate.motion import body_shapes
from share.lab.emulate.motion.body_shapes import BODY_SHAPES
from share.lab.emulate.motion.gait import WALK_RATIO
from share.lab.emulate.motion.track import min_jerk
from share.lab.emulate.motion.walk import CAMERA_AXES, NECK_TO_HEADSET_M, axis_rotation
from share.lab.emulate.types import MotionPath
from share.lab.emulate.world.mesh import Shape
from share.types import F64, I64

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
    return float(np.clip(np.percentile(z, 90) / body_shapes.EYE, *_HEIGHT_RANGE_M))


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
    head = se3.from_rt(T[:, :3, :3], T[:, :3, 3] - body_shapes.HEADSET_M * T[:, :3, 0])
    walk = _TrunkMotion.from_avatar(avatar).interpolate((stamps - avatar.path.start_ns) / 1e9)
    hip = np.column_stack([walk.xy, np.minimum(body_shapes.HIP * height, head[:, 2, 3] - 0.36 * height)])
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
    shoulder = np.array([0.0, side * body_shapes.SHOULDERS * height, (body_shapes.SHOULDER - 0.02) * height])
    upper = _hang_limb(torso, shoulder, swing)
    bend = 0.25 + 0.5 * (swing.clip(0) + 0.2 * (walk.speed / 1.4).clip(0, 1))
    return upper, _hang_limb(upper, np.array([0.0, 0.0, -body_shapes.UPPER_ARM * height]), bend)


def _foot_position(walk: _TrunkMotion, side: int) -> F64:
    """Return how far ahead a side's foot is, -1 .. 1."""
    return side * np.cos(walk.phase / 2)


def _leg_poses(hip: F64, walk: _TrunkMotion, height: float, side: int) -> tuple[F64, F64, F64]:
    """Return poses of thigh, shin and foot: the foot stands while the body passes over it, then swings
    ahead."""
    thigh, shin = body_shapes.THIGH * height, body_shapes.SHIN * height
    level = axis_rotation(2, walk.heading)
    joint = hip + level @ np.array([0.0, side * body_shapes.HIPS * height, 0.0])
    ankle_x, lift = _ankle_motion(walk, side)
    ahead, down = ankle_x, joint[:, 2] - body_shapes.ANKLE * height - lift
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
