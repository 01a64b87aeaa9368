"""Smooth paths of a camera through the room: people who walk and look around, a robot that drives.

All go round the middle of the room in loops that are never quite the same, and start on its south side
looking east: what one has seen, the others will see from not too far off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry.se3 import compose, so3_exp
from share.types import F64

_STILL_S, _RAMP_S = 0.5, 1.0  # stands, then gathers speed
_MARGIN = 1.3  # m between the walls and the widest loop
_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # camera axes in (ahead, left, up)


@dataclass(frozen=True)
class Style:
    """How one moves. loop: half axes as shares of the free half room. look: amplitudes of turning the
    head, (yaw, pitch, roll) rad. step_m: how far the body bobs up and down."""

    speed: float  # m/s
    height: float  # m, of the camera
    pitch: float  # rad, mean; up is positive
    loop: tuple[float, float]
    start: float  # rad, place on the loop; -pi/2 is south
    look: tuple[float, float, float] = (0.0, 0.0, 0.0)
    step_m: float = 0.0


STYLES = {
    "walker": Style(0.65, 1.68, -0.12, (0.70, 0.92), -1.75, (0.40, 0.10, 0.03), 0.020),
    "stroller": Style(0.55, 1.62, -0.12, (0.58, 0.80), -1.45, (0.40, 0.10, 0.03), 0.018),
    "robot": Style(0.30, 0.35, 0.20, (0.42, 0.66), -1.70),
}


def move(style: Style, size: F64, seconds: F64, seed: tuple[int, ...]) -> F64:
    """T_world_cam (N, 4, 4) at `seconds` (N,) from the start, in a room of `size` (3,) m."""
    rng = np.random.default_rng(seed)
    gone, pace = _distance(seconds, style.speed, rng)
    xy, heading = _loop(style, size, gone, rng)
    step = 2 * np.pi * gone / 0.7  # rad; one step is 0.7 m
    bob = style.step_m * pace * np.stack([0.7 * np.sin(step / 2), np.sin(step)])
    yaw, pitch, roll = (_wander(rng, seconds, amplitude) for amplitude in style.look)
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    position = np.column_stack([xy + bob[0, :, None] * left, style.height + bob[1]])
    R = _turn(2, heading + yaw) @ _turn(1, -(style.pitch + pitch)) @ _turn(0, roll)
    return compose(R @ _FORWARD, position)


def _distance(seconds: F64, speed: float, rng: np.random.Generator) -> tuple[F64, F64]:
    """Metres gone since the start, and the speed as a share of `speed`."""
    fine = np.arange(0, seconds[-1] + 0.02, 0.01)
    ramp = ((fine - _STILL_S) / _RAMP_S).clip(0, 1)
    pace = ramp**2 * (3 - 2 * ramp) * (1 + _wander(rng, fine, 0.12))
    gone = np.concatenate([[0], np.cumsum((pace[1:] + pace[:-1]) / 2 * 0.01)]) * speed
    return np.interp(seconds, fine, gone), np.interp(seconds, fine, pace)


def _loop(style: Style, size: F64, gone: F64, rng: np.random.Generator) -> tuple[F64, F64]:
    """Positions (N, 2) m and headings (N,) rad after `gone` (N,) metres along an ellipse whose radius
    slowly changes."""
    a, b = np.array(style.loop) * (size[:2] / 2 - _MARGIN)
    laps = gone[-1] / (2 * np.pi * min(a, b) * 0.85) + 0.1
    angle = np.arange(0, 2 * np.pi * laps, 1e-3)
    phases = rng.uniform(0, 2 * np.pi, 2)
    radius = 1 + 0.05 * np.sin(0.61 * angle + phases[0]) + 0.03 * np.sin(1.7 * angle + phases[1])
    along = angle + style.start + rng.uniform(-0.1, 0.1)
    xy = size[:2] / 2 + radius[:, None] * np.column_stack([a * np.cos(along), b * np.sin(along)])
    tangent = np.gradient(xy, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    x, y, yaw = (np.interp(gone, length, values) for values in (*xy.T, heading))
    return np.column_stack([x, y]), yaw


def _wander(rng: np.random.Generator, seconds: F64, amplitude: float) -> F64:
    """A slow wave that does not repeat, at most `amplitude`."""
    periods, phases = rng.uniform([5.0, 8.0], [8.0, 13.0]), rng.uniform(0, 2 * np.pi, 2)
    waves: F64 = np.sin(2 * np.pi * seconds[:, None] / periods + phases) @ [0.5, 0.5]
    return amplitude * waves


def _turn(axis: int, radians: F64) -> F64:
    phi = np.zeros((*radians.shape, 3))
    phi[..., axis] = radians
    return so3_exp(phi)
