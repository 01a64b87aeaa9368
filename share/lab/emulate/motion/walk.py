"""A person with a headset on: `walk:`.

    trunk on its way -> gait -> head on the neck, looking at things -> headset on the head

The body frame is the headset's IMU, with the axes of a D435i's: x right, y down, z ahead (like a camera's).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from share.geometry import se3
from share.lab.emulate.motion.floor import Floor
from share.lab.emulate.motion.gait import Gait, gait_of
from share.lab.emulate.motion.gaze import Seen, look
from share.lab.emulate.motion.route import Rng, Way, arc_length, headings, smooth
from share.lab.emulate.motion.schedule import Limits, smoothed
from share.lab.emulate.motion.spline import SplinePath, through
from share.lab.emulate.motion.track import Track, instants, wander
from share.types import F64

RADIUS = 0.30  # m, of a body, arms hanging
STILL_S = 1.3  # at the start, for the IMU
LEVER = np.array([0.10, 0.0, 0.12])  # m, from the top of the neck to the headset: ahead, left, up
CAMERA_AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # x right, y down, z ahead in (ahead, left, up)
_TRUNK_S = 0.25  # sigma: how slowly the trunk turns into a bend,
_TRUNK_RATE = 1.6  # rad/s, and how quickly at most


def limits(speed: float) -> Limits:
    """Of a person who likes to walk at `speed` m/s."""
    return Limits(speed=1.25 * speed, turn=1.5, aside=2.0, gain=1.2)


def way_of(floor: Floor, legs: Sequence[F64]) -> Way:
    """The smooth line that a person makes of the legs of a tour."""
    line = np.concatenate([legs[0], *(leg[1:] for leg in legs[1:])])
    xy = smooth(floor, line, RADIUS)
    gone, heading = arc_length(xy), headings(xy)
    return Way(xy, gone, heading, np.gradient(heading) / np.gradient(gone))


def track_of(way: Way, steps: F64, duration: float) -> Track:
    """The trunk's motion, for the places along the way of a schedule."""
    from scipy.ndimage import gaussian_filter1d

    seconds = instants(duration)
    gone = smoothed(steps, seconds)
    step = seconds[1]
    xy, heading = (_at(gone, way.gone, values) for values in (way.xy, np.unwrap(way.heading)[:, None]))
    turned = gaussian_filter1d(_followed(heading[:, 0], _TRUNK_RATE * step), _TRUNK_S / step, mode="nearest")
    return Track(seconds, xy, turned, np.gradient(gone, step))


def path_of(
    track: Track,
    height: float,
    turns: float,
    things: F64,
    others: Sequence[Seen],
    start_ns: int,
    rng: Rng,
) -> SplinePath:
    """The headset's motion. height: m, of the eyes. turns: rad/s, of the quickest turn of the head.
    things (K, 3) m and others: what there is to look at."""
    gait = gait_of(track, rng)
    yaw, pitch = look(track, height, things, others, STILL_S, turns, rng)
    R = _head(track.seconds, gait, yaw, pitch, rng)
    left = np.stack([-np.sin(track.heading), np.cos(track.heading)], axis=1)
    neck = np.column_stack([track.xy + gait.aside[:, None] * left, height - LEVER[2] + gait.up])
    return through(start_ns, track.seconds, neck + R @ LEVER, se3.quat_from_matrix(R @ CAMERA_AXES))


def _head(seconds: F64, gait: Gait, yaw: F64, pitch: F64, rng: Rng) -> F64:
    """Orientation (M, 3, 3) of the head (ahead, left, up): where one looks, the nods of the gait (the
    head pitches against the bob so that the eyes stay on their target; Hirasaki et al., Exp. Brain
    Res. 127, 1999), and what a head does at rest."""
    rest = 0.004 * np.stack([wander(rng, seconds, (1.5, 6.0), 5) for _ in range(3)])
    nod = 0.012 * gait.vigour * np.cos(gait.phase - 0.3)
    tilt = 0.010 * gait.vigour * np.sin(gait.phase / 2 + 0.4)
    swing = 0.018 * gait.vigour * np.cos(gait.phase / 2)
    return turn(2, yaw + swing + rest[0]) @ turn(1, -(pitch + nod + rest[1])) @ turn(0, tilt + rest[2])


def turn(axis: int, angle: F64) -> F64:
    """Rotations (M, 3, 3) about one axis."""
    phi = np.zeros((len(angle), 3))
    phi[:, axis] = angle
    return se3.so3_exp(phi)


def _followed(heading: F64, most: float) -> F64:
    """`heading` (M,) rad, followed by at most `most` rad from one instant to the next."""
    out = heading.tolist()
    for i in range(1, len(out)):
        out[i] = out[i - 1] + min(most, max(-most, out[i] - out[i - 1]))
    return np.array(out)


def _at(where: F64, gone: F64, values: F64) -> F64:
    """values (N, D) given at `gone` (N,), at `where` (M,), smoothly."""
    from scipy.interpolate import make_interp_spline

    out: F64 = make_interp_spline(gone, values, k=3)(where)
    return out
