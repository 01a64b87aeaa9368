"""Judges a trial by motion capture: where the robot truly was, in place of where the map had it.

A trial's events have times on the trial's clock, the motion capture has another. The two are matched by when
the robot drove and when it stood, which needs no place: a map that is wrong does not bias it. Cubes then
count as lying at their planned spots, measured on the floor; by the map they drift with the headset.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from share.errors import DataError, UsageError
from share.geometry import se3
from share.lab.mocap.trajectory import MocapTrajectory
from share.lab.study.plan import StudyPlan
from share.lab.study.standstill import BY_TRUTH, MotionLimits, MotionWatch, RobotSample
from share.robot.planar import PlanarPose, flattened
from share.types import F64

BY_MOCAP: MotionLimits = BY_TRUTH
MIN_SEEN = 0.5  # of the time under way, in which the motion capture must see the robot
_STEP_S = 0.05  # of the search for the offset, and between two places that are judged
_WINDOW_S = 0.5  # over which speed is taken
_DRIVES_M_S, _TURNS_RAD_S = 0.04, 0.15
_MOTION_SEEN_S = 1.0  # at most, from the robot's first motion until a map shows it
_MIN_AGREEMENT, _MIN_LEAD, _PEAK_S = 0.6, 0.1, 3.0
_UPS = {"z": np.eye(3), "y": se3.so3_exp(np.array([math.pi / 2, 0.0, 0.0]))}
UP_AXES = tuple(_UPS)


@dataclass(frozen=True)
class ClockMatch:
    """offset_s: the motion capture's clock minus the trial's. agreement: of driving and standing there, -1 to
    1; next_agreement: at the best offset elsewhere."""

    offset_s: float
    agreement: float
    next_agreement: float


@dataclass(frozen=True, eq=False)
class RobotTrack:
    """Where the robot was on the floor: t_s (N,) rising, in the motion capture's clock; xy (N, 2), m; yaw
    (N,), rad, unwrapped, of any axis of its body; is_seen (N,). Evenly spaced by `_STEP_S`."""

    t_s: F64
    xy: F64
    yaw: F64
    is_seen: np.ndarray

    @staticmethod
    def of(mocap: MocapTrajectory, T_world_floor: PlanarPose, up: str) -> RobotTrack:
        """Return the track of the robot's body; T_world_floor: in the world with z up."""
        stamps = np.arange(mocap.stamps_ns[0], mocap.stamps_ns[-1] + 1, round(_STEP_S * 1e9))
        T = mocap.rotated(_UPS[up]).interpolate(stamps)
        axis = int((T[:, :2, :3] ** 2).sum(1).mean(0).argmax())  # the body's most level one
        c, s = math.cos(T_world_floor.yaw), math.sin(T_world_floor.yaw)
        xy = (T[:, :2, 3] - [T_world_floor.x, T_world_floor.y]) @ np.array([[c, -s], [s, c]])
        yaw = np.unwrap(np.arctan2(T[:, 1, axis], T[:, 0, axis])) - T_world_floor.yaw
        return RobotTrack(stamps * 1e-9, xy, yaw, mocap.is_covered(stamps) | (stamps == mocap.stamps_ns[0]))

    def drives(self) -> F64:
        """Return (N,): 1 where it drives or turns, -1 where it stands, 0 where that is not known."""
        half = round(_WINDOW_S / 2 / _STEP_S)
        out = np.zeros(len(self.t_s))
        if len(out) > 2 * half:
            step_m = np.linalg.norm(self.xy[2 * half :] - self.xy[: -2 * half], axis=1)
            turn = np.abs(self.yaw[2 * half :] - self.yaw[: -2 * half])
            moves = (step_m > _DRIVES_M_S * _WINDOW_S) | (turn > _TURNS_RAD_S * _WINDOW_S)
            known = self.is_seen[2 * half :] & self.is_seen[: -2 * half]
            out[half:-half] = np.where(known, np.where(moves, 1.0, -1.0), 0.0)
        return out

    def samples(self, from_s: float, to_s: float) -> Iterator[RobotSample]:
        """Yield where it was in a time range of the motion capture's clock, where it was seen."""
        i, j = np.searchsorted(self.t_s, [from_s, to_s])
        for k in range(i, j):
            if self.is_seen[k]:
                x, y = self.xy[k].tolist()
                yield RobotSample(float(self.t_s[k]), x, y, float(self.yaw[k]))

    def seen_part(self, from_s: float, to_s: float) -> float:
        """Return the part of a time range in which it was seen."""
        i, j = np.searchsorted(self.t_s, [from_s, to_s])
        return float(self.is_seen[i:j].sum()) * _STEP_S / max(to_s - from_s, _STEP_S)


def floor_in_world(T_world_marker: F64, up: str) -> PlanarPose:
    """Return where the floor's marker is in the world with z up, by a body's pose (4, 4) in the motion
    capture's axes: it faces along its x axis."""
    return flattened(se3.from_rt(_UPS[up], np.zeros(3)) @ T_world_marker)


# ---------------------------------------------------------------- clocks


def steady_times(events: Sequence[Mapping[str, Any]]) -> list[float]:
    """Return the time of each event, s, on a clock that goes on between the parts of an interrupted trial."""
    out, shift_s, first_utc = list[float](), 0.0, None
    is_resumed = sum(event["event"] == "begin" for event in events) > 1
    for event in events:
        if event["event"] == "begin" and is_resumed:
            utc_s = datetime.fromisoformat(event["utc"]).timestamp()
            first_utc = utc_s - event["t_s"] if first_utc is None else first_utc
            shift_s = utc_s - first_utc - event["t_s"]
        out.append(event["t_s"] + shift_s)
    return out


def expected_drives(events: Sequence[Mapping[str, Any]]) -> list[tuple[float, float, float]]:
    """Return time ranges, s, in which the robot drove (1) or stood (-1) by the events: it stands from a call
    until shortly before its first motion is seen, drives from there until it stands, and stands from the end
    of the goal to the next call."""
    times, out = steady_times(events), list[tuple[float, float, float]]()
    since: tuple[float, float] | None = None  # since when it is known to drive or to stand, and which
    for event, t_s in zip(events, times, strict=True):
        kind = event["event"]
        if kind not in ("call", "moves", "stands", "status", "begin", "interrupted", "end"):
            continue
        if since is not None and (since[1] < 0 or kind == "stands"):
            out.append((since[0], t_s - _MOTION_SEEN_S if kind == "moves" else t_s, since[1]))
        does = {"call": -1.0, "moves": 1.0, "status": -1.0}.get(kind)
        since = None if does is None else (t_s, does)
    return [one for one in out if one[1] > one[0]]


def match_clocks(track: RobotTrack, events: Sequence[Mapping[str, Any]]) -> ClockMatch:
    """Return the offset at which the robot drives when the events say so. Raises DataError where no offset or
    several fit."""
    ranges = expected_drives(events)
    if not any(does > 0 for _, _, does in ranges):
        raise DataError("the robot never drove in this trial, so the clocks cannot be matched; give --offset")
    start_s, end_s = ranges[0][0], max(end for _, end, _ in ranges)
    at = start_s + _STEP_S * np.arange(math.ceil((end_s - start_s) / _STEP_S) + 1)
    expected = np.zeros(len(at))
    for begin, end, does in ranges:
        expected[(at >= begin) & (at <= end)] = does
    for does in (1.0, -1.0):  # driving and standing count alike, however long each takes
        expected[expected == does] *= 0.5 / max(1, (expected == does).sum())
    score = _correlated(track.drives(), expected)
    best = _middle_of_peak(score)
    offsets_s = track.t_s[0] - start_s + _STEP_S * (np.arange(len(score)) - (len(expected) - 1))
    elsewhere = score[np.abs(offsets_s - offsets_s[best]) > _PEAK_S]
    found = ClockMatch(float(offsets_s[best]), float(score[best]), float(elsewhere.max(initial=-1.0)))
    if found.agreement < _MIN_AGREEMENT:
        raise DataError(
            f"driving and standing agree at no time offset ({found.agreement:.2f} at best, {_MIN_AGREEMENT} "
            "needed): is it this trial's motion capture, and the robot's body?"
        )
    if found.agreement - found.next_agreement < _MIN_LEAD:
        raise DataError(
            f"two time offsets fit alike, {found.offset_s:.1f} s ({found.agreement:.2f}) and another "
            f"({found.next_agreement:.2f}); give --offset"
        )
    return found


def _correlated(a: F64, b: F64) -> F64:
    """Return the correlation of a with b at every lag, from -(len(b) - 1) on, by FFT."""
    size = len(a) + len(b) - 1
    return np.asarray(np.fft.irfft(np.fft.rfft(a, size) * np.fft.rfft(b[::-1], size), size), np.float64)


def _middle_of_peak(score: F64) -> int:
    """Return the middle of the highest plateau."""
    best = int(score.argmax())
    ties = np.flatnonzero(score >= score[best] - 1e-6)
    return int(np.median(ties[np.abs(ties - best) * _STEP_S < _PEAK_S]))


