"""Direction of a person's gaze: ahead, at things or at others, with one smooth turn between targets.

A turn has the minimum-jerk profile, whose peak rate is 1.875 times the mean rate. The head turns at most 63
deg off the trunk, so targets to the side are followed less and less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.lab.emulate.motion.track import PlanarTrack, min_jerk
from share.types import F64

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
