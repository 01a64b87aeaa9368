"""`walk:` is a person with a headset.

    track of the trunk -> gait -> head on the neck, looking at things -> headset on the head

The body frame is the headset's IMU, with the axes of a D435i: x right, y down, z ahead (like a camera's).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from share.geometry import se3
from share.lab.emulate.motion.floor import Floor
from share.lab.emulate.motion.gait import Gait, make_gait
from share.lab.emulate.motion.gaze import GazeAgent, head_directions
from share.lab.emulate.motion.route import Rng, Route, arc_length, headings, smooth_route
from share.lab.emulate.motion.schedule import MotionLimits, smooth_schedule
from share.lab.emulate.motion.spline import SplinePath, spline_through
from share.lab.emulate.motion.track import PlanarTrack, knot_times, random_wander
from share.types import F64

RADIUS = 0.30  # m, with arms hanging
INITIAL_STILL_S = 1.3  # at rest at the start, for IMU initialisation
NECK_TO_HEADSET_M = np.array([0.10, 0.0, 0.12])  # m, from the top of the neck to the headset: ahead, left, up
CAMERA_AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # x right, y down, z ahead in (ahead, left, up)
_TRUNK_SMOOTHING_S = 0.25  # sigma of the trunk's heading
_TRUNK_RATE = 1.6  # rad/s, of the trunk's heading at most


def motion_limits(speed: float) -> MotionLimits:
    """Return the limits of a person who walks at `speed` m/s."""
    return MotionLimits(
        max_speed=1.25 * speed, max_rotation_rate=1.5, lateral_acceleration=2.0, acceleration=1.2
    )


def route_from_legs(floor: Floor, legs: Sequence[F64]) -> Route:
    """Return the smooth line of a person through the legs of a tour."""
    line = np.concatenate([legs[0], *(leg[1:] for leg in legs[1:])])
    xy = smooth_route(floor, line, RADIUS)
    distances, heading = arc_length(xy), headings(xy)
    return Route(xy, distances, heading, np.gradient(heading) / np.gradient(distances))


def track_on_route(route: Route, steps: F64, duration: float) -> PlanarTrack:
    """Return the trunk's motion for a schedule along the route."""
    from scipy.ndimage import gaussian_filter1d

    seconds = knot_times(duration)
    distance = smooth_schedule(steps, seconds)
    step = seconds[1]
    xy, heading = (
        _interpolate(distance, route.distance, values)
        for values in (route.xy, np.unwrap(route.heading)[:, None])
    )
    turned = gaussian_filter1d(
        _rate_limited(heading[:, 0], _TRUNK_RATE * step), _TRUNK_SMOOTHING_S / step, mode="nearest"
    )
    return PlanarTrack(seconds, xy, turned, np.gradient(distance, step))


def headset_path(
    track: PlanarTrack,
    height: float,
    max_head_rate: float,
    gaze_targets: F64,
    others: Sequence[GazeAgent],
    start_ns: int,
    rng: Rng,
) -> SplinePath:
    """Return the headset's path. height: m, of the eyes. max_head_rate: rad/s. gaze_targets (K, 3) m and
    others: what to look at."""
    gait = make_gait(track, rng)
    yaw, pitch = head_directions(track, height, gaze_targets, others, INITIAL_STILL_S, max_head_rate, rng)
    R = _head_rotations(track.seconds, gait, yaw, pitch, rng)
    left = np.stack([-np.sin(track.heading), np.cos(track.heading)], axis=1)
    neck = np.column_stack(
        [track.xy + gait.sideways[:, None] * left, height - NECK_TO_HEADSET_M[2] + gait.up]
    )
    return spline_through(
        start_ns, track.seconds, neck + R @ NECK_TO_HEADSET_M, se3.quat_from_matrix(R @ CAMERA_AXES)
    )


def _head_rotations(seconds: F64, gait: Gait, yaw: F64, pitch: F64, rng: Rng) -> F64:
    """Return the orientation (M, 3, 3) of the head (ahead, left, up): gaze, nods of the gait (the head
    pitches against the bob so that the eyes stay on their target; Hirasaki et al., Exp. Brain Res. 127,
    1999), and sway at rest."""
    rest = 0.004 * np.stack([random_wander(rng, seconds, (1.5, 6.0), 5) for _ in range(3)])
    nod = 0.012 * gait.vigour * np.cos(gait.phase - 0.3)
    tilt = 0.010 * gait.vigour * np.sin(gait.phase / 2 + 0.4)
    swing = 0.018 * gait.vigour * np.cos(gait.phase / 2)
    return (
        axis_rotation(2, yaw + swing + rest[0])
        @ axis_rotation(1, -(pitch + nod + rest[1]))
        @ axis_rotation(0, tilt + rest[2])
    )


def axis_rotation(axis: int, angle: F64) -> F64:
    """Return rotations (M, 3, 3) about one axis."""
    phi = np.zeros((len(angle), 3))
    phi[:, axis] = angle
    return se3.so3_exp(phi)


def _rate_limited(heading: F64, max_step: float) -> F64:
    """Return `heading` (M,) rad limited to changes of `max_step` rad from one instant to the next."""
    out = heading.tolist()
    for i in range(1, len(out)):
        out[i] = out[i - 1] + min(max_step, max(-max_step, out[i] - out[i - 1]))
    return np.array(out)


def _interpolate(query: F64, distances: F64, values: F64) -> F64:
    """Return `values` (N, D), given at `distances` (N,), smoothly interpolated at `query` (M,)."""
    from scipy.interpolate import make_interp_spline

    out: F64 = make_interp_spline(distances, values, k=3)(query)
    return out
