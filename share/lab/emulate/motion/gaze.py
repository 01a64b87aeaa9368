"""Where a person looks: ahead, at things, at others; the head goes over in one smooth turn each time.

A turn has the minimum-jerk profile, whose peak rate is 1.875 times the mean one. The head turns at most
63 deg off the trunk: what one passes is followed less and less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.lab.emulate.motion.track import Track, min_jerk
from share.types import F64

_AHEAD_S = 0.35  # the head looks into a bend before the trunk gets there
_DOWN = 0.14  # rad, looking where one walks
_SIDE, _UP = 1.1, 0.6  # rad, how far the head turns off the trunk, and up or down
_PEAK = 1.875
_QUICKEST_S = 0.25
_SLOWER = 8  # times that a turn is made a quarter longer
_CLOSE_M = 0.7  # what is nearer than about this is not followed
_NEAR, _FAR = 1.0, 8.0  # m, between which things are looked at


@dataclass(frozen=True, eq=False)
class Seen:
    """Another agent as something to look at: xy (M, 2) m at the same instants; z m."""

    xy: F64
    z: float


def look(
    track: Track,
    eye: float,
    things: F64,
    others: Sequence[Seen],
    still_s: float,
    turns: float,
    rng: np.random.Generator,
) -> tuple[F64, F64]:
    """Yaw (M,) rad in the world and pitch (M,) rad, up positive, of the head. eye: m above the floor.
    things (K, 3) m. For `still_s` one looks ahead. turns: rad/s, of the quickest turn."""
    t = track.seconds
    yaw, pitch = _ahead(track)
    at, idle = still_s + rng.uniform(0.1, 0.5), True
    while at < t[-1]:
        target = _choose(track, eye, things, others, at, rng) if idle else None
        to_yaw, to_pitch = _ahead(track) if target is None else _towards(track, eye, *target)
        i = min(int(np.searchsorted(t, at)), len(t) - 1)
        far = np.hypot(to_yaw[i] - yaw[i], to_pitch[i] - pitch[i])
        took = max(_QUICKEST_S, _PEAK * far / (turns * rng.uniform(0.45, 0.9)))
        took, (yaw, pitch) = _go_over(
            t, at, took, np.stack([yaw, pitch]), np.stack([to_yaw, to_pitch]), turns
        )
        idle = target is None or rng.random() < 0.35
        at += took + rng.uniform(0.4, 1.9)
    return yaw, pitch


def _go_over(t: F64, at: float, took: float, old: F64, new: F64, turns: float) -> tuple[float, F64]:
    """Seconds it takes and yaw and pitch (2, M) of looking `old` until `at` s, then `new`: slower where
    both move apart meanwhile, so that the head never turns quicker than `turns` rad/s for it."""
    for _ in range(_SLOWER):
        both = old + min_jerk((t - at) / took) * (new - old)
        during = (t > at) & (t < at + took)
        rates = np.gradient(both[:, during], t[1], axis=1) if during.sum() > 2 else np.zeros((2, 1))
        if np.hypot(*rates).max() <= turns:
            break
        took *= 1.25
    return took, both


def _choose(
    track: Track, eye: float, things: F64, others: Sequence[Seen], at: float, rng: np.random.Generator
) -> tuple[F64, F64 | float] | None:
    """What to look at next: places (M, 2) or (1, 2) m and heights; None for ahead."""
    i = min(int(np.searchsorted(track.seconds, at)), len(track.seconds) - 1)
    sort = rng.random()
    if sort < 0.3:
        near = [o for o in others if _visible(track, i, o.xy[i])]
        if near:
            one = near[rng.integers(len(near))]
            return one.xy, one.z
    if sort < 0.85:
        near_things = [p for p in things if _visible(track, i, p[:2])]
        if near_things:
            p = near_things[rng.integers(len(near_things))]
            return p[None, :2], float(p[2])
    return None


def _visible(track: Track, i: int, xy: F64) -> bool:
    d = xy - track.xy[i]
    off = np.angle(np.exp(1j * (np.arctan2(d[1], d[0]) - track.heading[i])))
    return bool(_NEAR < np.linalg.norm(d) < _FAR and abs(off) < 1.3)


def _ahead(track: Track) -> tuple[F64, F64]:
    later = np.interp(track.seconds + _AHEAD_S, track.seconds, track.heading)
    return later, np.full(len(later), -_DOWN)


def _towards(track: Track, eye: float, xy: F64, z: F64 | float) -> tuple[F64, F64]:
    d = xy - track.xy
    near = np.linalg.norm(d, axis=1) / _CLOSE_M
    off = np.angle(np.exp(1j * (np.arctan2(d[:, 1], d[:, 0]) - track.heading)))
    # 0 straight behind, where left and right meet, and at what one walks over: nothing jumps there
    side = _SIDE * np.sin(off) * (1 - np.exp(-(near**2)))
    up = _UP * np.tanh(np.arctan2(z - eye, _CLOSE_M * np.hypot(near, 1)) / _UP)
    return track.heading + side, up
