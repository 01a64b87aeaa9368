"""The table that is analysed: one value of each measure for each participant and condition."""

from __future__ import annotations

import csv
import io
import math
import unicodedata
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from share.config import POLICY_NAMES
from share.errors import DataError
from share.files.json_file import own_format_errors
from share.files.reading import MB, read_errors, read_text
from share.lab.study.orders import MAX_CONDITIONS, MIN_CONDITIONS
from share.lab.study.plan import ANSWERS, MAX_PARTICIPANTS, StudyPlan, SuccessRule
from share.lab.study.trials import (
    TRIAL_MEASURES,
    TrialRecord,
    answer_rows,
    read_trials,
    trial_measures,
)
from share.types import F64, I64

_HEAD = ("participant", "condition", "place")
REPEATED_CALLS = "calls repeated"  # a measure where there are any: they may come of a condition
_CHOICES = ("most", "least")
_MAX_CSV_BYTES, _MAX_CSV_LINES, _MAX_MEASURES = 10 * MB, MAX_PARTICIPANTS * MAX_CONDITIONS + 1, 100
Ranges = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Observations:
    """measures: {name: (P, C)}, NaN where missing. places (P, C): from 1, 0 where unknown. choices:
    {"most" | "least": condition that each participant named, "" where none}. notes: what a reader must know
    of the data."""

    participants: tuple[str, ...]
    conditions: tuple[str, ...]
    measures: dict[str, F64]
    places: I64
    choices: dict[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    planned: int = 0  # trials; 0 where no plan is known
    done: int = 0

    def named(self, names: Mapping[str, str]) -> Observations:
        """Return the table with policies in place of letters, in their usual order."""
        named = [names[one] for one in self.conditions]
        order = sorted(range(len(named)), key=lambda k: POLICY_NAMES.index(named[k]))
        return replace(
            self,
            conditions=tuple(named[k] for k in order),
            measures={name: values[:, order] for name, values in self.measures.items()},
            places=self.places[:, order],
            choices={kind: tuple(names.get(one, "") for one in ones) for kind, ones in self.choices.items()},
        )

    def with_note(self, note: str) -> Observations:
        """Return the table with one more note."""
        return replace(self, notes=(*self.notes, note))


def read_study(study: Path, plan: StudyPlan, rule: SuccessRule) -> Observations:
    """Read the trials and answers of a study's folder. Raises DataError that names file and line."""
    people = [one.name for one in plan.participants]
    shape = len(people), len(plan.letters)
    places = np.zeros(shape, np.int64)
    measures = {name: np.full(shape, math.nan) for name in TRIAL_MEASURES}
    records = read_trials(study, plan)
    statuses: Counter[str] = Counter()
    repeated: Counter[int] = Counter()
    recalled = np.full(shape, math.nan)
    for (name, place), record in records.items():
        cell = people.index(name), plan.letters.index(record.condition)
        places[cell] = place
        if record.is_complete:
            statuses.update(goal.status for goal in record.goals.values())
            repeated.update(record.repeated)
            recalled[cell] = record.repeated.total()
            for measure, value in trial_measures(record.goals.values(), rule).items():
                measures[measure][cell] = value
    if repeated:
        measures[REPEATED_CALLS] = recalled
    answers, choices = _read_answers(study / ANSWERS, plan)
    judges = Counter(record.judge for record in records.values() if record.is_complete)
    far = _far_cubes(records.values(), plan, rule)
    done = sum(record.is_complete for record in records.values())
    notes = (*_broken_note(records), *_repeated_note(repeated), *far, *_room_notes(records.values()))
    notes = (*notes, *_judge_notes(judges, statuses))
    return Observations(
        tuple(people), plan.letters, measures | answers, places, choices, notes, places.size, done
    )


def _broken_note(records: Mapping[tuple[str, int], Any]) -> Iterable[str]:
    broken = [f"{name} place {place}" for (name, place), one in records.items() if not one.is_complete]
    if broken:
        names = ", ".join(broken)
        yield f"{len(broken)} trials were begun and not carried through; their goals are left out: {names}"


def _repeated_note(repeated: Mapping[int, int]) -> Iterable[str]:
    if repeated:
        yield (
            f"{sum(repeated.values())} calls were repeated, of which only the last one of a goal counts: "
            + ", ".join(f"spot {spot} {count}" for spot, count in sorted(repeated.items()))
        )


def _far_cubes(records: Iterable[TrialRecord], plan: StudyPlan, rule: SuccessRule) -> Iterable[str]:
    """Say which cubes lay further from their planned spot than a robot may from a cube."""
    goals = [goal for record in records if record.is_complete for goal in record.goals.values()]
    far = [(math.dist(goal.cube, plan.spots[goal.spot - 1]), goal.spot) for goal in goals]
    far = [one for one in far if one[0] > rule.distance_m]
    if far:
        distance_m, spot = max(far)
        yield (
            f"{len(far)} of {len(goals)} cubes lay more than {rule.distance_m:g} m from their planned spot, "
            f"the farthest {distance_m:.2f} m from spot {spot}; the robot was sent to the cube"
        )


def _room_notes(records: Collection[TrialRecord]) -> Iterable[str]:
    """Say what was not as it should be in the room: cubes and the marker that moved, edges, checks."""
    goals = sum(len(record.goals) for record in records)
    if moved := sum(len(record.moved_cubes) for record in records):
        yield (
            f"{moved} of {goals} cubes were moved or removed after they had called; distances are to where "
            "they lay at the call"
        )
    if floors := sum(record.moved_floors > 0 for record in records):
        yield (
            f"the floor's marker moved during {floors} of {len(records)} trials, by a hand or a correction "
            "of the map; places before and after do not compare"
        )
    unwell = Counter(name for record in records for name in sorted(record.unwell))
    if unwell:
        trials = sum(bool(record.unwell) for record in records)
        names = ", ".join(f"{name} {count}" for name, count in sorted(unwell.items()))
        yield f"{trials} of {len(records)} trials were begun though not all was well: {names}"
    for condition in sorted({record.condition for record in records}):
        trials_seals = [record.seals for record in records if record.condition == condition and record.seals]
        seals = set().union(*trials_seals)
        if len(seals) > 1:
            yield (
                f"THE EDGE'S CONFIGURATION CHANGES within condition {condition}: {len(seals)} of them in "
                f"{len(trials_seals)} trials"
            )


def _judge_notes(judges: Mapping[str, int], statuses: Mapping[str, int]) -> Iterable[str]:
    if len(judges) > 1:
        counts = " and ".join(f"{judges[name]} by {name}" for name in sorted(judges))
        yield f"THE JUDGE CHANGES within the study: trials are judged {counts}; they do not compare"
    if "map" in judges:
        yield (
            "reachability is judged by the map itself (no motion capture), which favours policies under "
            "which headset and robot drift together"
        )
    if "simulation" in judges:
        yield (
            "participants are simulated, not people; reachability is judged by the simulation's truth, and "
            "nobody rated anything"
        )
    if statuses:
        yield "the navigator's own status of goals: " + ", ".join(
            f"{name} {count}" for name, count in sorted(statuses.items())
        )


def _read_answers(path: Path, plan: StudyPlan) -> tuple[dict[str, F64], dict[str, tuple[str, ...]]]:
    """Read answers after trials (P, C) by question, and most and least preferred conditions."""
    people = {one.name: k for k, one in enumerate(plan.participants)}
    letters = {letter: k for k, letter in enumerate(plan.letters)}
    table = {one.name: np.full((len(people), len(letters)), math.nan) for one in plan.questions}
    choices = {kind: [""] * len(people) for kind in _CHOICES}
    for where, person, row in answer_rows(path, plan):
        with own_format_errors(Path(where)):
            if "answers" in row:
                _put_answers(
                    table,
                    row,
                    plan,
                    (people[person], letters[_known_letter(row["condition"], letters, where)]),
                    where,
                )
            for kind in _CHOICES:
                if row.get(kind) is not None:
                    if choices[kind][people[person]]:
                        raise DataError(f"{where}: {person} has said before which is {kind} preferred")
                    choices[kind][people[person]] = _known_letter(row[kind], letters, where)
    given = {kind: tuple(ones) for kind, ones in choices.items() if any(ones)}
    return {name: values for name, values in table.items() if np.isfinite(values).any()}, given


def _known_letter(letter: Any, letters: Mapping[str, int], where: str) -> str:
    if letter not in letters:
        raise DataError(f"{where}: condition {letter!s:.40} is not in the plan")
    return str(letter)


def _put_answers(
    table: Mapping[str, F64], row: Mapping[str, Any], plan: StudyPlan, cell: tuple[int, int], where: str
) -> None:
    questions = {one.name: one for one in plan.questions}
    for name, value in row["answers"].items():
        if name not in questions:
            raise DataError(f"{where}: question {name!s:.40} is not in the plan")
        if value is None:  # not answered
            continue
        asked = questions[name]
        if type(value) is not int or not asked.least <= value <= asked.greatest:
            raise DataError(
                f"{where}: {name}: {value!s:.40} is not a whole number from {asked.least} to {asked.greatest}"
            )
        if not math.isnan(table[name][cell]):
            raise DataError(f"{where}: {row['participant']} has answered {name} of {row['condition']} before")
        table[name][cell] = value


def read_table(path: Path, ranges: Ranges, choices_file: Path | None) -> Observations:
    """Read a CSV file: participant, condition, place (from 1, or empty), then a column for each measure.

    An empty cell is missing. Raises DataError that names the line.
    """
    lines = _csv_lines(path)
    head = [_composed(name) for name in lines[0][1]]
    ranges = {_composed(name): limits for name, limits in ranges.items()}
    if len(head) > len(_HEAD) + _MAX_MEASURES:
        raise DataError(f"{path}: has {len(head) - len(_HEAD)} measures; at most {_MAX_MEASURES} are read")
    is_named = all(name and name.isprintable() for name in head)
    if tuple(head[:3]) != _HEAD or len(head) < 4 or len(set(head)) < len(head) or not is_named:
        raise DataError(
            f"{path}: its first line must be participant,condition,place and a name for each measure, each "
            f"once"
        )
    for name in ranges:
        if name not in head[3:]:
            raise DataError(f"--range {name}: {path} has no such measure; it has {', '.join(head[3:])}")
    rows = [_CsvRow.read(f"{path}, line {number}", head, cells) for number, cells in lines[1:]]
    people, conditions = (
        tuple(sorted({getattr(row, name) for row in rows})) for name in ("participant", "condition")
    )
    if not MIN_CONDITIONS <= len(conditions) <= MAX_CONDITIONS or len(people) > MAX_PARTICIPANTS:
        raise DataError(
            f"{path}: {len(people)} participants and {len(conditions)} conditions; at most "
            f"{MAX_PARTICIPANTS}, and {MIN_CONDITIONS} to {MAX_CONDITIONS}, can be analysed"
        )
    shape = len(people), len(conditions)
    places = np.zeros(shape, np.int64)
    measures = {name: np.full(shape, math.nan) for name in head[3:]}
    seen: dict[tuple[str, str], str] = {}
    for row in rows:
        row.check(seen, len(conditions), ranges)
        cell = people.index(row.participant), conditions.index(row.condition)
        places[cell] = row.place
        for name, value in row.values.items():
            measures[name][cell] = value
    choices = {} if choices_file is None else _read_choices(choices_file, people, conditions)
    done = int(sum(np.isfinite(list(measures.values())).any(axis=0).ravel()))
    return Observations(people, conditions, measures, places, choices, planned=places.size, done=done)


def _csv_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Return the lines that are not empty, with their numbers; at least two."""
    with read_errors(path):
        text = read_text(path, _MAX_CSV_BYTES, "utf-8-sig")
    lines: list[tuple[int, list[str]]] = []
    try:
        reader = csv.reader(io.StringIO(text), strict=True)
        for row in reader:
            if any(cell.strip() for cell in row):
                lines.append((reader.line_num, row))
            if len(lines) > _MAX_CSV_LINES:
                raise DataError(f"{path}: has over {_MAX_CSV_LINES} lines, more than any study")
    except csv.Error as error:
        raise DataError(f"{path}: is not CSV: {error}") from None
    if len(lines) < 2:
        raise DataError(f"{path}: has no line of data below a line of names")
    return lines


@dataclass(frozen=True)
class _CsvRow:
    where: str
    participant: str
    condition: str
    place: int
    values: dict[str, float]

    @staticmethod
    def read(where: str, head: Sequence[str], cells: Sequence[str]) -> _CsvRow:
        if len(cells) != len(head):
            raise DataError(f"{where}: {len(cells)} cells; {len(head)} are wanted")
        participant, condition, place, *values = map(_composed, cells)
        if not all(name and name.isprintable() for name in (participant, condition)):
            raise DataError(f"{where}: participant or condition is empty, or not printable")
        if place and not place.isdecimal():
            raise DataError(f"{where}: place '{place:.40}' is not a whole number from 1")
        numbers = {name: _number(cell, name, where) for name, cell in zip(head[3:], values, strict=True)}
        return _CsvRow(where, participant, condition, int(place[:6] or 0), numbers)

    def check(self, seen: dict[tuple[str, str], str], conditions: int, ranges: Ranges) -> None:
        """Raise DataError for a participant twice in a condition or a place, or a value out of its range."""
        keys = [(self.participant, f"condition {self.condition}")]
        if self.place:
            keys.append((self.participant, f"place {self.place}"))
        if self.place > conditions:
            raise DataError(f"{self.where}: place {self.place}, where there are {conditions} conditions")
        for key in keys:
            if key in seen:
                raise DataError(
                    f"{self.where}: participant {key[0]} has {key[1]} a second time, first in {seen[key]}"
                )
            seen[key] = self.where.rpartition(", ")[2]
        for name, (low, high) in ranges.items():
            if self.values[name] < low or self.values[name] > high:
                raise DataError(f"{self.where}: {name} {self.values[name]:g} is outside {low:g} to {high:g}")


def _composed(cell: str) -> str:
    """Return a cell in Unicode form NFC: of two files that name a person, one may be decomposed."""
    return unicodedata.normalize("NFC", cell.strip())


def _number(cell: str, name: str, where: str) -> float:
    if not cell:
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not abs(value) < 1e9:
        raise DataError(
            f"{where}: {name}: '{cell:.40}' is not a number; leave the cell empty if it is missing"
        )
    return value


def _read_choices(path: Path, people: Sequence[str], conditions: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Read a CSV file with participant, most, least."""
    lines = _csv_lines(path)
    if [name.strip() for name in lines[0][1]] != ["participant", *_CHOICES]:
        raise DataError(f"{path}: its first line must be participant,most,least")
    chosen: dict[str, Sequence[str]] = {}
    for number, cells in lines[1:]:
        where = f"{path}, line {number}"
        person, *named = map(_composed, cells)
        if person not in people or person in chosen or len(named) != 2:
            reason = (
                "comes twice"
                if person in chosen
                else "has no trial"
                if len(named) == 2
                else "needs two more cells"
            )
            raise DataError(f"{where}: participant {person:.40} {reason}")
        for one in named:
            if one and one not in conditions:
                raise DataError(f"{where}: condition {one:.40} is not among {', '.join(conditions)}")
        chosen[person] = named
    return {
        kind: tuple(chosen[person][k] if person in chosen else "" for person in people)
        for k, kind in enumerate(_CHOICES)
    }
