"""What a trial leaves behind: `trials/PARTICIPANT-PLACE/events.jsonl`; whether the robot came.

Times are seconds on one monotonic clock of the trial, positions x, y in m in one frame: of the motion capture
where it judges, else of the map. A goal that is called again, after an interruption, begins anew.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import DataError
from share.files.json_file import own_format_errors, read_json_lines
from share.files.reading import MB
from share.lab.study.plan import TRIALS, StudyPlan, SuccessRule
from share.robot.settings import CREATE3_SPEED_M_S

EVENTS = "events.jsonl"
EVENTS_BY_MAP = "events-map.jsonl"  # what the map said of a trial that was judged anew
MAX_LINES_BYTES = 20 * MB  # of a trial, or of all answers
JUDGES = ("mocap", "map", "simulation")
_MAX_POSITION_M, _MAX_PATH_M = 1e4, 1e6
_NO_STATUS = "none"


@dataclass(frozen=True)
class RobotStop:
    """The robot stands. s: after the call; distance_m: to the cube; path_m: driven since the call."""

    s: float
    distance_m: float
    path_m: float


@dataclass
class CalledGoal:
    """One call of the robot. straight_m: from the robot to the cube at the call, NaN where the robot's place
    was not known; planned_m: the way there, as planned, or straight_m."""

    spot: int
    called_s: float
    cube: tuple[float, float]
    straight_m: float
    planned_m: float
    first_motion_s: float = math.nan
    stops: list[RobotStop] = field(default_factory=list)
    status: str = _NO_STATUS  # the navigator's own

    @property
    def has_ended(self) -> bool:
        """Whether the navigator has said what became of it."""
        return self.status != _NO_STATUS

    def timeout_s(self, rule: SuccessRule, longer: bool) -> float:
        """Return the time allowed; longer: with the time that the way takes at the robot's top speed."""
        way_m = 0.0 if math.isnan(self.planned_m) else self.planned_m
        return rule.timeout_s + (way_m / CREATE3_SPEED_M_S if longer else 0.0)

    def reached_s(self, rule: SuccessRule, longer: bool = False) -> float:
        """Return after how long the robot stood close enough; NaN if it did not in time."""
        limit_s = self.timeout_s(rule, longer)
        times = [one.s for one in self.stops if one.distance_m <= rule.distance_m and one.s <= limit_s]
        return min(times, default=math.nan)


@dataclass
class TrialRecord:
    """What happened in a trial. is_complete: it was carried through. repeated: calls at each spot that a
    later call of the same goal replaced. unwell: what was not well when it began; seals: digests of its
    edges' configurations. moved_cubes: goals whose cube moved after it called; moved_floors: how often the
    marker did. is_left: the researcher has left it for good; last_s: time of its last event, on its own
    clock."""

    condition: str
    judge: str
    goals: dict[int, CalledGoal]  # by number, from 1
    is_complete: bool
    repeated: Counter[int] = field(default_factory=Counter)
    unwell: set[str] = field(default_factory=set)
    seals: set[str] = field(default_factory=set)
    moved_cubes: set[int] = field(default_factory=set)
    moved_floors: int = 0
    is_left: bool = False
    last_s: float = 0.0


def trial_folder(study: Path, participant: str, place: int) -> Path:
    """Return where a trial is; place: from 1."""
    return study / TRIALS / f"{participant}-{place}"


def planned_trials(plan: StudyPlan) -> dict[str, tuple[str, int, str]]:
    """Return participant, place and condition of all trials, by the names of their folders."""
    return {
        trial_folder(Path(), one.name, place).name: (one.name, place, trial.condition)
        for one in plan.participants
        for place, trial in enumerate(one.trials, 1)
    }


def read_trials(study: Path, plan: StudyPlan) -> dict[tuple[str, int], TrialRecord]:
    """Return the trials that there are, by participant and place. Raises DataError."""
    planned, folder = planned_trials(plan), study / TRIALS
    there = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    for name in there:
        if name not in planned and not name.startswith("."):
            raise DataError(f"{folder / name}: the plan has no such trial; move it elsewhere")
    records = {}
    for name, (participant, place, condition) in planned.items():
        path = folder / name / EVENTS
        if path.exists():
            records[participant, place] = read_trial(path, plan, participant, place, condition)
    return records


