"""Judges a trial by motion capture: where the robot truly was, in place of where the map had it.

A trial's events have UTC, by the clock of the machine that led it; the motion capture has a clock of its own.
The two are matched by when the robot drove and when it stood, which needs no place: a map that is wrong does
not bias it, but the delay does with which the robot's places came. Cubes count as lying at their planned
spots, measured on the floor; by the map they drift with the headset.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from share.errors import DataError, UsageError
from share.geometry import se3
from share.lab.mocap.initialisation import nearest_axis_rotation
from share.lab.mocap.trajectory import MocapTrajectory
from share.lab.study.plan import StudyPlan
from share.lab.study.standstill import BY_MAP, BY_TRUTH, MotionWatch, RobotSample
from share.robot.planar import PlanarPose, flattened
from share.types import F64

MAX_HIDDEN_S = 2.0  # that the motion capture may not see the robot under way
BY_MOCAP = replace(BY_TRUTH, still_s=BY_MAP.still_s, max_gap_s=MAX_HIDDEN_S + 0.2)
_SETTLES_S = 5.0  # after the navigator is done: what the robot does later belongs to no goal
_LONGEST_S = 86_400.0  # of a trial
_CLOCK_WAS_SET = "the clock of the machine that led the trial was set in between; it cannot be judged"
_STEP_S = 0.05  # of the search for the offset, and between two places that are judged
_WINDOW_S = 0.5  # over which speed is taken
_DRIVES_M_S, _TURNS_RAD_S = 0.04, 0.15
_MOTION_SEEN_S = 1.0  # at most, from the robot's first motion until a map shows it
_MIN_AGREEMENT, _MIN_LEAD, _PEAK_S = 0.6, 0.1, 3.0


@dataclass(frozen=True)
class ClockMatch:
    """zero_utc_s: UTC, s since 1970, at which the motion capture's clock was 0. agreement: of driving and
    standing by it, -1 to 1; next_agreement: of the best one elsewhere."""

    zero_utc_s: float
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
        T = mocap.rotated(_levelling(up)).interpolate(stamps)
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

    def at(self, t_s: float) -> RobotSample:
        """Return where it was, between samples and over gaps in a straight line."""
        x, y, yaw = (float(np.interp(t_s, self.t_s, one)) for one in (*self.xy.T, self.yaw))
        return RobotSample(t_s, x, y, yaw)

    def longest_gap_s(self, from_s: float, to_s: float) -> float:
        """Return the longest time within a time range in which it was not seen."""
        i, j = np.searchsorted(self.t_s, [from_s, to_s])
        seen_s = self.t_s[i:j][self.is_seen[i:j]]
        return float(np.diff(np.concatenate([[from_s], seen_s, [to_s]])).max())


def _levelling(up: str) -> F64:
    """Return the rotation (3, 3) to z up of a world whose up axis is x, y or z."""
    return nearest_axis_rotation(np.eye(3)["xyz".index(up)])


def floor_in_world(T_world_marker: F64, up: str) -> PlanarPose:
    """Return where the floor's marker is in the world with z up, by a body's pose (4, 4) in the motion
    capture's axes: it faces along its x axis."""
    return flattened(se3.from_rt(_levelling(up), np.zeros(3)) @ T_world_marker)


# ---------------------------------------------------------------- clocks


def utc_s(text: str) -> float:
    """Return a UTC time in ISO 8601, s since 1970. Raises ValueError."""
    when = datetime.fromisoformat(text)
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()


def utc_times(events: Sequence[Mapping[str, Any]]) -> list[float]:
    """Return the UTC of each event, s since 1970, by the `utc` of the begin before it. Raises DataError where
    a part of the trial begins before the last one has ended, or a day later."""
    out, zero_s = list[float](), 0.0
    for event in events:
        if event["event"] == "begin":
            begin_s = utc_s(event["utc"])
            zero_s = begin_s - event["t_s"]
            if out and begin_s < max(out) - _PEAK_S:
                raise DataError(_CLOCK_WAS_SET)
        out.append(zero_s + event["t_s"])
    if out and not max(out) - out[0] <= _LONGEST_S:
        raise DataError(_CLOCK_WAS_SET)
    return out


def expected_drives(events: Sequence[Mapping[str, Any]]) -> list[tuple[float, float, float]]:
    """Return time ranges, s, in which the robot drove (1) or stood (-1) by the events: it stands from a call
    until shortly before its first motion is seen, drives from there until it stands, and stands from the end
    of the goal to the next call."""
    times, out = utc_times(events), list[tuple[float, float, float]]()
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
    """Return the clock by which the robot drives when the events say so. Raises DataError where none or
    several fit."""
    ranges = expected_drives(events)
    if not any(does > 0 for _, _, does in ranges):
        raise DataError("the robot never drove in this trial, so the clocks cannot be matched; give --zero")
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
    found = ClockMatch(-float(offsets_s[best]), float(score[best]), float(elsewhere.max(initial=-1.0)))
    if found.agreement < _MIN_AGREEMENT:
        raise DataError(
            f"driving and standing agree at no time offset ({found.agreement:.2f} at best, {_MIN_AGREEMENT} "
            "needed): is it this trial's motion capture, and the robot's body?"
        )
    if found.agreement - found.next_agreement < _MIN_LEAD:
        raise DataError(
            f"two time offsets fit alike ({found.agreement:.2f} and {found.next_agreement:.2f}); give --zero"
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


@dataclass(frozen=True)
class _Goal:
    """A call and what belongs to it. index: of the call among the events. zero_s: UTC of the trial's clock
    there. called_s, over_s, end_s: UTC of the call, of the navigator's end (inf: none), of the last that
    counts."""

    index: int
    call: Mapping[str, Any]
    zero_s: float
    called_s: float
    over_s: float
    end_s: float

    @staticmethod
    def of(events: Sequence[Mapping[str, Any]], times: Sequence[float], index: int) -> _Goal:
        call, later = events[index], range(index + 1, len(events))
        over = next((k for k in later if events[k]["event"] in ("status", "call", "begin")), None)
        has_ended = over is not None and events[over]["event"] == "status"
        over_s = times[over] if over is not None and has_ended else math.inf
        ends = ("call", "begin", "interrupted") if has_ended else ("call", "begin", "interrupted", "end")
        next_s = next((times[k] for k in later if events[k]["event"] in ends), math.inf)
        end_s = min(next_s, over_s + _SETTLES_S, times[index] + _LONGEST_S)
        return _Goal(index, call, times[index] - call["t_s"], times[index], over_s, end_s)


def judged(
    events: Sequence[Mapping[str, Any]], plan: StudyPlan, track: RobotTrack, zero_utc_s: float
) -> list[dict[str, Any]]:
    """Return a complete trial's events with robot, motion and standstills by the motion capture, and cubes at
    their spots. What the map said stays beside it: `cube_by_map_m`, `robot_by_map_m`. Raises UsageError where
    the robot was hidden under way."""
    times, out = utc_times(events), list[tuple[float, float, dict[str, Any]]]()
    calls = [k for k, event in enumerate(events) if event["event"] == "call"]
    goals = [_Goal.of(events, times, k) for k in calls]
    _check_seen({one.call["goal"]: one for one in goals}.values(), track, zero_utc_s)
    for k, event in enumerate(events):
        if event["event"] == "begin":
            out.append((event["t_s"], k, {**event, "judge": "mocap"}))
        elif event["event"] == "end":
            out.append((math.inf, k, dict(event)))
        elif event["event"] not in ("call", "moves", "stands"):
            out.append((event["t_s"], k, dict(event)))
    for goal in goals:
        out += [(line["t_s"], goal.index, line) for line in _goal_events(goal, plan, track, zero_utc_s)]
    return [line for _, _, line in sorted(out, key=lambda one: one[:2])]


def _check_seen(goals: Iterable[_Goal], track: RobotTrack, zero_utc_s: float) -> None:
    """Raise UsageError where the robot was hidden from a call until the navigator was done, or for long at
    the end."""
    hidden = {
        goal.call["goal"]: track.longest_gap_s(
            goal.called_s - zero_utc_s, min(goal.over_s, goal.end_s) - zero_utc_s
        )
        for goal in goals
    }
    if bad := {goal: gap_s for goal, gap_s in hidden.items() if gap_s > MAX_HIDDEN_S}:
        listed = ", ".join(f"{goal} ({gap_s:.1f} s)" for goal, gap_s in sorted(bad.items()))
        raise UsageError(
            f"the motion capture did not see the robot for more than {MAX_HIDDEN_S:g} s under way to goal "
            f"{listed}; it cannot judge this trial"
        )


def _goal_events(
    goal: _Goal, plan: StudyPlan, track: RobotTrack, zero_utc_s: float
) -> Iterator[dict[str, Any]]:
    """Yield call, first motion and standstills of one goal. A robot that need not drive counts as standing
    once the navigator is done."""
    number, shift_s = goal.call["goal"], zero_utc_s - goal.zero_s  # from the track's clock to the trial's
    x, y = plan.spots[goal.call["spot"] - 1]
    at_call = track.at(goal.called_s - zero_utc_s)
    yield {
        **{name: value for name, value in goal.call.items() if name != "path_m"},
        "cube_m": [round(x, 4), round(y, 4)],
        "robot_m": _xy(at_call),
        "cube_by_map_m": goal.call["cube_m"],
        "robot_by_map_m": goal.call["robot_m"],
    }
    watch, has_moved, stood = MotionWatch(at_call, BY_MOCAP), False, False
    for sample in track.samples(goal.called_s - zero_utc_s, goal.end_s - zero_utc_s):
        watch.add(sample)
        if watch.moves_s is not None and not has_moved:
            has_moved = True
            yield {"event": "moves", "t_s": round(watch.moves_s + shift_s, 3), "goal": number}
        since_s = watch.stands_since()
        counts = since_s is not None and (has_moved or sample.t_s + zero_utc_s >= goal.over_s)
        if since_s is not None and counts and not stood:
            yield {
                "event": "stands",
                "t_s": max(goal.call["t_s"], round(since_s + shift_s, 3)),
                "goal": number,
                "robot_m": _xy(sample),
                "path_m": round(watch.path_m, 4),
            }
        stood = counts


def _xy(sample: RobotSample) -> list[float]:
    return [round(sample.x, 4), round(sample.y, 4)]
