"""Several simulated agents at once: tracks that keep apart, then bodies that look about and at each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from share.errors import UsageError
from share.lab.emulate.motion import robot, walk
from share.lab.emulate.motion.gaze import Seen
from share.lab.emulate.motion.schedule import Other
from share.lab.emulate.motion.spline import SplinePath
from share.lab.emulate.motion.together import PEOPLE_M, ROBOT_M, Course, Ground, Wish, move, nearest, obstacle
from share.lab.emulate.motion.track import Track, instants
from share.lab.emulate.types import START_NS, Path
from share.types import F64

_ATTEMPTS = 60
_ROUNDS = 6  # of bringing lengths to what they shall be
_BETTER = 0.7  # times what a length was off by; otherwise another attempt is worth more
_LENGTH = 0.010  # relative; the paper's are asked to 2 %
_COUNT_S = 1 / 30  # a length is that of the line through poses at 30 Hz


@dataclass(frozen=True)
class Member:
    """One simulated agent. height: m, of eyes or camera. turns: rad/s, of a person's quickest turn of the
    head. vibration: m/s^2, of a robot. length: m of the body's path at 30 Hz, None for any."""

    name: str
    wish: Wish
    height: float
    turns: float = 2.6
    vibration: float = 0.4
    length: float | None = None


@dataclass(frozen=True, eq=False)
class Present:
    """One whose path is settled already. xyz (M, 3) m every KNOT_S of its own time from its start;
    distance: m that others keep from it."""

    xyz: F64
    distance: float


def crowd(
    ground: Ground,
    members: Sequence[Member],
    present: Sequence[Present],
    things: F64,
    duration: float,
    seed: tuple[int, ...],
) -> list[SplinePath]:
    """Paths of `duration` s, in the members' order. things (K, 3) m: what there is to look at. Raises
    UsageError where no attempt finds room for all."""
    for attempt in range(_ATTEMPTS):
        paths = _attempt(ground, members, present, things, duration, (*seed, attempt))
        if paths is not None:
            return paths
    names = ", ".join(m.name for m in members)
    raise UsageError(
        f"{names}: found no paths that keep people {PEOPLE_M} m and robots {ROBOT_M} m apart in this room; "
        "take fewer agents, lower speeds, a larger --size or another --seed"
    )


def _attempt(
    ground: Ground,
    members: Sequence[Member],
    present: Sequence[Present],
    things: F64,
    duration: float,
    seed: tuple[int, ...],
) -> list[SplinePath] | None:
    gone = [m.length for m in members]
    found = _found(ground, members, present, duration, seed)
    before = np.full(len(members), np.inf)
    for _ in range(_ROUNDS):
        if found is None:
            return None
        paths = _bodies(members, [track for _, track in found], present, things, duration, seed)
        missing = np.array(
            [m.length - length_of(p) if m.length else 0.0 for m, p in zip(members, paths, strict=True)]
        )
        off = np.abs(missing) / [m.length or 1.0 for m in members]
        if (off <= _LENGTH).all():
            return paths if _apart(members, paths, present) else None
        if (off > np.maximum(_LENGTH, _BETTER * before)).any():
            return None  # someone cannot go as far, or cannot help being pushed on
        before = off
        gone = [g and max(0.5, g + d) for g, d in zip(gone, missing, strict=True)]
        found = _again(ground, members, present, duration, [course for course, _ in found], gone)
    return None


def length_of(path: Path) -> float:
    """Metres of the line through the body's positions at 30 Hz, as `share dataset info` counts them."""
    stamps = np.arange(path.start_ns, path.end_ns + 1, round(_COUNT_S * 1e9))
    steps = np.diff(path.poses(stamps)[:, :3, 3], axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())


def present_of(path: Path, distance: float) -> Present:
    """A settled path as others must respect it."""
    seconds = instants((path.end_ns - path.start_ns) / 1e9)
    stamps = np.minimum(path.start_ns + np.round(seconds * 1e9).astype(np.int64), path.end_ns)
    return Present(path.poses(stamps)[:, :3, 3], distance)


def _found(
    ground: Ground,
    members: Sequence[Member],
    present: Sequence[Present],
    duration: float,
    seed: tuple[int, ...],
) -> list[tuple[Course, Track]] | None:
    """A course for each, and the track on it."""
    found: dict[int, tuple[Course, Track]] = {}
    for i in _first_come(members):
        taken = _taken(members, present, {k: track for k, (_, track) in found.items()}, i)
        wish = replace(members[i].wish, gone=members[i].length)
        one = move(ground, wish, taken, duration, (*seed, i))
        if one is None:
            return None
        found[i] = one
    return [found[i] for i in range(len(members))]


def _again(
    ground: Ground,
    members: Sequence[Member],
    present: Sequence[Present],
    duration: float,
    courses: Sequence[Course],
    gone: Sequence[float | None],
) -> list[tuple[Course, Track]] | None:
    """The same courses, to go other lengths."""
    tracks: dict[int, Track] = {}
    for i in _first_come(members):
        track = courses[i].track(ground, _taken(members, present, tracks, i), duration, gone[i])
        if track is None:
            return None
        tracks[i] = track
    return [(courses[i], tracks[i]) for i in range(len(members))]


def _first_come(members: Sequence[Member]) -> list[int]:
    """The quick ones have the right of way: they have the least time to spare."""
    return sorted(range(len(members)), key=lambda i: -members[i].wish.speed)


def _taken(
    members: Sequence[Member], present: Sequence[Present], tracks: Mapping[int, Track], i: int
) -> list[Other]:
    """What member i must keep off: everyone whose motion is settled."""
    own = members[i].wish
    away = [(p.xyz[:, :2], p.distance) for p in present]
    away += [(track.xy, members[k].wish.distance) for k, track in tracks.items()]
    return [obstacle(xy, min(distance, own.distance)) for xy, distance in away]


def _bodies(
    members: Sequence[Member],
    tracks: Sequence[Track],
    present: Sequence[Present],
    things: F64,
    duration: float,
    seed: tuple[int, ...],
) -> list[SplinePath]:
    count = len(tracks[0].seconds)
    seen = [Seen(t.xy, m.height) for t, m in zip(tracks, members, strict=True)]
    strangers = [Seen(_held(p.xyz[:, :2], count), float(p.xyz[:, 2].mean())) for p in present]
    paths = []
    for i, (m, track) in enumerate(zip(members, tracks, strict=True)):
        rng = np.random.default_rng((*seed, i, 1))
        others = [s for k, s in enumerate(seen) if k != i] + strangers
        if m.wish.look == "person":
            path = walk.path_of(track, m.height, m.turns, things, others, START_NS, rng)
        else:
            path = robot.path_of(track, m.height, m.vibration, START_NS, rng)
        paths.append(replace(path, end_ns=START_NS + round(duration * 1e9)))
    return paths


def _apart(members: Sequence[Member], paths: Sequence[SplinePath], present: Sequence[Present]) -> bool:
    """Whether nobody is ever nearer to another than both like."""
    bodies = [present_of(p, m.wish.distance) for p, m in zip(paths, members, strict=True)]
    everyone = [*bodies, *present]
    for i, a in enumerate(bodies):
        for b in everyone[i + 1 :]:
            count = max(len(a.xyz), len(b.xyz))
            if nearest(_held(a.xyz, count), _held(b.xyz, count)) < min(a.distance, b.distance):
                return False
    return True


def _held(values: F64, count: int) -> F64:
    """(count, D): the first rows, the last one repeated where there are fewer."""
    return values[np.minimum(np.arange(count), len(values) - 1)]