# ---------------------------------------------------------------- judging


def judged(
    events: Sequence[Mapping[str, Any]], plan: StudyPlan, track: RobotTrack, offset_s: float
) -> list[dict[str, Any]]:
    """Return a complete trial's events with robot, motion and standstills by the motion capture, and cubes at
    their spots. What the map said stays beside it: `cube_by_map_m`, `robot_by_map_m`. Raises UsageError where
    the robot was hardly seen."""
    times, out = steady_times(events), list[dict[str, Any]]()
    goals = [k for k, event in enumerate(events) if event["event"] == "call"]
    ends = [_end_of_goal(events, k) for k in goals]
    under_way_s = sum(times[end] - times[k] for k, end in zip(goals, ends, strict=True))
    seen_s = sum(
        track.seen_part(times[k] + offset_s, times[end] + offset_s) * (times[end] - times[k])
        for k, end in zip(goals, ends, strict=True)
    )
    if seen_s < MIN_SEEN * under_way_s:
        raise UsageError(
            f"the motion capture saw the robot in {100 * seen_s / max(under_way_s, 1e-9):.0f} % of the time "
            f"under way; {100 * MIN_SEEN:.0f} % are needed"
        )
    for event in events:
        if event["event"] == "begin":
            out.append({**event, "judge": "mocap"})
        elif event["event"] not in ("call", "moves", "stands"):
            out.append(dict(event))
    for k, end in zip(goals, ends, strict=True):
        shift_s = times[k] - events[k]["t_s"] + offset_s
        out += _goal_events(events[k : end + 1], plan, track, shift_s)
    order = {"begin": 0, "end": 2}
    return sorted(out, key=lambda event: (event["t_s"], order.get(event["event"], 1)))


def _end_of_goal(events: Sequence[Mapping[str, Any]], call: int) -> int:
    """Return the index of the event that ends a called goal: the next call, or the end of this part."""
    later = range(call + 1, len(events))
    return next(
        (k for k in later if events[k]["event"] in ("call", "begin", "interrupted", "end")), len(events) - 1
    )


def _goal_events(
    events: Sequence[Mapping[str, Any]], plan: StudyPlan, track: RobotTrack, shift_s: float
) -> Iterator[dict[str, Any]]:
    """Yield call, first motion and standstills of one goal. shift_s: the track's clock minus the trial's."""
    call, goal = events[0], events[0]["goal"]
    x, y = plan.spots[call["spot"] - 1]
    samples = list(track.samples(call["t_s"] + shift_s, events[-1]["t_s"] + shift_s))
    at_call = samples[0] if samples and samples[0].t_s - shift_s - call["t_s"] < _WINDOW_S else None
    by_map = {"cube_by_map_m": call["cube_m"], "robot_by_map_m": call["robot_m"]}
    yield {
        **{name: value for name, value in call.items() if name != "path_m"},
        "cube_m": [round(x, 4), round(y, 4)],
        "robot_m": None if at_call is None else _xy(at_call),
        **by_map,
    }
    over_s = min(
        (one["t_s"] for one in events if one["event"] == "status" and one["goal"] == goal), default=math.inf
    )
    yield from _motion_events(call["t_s"], goal, samples, at_call, over_s, shift_s)


def _motion_events(
    called_s: float,
    goal: int,
    samples: Iterable[RobotSample],
    at_call: RobotSample | None,
    over_s: float,
    shift_s: float,
) -> Iterator[dict[str, Any]]:
    """Yield `moves` and `stands`. over_s: when the navigator was done, from when on a robot that need not
    drive counts as standing."""
    watch, has_moved, stood = MotionWatch(at_call, BY_MOCAP), False, False
    for sample in samples:
        watch.add(sample)
        now_s = sample.t_s - shift_s
        if watch.moves_s is not None and not has_moved:
            has_moved = True
            yield {"event": "moves", "t_s": round(watch.moves_s - shift_s, 3), "goal": goal}
        since_s = watch.stands_since()
        counts = since_s is not None and (has_moved or now_s >= over_s)
        if since_s is not None and counts and not stood:
            yield {
                "event": "stands",
                "t_s": round(max(called_s, since_s - shift_s), 3),
                "goal": goal,
                "robot_m": _xy(sample),
                "path_m": round(watch.path_m, 4),
            }
        stood = counts


def _xy(sample: RobotSample) -> list[float]:
    return [round(sample.x, 4), round(sample.y, 4)]