def answer_rows(path: Path, plan: StudyPlan) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Yield, of each line of the answers, where it is, its participant and its content; nothing without a
    file. Raises DataError for a participant who is not in the plan."""
    people = {one.name for one in plan.participants}
    rows = read_json_lines(path, MAX_LINES_BYTES) if path.exists() else []
    for number, row in enumerate(rows, 1):
        where = f"{path}, line {number}"
        with own_format_errors(Path(where)):
            person = row["participant"]
            if person not in people:
                raise DataError(f"{where}: participant {person!s:.40} is not in the plan")
        yield where, person, row


def read_trial(path: Path, plan: StudyPlan, participant: str, place: int, condition: str) -> TrialRecord:
    """Read the events of one trial, which must be the planned one. Raises DataError."""
    record = TrialRecord(condition, "", {}, False)
    wanted = {"participant": participant, "place": place, "condition": condition, "plan": plan.digest}
    for number, event in enumerate(read_json_lines(path, MAX_LINES_BYTES), 1):
        where = f"{path}, line {number}"
        with own_format_errors(Path(where)):
            kind = event["event"]
            if kind == "begin":
                _check_begin(event, wanted, where)
                if record.judge not in ("", event["judge"]):
                    raise DataError(
                        f"{where}: judge {event['judge']}, before {record.judge}; a trial has one"
                    )
                record.judge = event["judge"]
                record.unwell |= {str(one) for one in event.get("unwell") or ()}
                if event.get("config_sha256") is not None:
                    record.seals.add(str(event["config_sha256"]))
            elif not record.judge:
                raise DataError(f"{where}: {kind} before begin")
            elif kind in _READERS:
                _READERS[kind](record, event, plan)
            else:
                raise DataError(f"{where}: event '{kind!s:.40}' is not known")
            record.is_left = event.get("is_left") is True
            record.last_s = max(record.last_s, _number(event.get("t_s", 0.0)))
    if record.is_complete and len(record.goals) != len(plan.spots):
        raise DataError(
            f"{path}: says that it is complete, with {len(record.goals)} of {len(plan.spots)} goals"
        )
    visits = Counter(goal.spot for goal in record.goals.values())
    if record.is_complete and len(visits) < len(plan.spots):
        twice = ", ".join(str(spot) for spot, count in sorted(visits.items()) if count > 1)
        raise DataError(f"{path}: goals share spot {twice}; the plan visits each spot once")
    return record


def _check_begin(event: Mapping[str, Any], wanted: Mapping[str, Any], where: str) -> None:
    for name, value in wanted.items():
        if event[name] != value:
            what = "another plan" if name == "plan" else f"{name} {event[name]!s:.40}, not {value}"
            raise DataError(f"{where}: the trial was run by {what}; put it where it belongs")
    if event["judge"] not in JUDGES:
        raise DataError(f"{where}: judge '{event['judge']!s:.40}'; known: {', '.join(JUDGES)}")


def _read_call(record: TrialRecord, event: Mapping[str, Any], plan: StudyPlan) -> None:
    cube, robot = _position(event["cube_m"]), event["robot_m"]
    straight_m = math.nan if robot is None else math.dist(cube, _position(robot))
    planned_m = _path_m(event["path_m"]) if "path_m" in event else straight_m
    goal = CalledGoal(_whole(event["spot"]), _number(event["t_s"]), cube, straight_m, planned_m)
    number = _whole(event["goal"])
    if not (1 <= number <= len(plan.spots) and 1 <= goal.spot <= len(plan.spots)):
        raise ValueError(f"goal {number} at spot {goal.spot}; the plan has {len(plan.spots)} of each")
    if number in record.goals:
        record.repeated[record.goals[number].spot] += 1
        record.moved_cubes.discard(number)
    record.goals[number] = goal


def _read_moves(record: TrialRecord, event: Mapping[str, Any], plan: StudyPlan) -> None:
    goal = record.goals[_whole(event["goal"])]
    if math.isnan(goal.first_motion_s):
        goal.first_motion_s = _since_call(goal, event)


def _read_stands(record: TrialRecord, event: Mapping[str, Any], plan: StudyPlan) -> None:
    goal = record.goals[_whole(event["goal"])]
    distance_m = math.dist(goal.cube, _position(event["robot_m"]))
    goal.stops.append(RobotStop(_since_call(goal, event), distance_m, _path_m(event["path_m"])))


def _read_status(record: TrialRecord, event: Mapping[str, Any], plan: StudyPlan) -> None:
    status = event["status"]
    if not (isinstance(status, str) and status.isprintable() and 0 < len(status) <= 100):
        raise ValueError("status is not printable text of 1 to 100 characters")
    record.goals[_whole(event["goal"])].status = status


def _read_moved_cube(record: TrialRecord, event: Mapping[str, Any], plan: StudyPlan) -> None:
    number = _whole(event["goal"])
    if event["cube_m"] is not None:
        _position(event["cube_m"])
    if number not in record.goals:
        raise ValueError(f"goal {number} was not called")
    record.moved_cubes.add(number)


def _read_moved_floor(record: TrialRecord, event: Mapping[str, Any], plan: StudyPlan) -> None:
    _whole(event["goal"])
    if event["moved_m"] is not None:
        _number(event["moved_m"])
        record.moved_floors += 1


def _read_end(record: TrialRecord, event: Mapping[str, Any], plan: StudyPlan) -> None:
    record.is_complete = True


def _read_interruption(record: TrialRecord, event: Mapping[str, Any], plan: StudyPlan) -> None:
    str(event["reason"])


_READERS: dict[str, Callable[[TrialRecord, Mapping[str, Any], StudyPlan], None]] = {
    "call": _read_call,
    "moves": _read_moves,
    "stands": _read_stands,
    "status": _read_status,
    "cube moved": _read_moved_cube,
    "floor moved": _read_moved_floor,
    "interrupted": _read_interruption,
    "end": _read_end,
}
EVENT_KINDS = ("begin", *_READERS)


def _position(value: Sequence[Any]) -> tuple[float, float]:
    x, y = map(_number, value)
    if not max(abs(x), abs(y)) <= _MAX_POSITION_M:
        raise ValueError(f"{x:g}, {y:g} is beyond {_MAX_POSITION_M:g} m")
    return x, y


def _path_m(value: Any) -> float:
    if not 0 <= (length_m := _number(value)) <= _MAX_PATH_M:
        raise ValueError(f"path_m {length_m:g} is not from 0 to {_MAX_PATH_M:g} m")
    return length_m


def _whole(value: Any) -> int:
    if type(value) is not int:
        raise TypeError(f"{value!r:.40} is not a whole number")
    return value


def _number(value: Any) -> float:
    if type(value) not in (int, float):
        raise TypeError(f"{value!r:.40} is not a number")
    return float(value)


def _since_call(goal: CalledGoal, event: Mapping[str, Any]) -> float:
    s = _number(event["t_s"]) - goal.called_s
    if s < 0:
        raise ValueError(f"t_s {event['t_s']} is before the call at {goal.called_s}")
    return s


REACHED, REACHED_LONGER = "reachability, %", "reachability with the longer time-out, %"
# what is measured of each trial; the first two by the rule of success
TRIAL_MEASURES = (
    REACHED,
    REACHED_LONGER,
    "time until the robot stands there, s",
    "time to first motion, s",
    "path over straight line",
    "final distance, m",
)


def trial_measures(goals: Iterable[CalledGoal], rule: SuccessRule) -> dict[str, float]:
    """Return the measures of a complete trial: means over its goals; of times over the goals that have one.

    path over straight line: sums over reached goals whose straight line is known. final distance: at the last
    stop, of goals with one.
    """
    called = list(goals)
    times, longer = (np.array([one.reached_s(rule, long) for one in called]) for long in (False, True))
    reached = [
        (next(stop.path_m for stop in goal.stops if stop.s == s), goal.straight_m)
        for goal, s in zip(called, times.tolist(), strict=True)
        if not math.isnan(s + goal.straight_m)
    ]
    driven, straight = (sum(one[k] for one in reached) for k in (0, 1))
    values = (
        100 * float(np.isfinite(times).mean()),
        100 * float(np.isfinite(longer).mean()),
        _known_mean(times.tolist()),
        _known_mean(one.first_motion_s for one in called),
        driven / straight if straight else math.nan,
        _known_mean(one.stops[-1].distance_m for one in called if one.stops),
    )
    return dict(zip(TRIAL_MEASURES, values, strict=True))


def _known_mean(values: Iterable[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan
