"""`walk:` is a person with a headset.

    track of the trunk -> gait -> head on the neck, looking at things -> headset on the head

The body frame is the headset's IMU, with the axes of a D435i: x right, y down, z ahead (like a camera's).

* Step frequency: step length / step frequency is constant in free walking, the walk ratio of about
  0.0065 m per step/min = 0.39 m s (Sekiya & Nagasaki, Gait & Posture 7, 1998), so f = sqrt(v / 0.39).
* The centre of mass moves vertically by 2.7 cm at 0.7 m/s, 4.8 cm at 1.6 m/s, and to the sides by 7.0
  and 3.9 cm, peak to peak (Orendurff et al., J. Rehabil. Res. Dev. 41(6A), 2004).
* A heel strike reaches the head as a pulse of about 1.5 m/s^2 at 1.4 m/s, well below 20 Hz.
* The gaze is ahead, at things or at others, with one smooth turn between targets of minimum-jerk profile,
  whose peak rate is 1.875 times the mean rate. The head turns at most 63 deg off the trunk, so targets to the
  side are followed less and less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.lab.emulate.motion.route import Floor, Rng, Route, arc_length, headings, smooth_route
from share.lab.emulate.motion.schedule import MotionLimits, smooth_schedule
from share.lab.emulate.motion.spline import SplinePath, spline_through
from share.lab.emulate.motion.track import KNOT_S, PlanarTrack, knot_times, min_jerk, random_wander
from share.types import F64

# Gait: motion of the trunk in walking (bob, sway, heel strikes) and in standing.

WALK_RATIO = 0.39  # m s
_SPEEDS = (0.0, 0.7, 1.6, 2.2)  # m/s
_BOB_M = (0.012, 0.0274, 0.0483, 0.055)  # m, peak to peak
_SWAY_M = (0.05, 0.0699, 0.0385, 0.03)
_JOLT_M, _JOLT_S = 0.0006, 0.020  # at 1.4 m/s: 0.6 mm, sigma 20 ms: 1.5 m/s^2
_STANDING_M, _BREATH_M = 0.0025, 0.0012  # rms


@dataclass(frozen=True, eq=False)
class Gait:
    """phase (M,) rad, 2 pi a step, with a heel strike at each multiple; vigour (M,) 0 standing .. 1 walking;
    sideways, up (M,) m: of the trunk from its smooth track."""

    phase: F64
    vigour: F64
    sideways: F64
    up: F64


def make_gait(track: PlanarTrack, rng: np.random.Generator) -> Gait:
    """Return the gait of a body that moves along `track`."""
    v, t = track.speed, track.seconds
    phase, vigour = step_phase(v, rate=1 + 0.02 * random_wander(rng, t, (2.0, 6.0)))
    bob, sway = (np.interp(v, _SPEEDS, size) * vigour / 2 for size in (_BOB_M, _SWAY_M))
    quiet = _STANDING_M * random_wander(rng, t, (1.8, 9.0), 6)
    breath = _BREATH_M * random_wander(rng, t, (3.2, 4.4), 2)
    return Gait(
        phase=phase,
        vigour=vigour,
        sideways=sway * np.sin(phase / 2) + quiet,
        up=-bob * np.cos(phase) + breath - _heel_strikes(phase, v, t),
    )


def step_phase(speed: F64, rate: F64 | float = 1.0) -> tuple[F64, F64]:
    """Return phase (M,) rad and vigour (M,) of a body with `speed` (M,) m/s, every KNOT_S."""
    v = speed.clip(0)
    vigour = (v / 0.45).clip(0, 1)
    vigour = vigour**2 * (3 - 2 * vigour)
    turning = 2 * np.pi * np.sqrt(v / WALK_RATIO) * vigour * rate
    return np.concatenate([[0.0], np.cumsum((turning[1:] + turning[:-1]) / 2)]) * KNOT_S, vigour


def _heel_strikes(phase: F64, speed: F64, seconds: F64) -> F64:
    """Return displacement (M,) m by heel strikes: smooth pulses, slightly delayed."""
    out = np.zeros(len(seconds))
    reach = round(5 * _JOLT_S / KNOT_S)
    for i in np.flatnonzero(np.diff(np.floor(phase / (2 * np.pi))) > 0):
        middle = i + round(1.5 * _JOLT_S / KNOT_S)
        near = slice(max(0, middle - reach), middle + reach + 1)
        pulse = np.exp(-0.5 * ((seconds[near] - middle * KNOT_S) / _JOLT_S) ** 2)
        out[near] += _JOLT_M * min(speed[i] / 1.4, 1.3) * pulse
    return out


# Gaze: direction of the head.

_LOOK_AHEAD_S = 0.35  # the head max_rate into a bend before the trunk
_PITCH_DOWN = 0.14  # rad, when looking ahead
_MAX_SIDE, _MAX_UP = 1.1, 0.6  # rad, of the head relative to the trunk
_PEAK_RATE_RATIO = 1.875
_MIN_TURN_S = 0.25
_MAX_SLOWDOWNS = 8  # a turn is lengthened by a quarter at most this often
_MIN_FOLLOWED_M = 0.7  # nearer targets are not followed
_MIN_TARGET_M, _MAX_TARGET_M = 1.0, 8.0  # range of targets


@dataclass(frozen=True, eq=False)
class GazeAgent:
    """Another agent as a target: xy (M, 2) m at the instants of the track; z m."""

    xy: F64
    z: float


def head_directions(
    track: PlanarTrack,
    eye: float,
    gaze_targets: F64,
    others: Sequence[GazeAgent],
    still_s: float,
    max_rate: float,
    rng: np.random.Generator,
) -> tuple[F64, F64]:
    """Return yaw (M,) rad in the world and pitch (M,) rad, up positive, of the head. eye: m above the floor.
    gaze_targets (K, 3) m. The person looks ahead for the first `still_s`. max_rate: rad/s."""
    t = track.seconds
    yaw, pitch = _direction_ahead(track)
    time_s, idle = still_s + rng.uniform(0.1, 0.5), True
    while time_s < t[-1]:
        target = _choose_target(track, eye, gaze_targets, others, time_s, rng) if idle else None
        to_yaw, to_pitch = _direction_ahead(track) if target is None else _direction_to(track, eye, *target)
        i = min(int(np.searchsorted(t, time_s)), len(t) - 1)
        far = np.hypot(to_yaw[i] - yaw[i], to_pitch[i] - pitch[i])
        turn_s = max(_MIN_TURN_S, _PEAK_RATE_RATIO * far / (max_rate * rng.uniform(0.45, 0.9)))
        turn_s, (yaw, pitch) = _turn_head(
            t, time_s, turn_s, np.stack([yaw, pitch]), np.stack([to_yaw, to_pitch]), max_rate
        )
        idle = target is None or rng.random() < 0.35
        time_s += turn_s + rng.uniform(0.4, 1.9)
    return yaw, pitch


def _turn_head(
    t: F64, start_s: float, turn_s: float, old: F64, new: F64, max_rate: float
) -> tuple[float, F64]:
    """Return the duration (s) of a turn, and yaw and pitch (2, M) that follow `old` until `start_s`, then
    `new`. The turn is slowed down where both move apart meanwhile, so that the head keeps below `max_rate`
    rad/s."""
    for _ in range(_MAX_SLOWDOWNS):
        both = old + min_jerk((t - start_s) / turn_s) * (new - old)
        during = (t > start_s) & (t < start_s + turn_s)
        rates = np.gradient(both[:, during], t[1], axis=1) if during.sum() > 2 else np.zeros((2, 1))
        if np.hypot(*rates).max() <= max_rate:
            break
        turn_s *= 1.25
    return turn_s, both


def _choose_target(
    track: PlanarTrack,
    eye: float,
    gaze_targets: F64,
    others: Sequence[GazeAgent],
    time_s: float,
    rng: np.random.Generator,
) -> tuple[F64, F64 | float] | None:
    """Return the next target: places (M, 2) or (1, 2) m and heights; None for ahead."""
    i = min(int(np.searchsorted(track.seconds, time_s)), len(track.seconds) - 1)
    sort = rng.random()
    if sort < 0.3:
        near = [o for o in others if _is_visible(track, i, o.xy[i])]
        if near:
            one = near[rng.integers(len(near))]
            return one.xy, one.z
    if sort < 0.85:
        near_things = [p for p in gaze_targets if _is_visible(track, i, p[:2])]
        if near_things:
            p = near_things[rng.integers(len(near_things))]
            return p[None, :2], float(p[2])
    return None


def _is_visible(track: PlanarTrack, i: int, xy: F64) -> bool:
    d = xy - track.xy[i]
    off = np.angle(np.exp(1j * (np.arctan2(d[1], d[0]) - track.heading[i])))
    return bool(_MIN_TARGET_M < np.linalg.norm(d) < _MAX_TARGET_M and abs(off) < 1.3)


def _direction_ahead(track: PlanarTrack) -> tuple[F64, F64]:
    later = np.interp(track.seconds + _LOOK_AHEAD_S, track.seconds, track.heading)
    return later, np.full(len(later), -_PITCH_DOWN)


def _direction_to(track: PlanarTrack, eye: float, xy: F64, z: F64 | float) -> tuple[F64, F64]:
    d = xy - track.xy
    near = np.linalg.norm(d, axis=1) / _MIN_FOLLOWED_M
    off = np.angle(np.exp(1j * (np.arctan2(d[:, 1], d[:, 0]) - track.heading)))
    # 0 straight behind, where left and right meet, and at targets underfoot, so that the gaze never jumps
    side = _MAX_SIDE * np.sin(off) * (1 - np.exp(-(near**2)))
    up = _MAX_UP * np.tanh(np.arctan2(z - eye, _MIN_FOLLOWED_M * np.hypot(near, 1)) / _MAX_UP)
    return track.heading + side, up


# The path of the headset.

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
