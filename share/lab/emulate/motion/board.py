"""`board:` moves a device before a calibration board, as people do for Kalibr.

Six independent band-limited signals: position around the board (azimuth, elevation, distance), place of the
board in the image (two), and roll. So all six axes are excited and the board visits the whole image; its
apparent size limits how far it may go from the image's middle. The body frame has camera axes: x right, y
down, z ahead.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from share.errors import UsageError
from share.geometry import se3
from share.lab.emulate.motion.spec import BoardSpec
from share.lab.emulate.motion.spline import SplinePath, spline_through
from share.lab.emulate.motion.track import knot_times
from share.lab.emulate.motion.walk import axis_rotation
from share.lab.emulate.types import START_NS
from share.lab.emulate.world.layout import Layout, PlacedTarget
from share.types import F64

INITIAL_STILL_S = 1.5  # at rest at the start, for IMU initialisation
_START_EASE_S = 2.0  # from rest to full speed
_PAUSE_VIGOUR = 0.5  # below this vigour, the device comes to rest every _PAUSE_S
_PAUSE_S = 3.0
_PERIODS = (1.2, 4.5)  # s, shortest and longest, at vigour 1
_WAVES = 5
# periods of arm motions (first three) against wrist motions
_PERIOD_FACTORS = np.array([1.8, 1.8, 1.8, 1.0, 1.0, 1.0])
_DISTANCE_FACTOR = 1.8  # distance varies by this factor both ways
_MAX_AZIMUTH, _MAX_ELEVATION, _MAX_ROLL = np.radians((38.0, 30.0, 38.0))  # to either side
_VIEW_TANGENTS = np.array([0.80, 0.53])  # tangents from the middle of the image to its edges, D435i and EuRoC
_CAMERA_OFFSET_M = 0.06  # largest distance of a camera from the body
_MAX_OVERSHOOT = 1.1  # the board may leave the image by this factor
_WALL_CLEARANCE_M = 0.15  # least distance of the device from walls


def board_path(layout: Layout, spec: BoardSpec, seconds: float, rng: np.random.Generator) -> SplinePath:
    """Return the body's path before the room's board. Deterministic for a given `rng`. Raises UsageError
    where the room has no board or no space for the motion."""
    if layout.target is None:
        raise UsageError(f"the {layout.name} has no calibration board; use --scene board")
    t = knot_times(seconds)
    T = layout.target.T_world_target @ _target_poses(layout.target, spec, t, rng)
    if (T[:, :3, 3] < _WALL_CLEARANCE_M).any() or (
        T[:, :3, 3] > np.array(layout.size) - _WALL_CLEARANCE_M
    ).any():
        raise UsageError(
            f"board: the room is too small for distance={spec.distance:g}; use less, or a larger --size"
        )
    path = spline_through(START_NS, t, T[:, :3, 3], se3.quat_from_matrix(T[:, :3, :3]))
    return replace(path, end_ns=START_NS + round(seconds * 1e9))


def _target_poses(target: PlacedTarget, spec: BoardSpec, t: F64, rng: np.random.Generator) -> F64:
    """Return T_target_body (M, 4, 4) at t (M,) s."""
    around, above, along, across, down, roll = _motion_signals(_exercise_progress(t, spec.vigour), rng)
    distance = spec.distance * _DISTANCE_FACTOR**along
    half = np.ptp(target.target.extent, axis=0) / 2
    aim = np.stack([across, down]) * _aim_limits(half, distance, _MAX_ROLL * roll)
    R, p = _looking_pose(_MAX_AZIMUTH * around, _MAX_ELEVATION * above, distance, aim, _MAX_ROLL * roll)
    return se3.from_rt(R, p + np.array([*target.target.extent.mean(axis=0), 0.0]))


def _exercise_progress(t: F64, vigour: float) -> F64:
    """Return the progress (M,) of the exercise at t (M,), in seconds of one with vigour 1."""
    x = ((t - INITIAL_STILL_S) / _START_EASE_S).clip(0, 1)
    speed = vigour * x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3)  # smooth to the third derivative
    if vigour < _PAUSE_VIGOUR:
        speed = speed * (1 - np.cos(2 * np.pi * (t - INITIAL_STILL_S) / _PAUSE_S)) ** 2 * (2 / 3)
    return np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(t))])


def _motion_signals(progress: F64, rng: np.random.Generator) -> F64:
    """Return six signals (6, M) in -1 .. 1, distributed about uniformly. All their waves have the same peak
    rate, so slow ones are larger."""
    from scipy.special import erf

    periods = np.geomspace(*_PERIODS, _WAVES) * _PERIOD_FACTORS[:, None] * rng.uniform(0.9, 1.1, (6, _WAVES))
    phase = rng.uniform(0, 2 * np.pi, (6, _WAVES))
    waves = np.sin(2 * np.pi * progress[:, None, None] / periods + phase)
    normal = np.einsum("mkw,kw->km", waves, periods) / np.linalg.norm(periods, axis=1)[:, None]
    out: F64 = erf(normal)
    return out


def _aim_limits(half: F64, distance: F64, roll: F64) -> F64:
    """Return how far (2, M) the middle of a board of half-size (2,) m may be from the middle of the image, as
    tangents: what its size leaves, smoothly positive."""
    c, s = np.cos(roll), np.sqrt(np.sin(roll) ** 2 + 1e-2)  # smooth |sin|
    size = (half[:, None] * c + half[::-1, None] * s) / distance
    margin = (
        _MAX_OVERSHOOT * _VIEW_TANGENTS[:, None] - size - np.array([[_CAMERA_OFFSET_M], [0.0]]) / distance
    )
    room: F64 = (margin + np.sqrt(margin**2 + 0.05**2)) / 2
    return room


def _looking_pose(around: F64, above: F64, distance: F64, aim: F64, roll: F64) -> tuple[F64, F64]:
    """Return orientation (M, 3, 3) and position (M, 3) m of the body in a frame at the board's middle. aim
    (2, M): where the image shows the middle, tangents."""
    facing = np.array([(1.0, 0, 0), (0, -1, 0), (0, 0, -1)])  # looks at the board from before its middle
    orbit = axis_rotation(1, around) @ axis_rotation(0, -above)
    aside = axis_rotation(0, np.arctan(aim[1])) @ axis_rotation(1, -np.arctan(aim[0]))
    return orbit @ facing @ axis_rotation(2, roll) @ aside, orbit[:, :, 2] * distance[:, None]
