"""How far a study is: what is left to do for each participant, by the files that are there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from share.errors import DataError, UsageError
from share.files.json_file import own_format_errors
from share.lab.study.plan import ANSWERS, Participant, StudyPlan
from share.lab.study.trials import answer_rows, read_trials


@dataclass(frozen=True)
class TrialStep:
    """A trial is to be carried through. done: goals that have had their end; is_begun: it was interrupted."""

    place: int
    condition: str
    done: frozenset[int]
    is_begun: bool
    last_s: float  # time of its last event, on its own clock


@dataclass(frozen=True)
class AnswerStep:
    """The questions after a trial are to be asked."""

    place: int
    condition: str


@dataclass(frozen=True)
class ChoiceStep:
    """The participant is to say which trial was best and worst. conditions: of those carried through, by
    place."""

    conditions: dict[int, str]


StudyStep = TrialStep | AnswerStep | ChoiceStep


@dataclass(frozen=True)
class StudyProgress:
    """What is left, by participant, in order."""

    plan: StudyPlan
    steps: dict[str, tuple[StudyStep, ...]]

    def choose(self, name: str | None) -> tuple[Participant, tuple[StudyStep, ...]]:
        """Return the participant of a name, or the next one, and what is left. Raises UsageError."""
        people = {one.name: one for one in self.plan.participants}
        left = [one for one in people if self.steps[one]]
        following = f"the next is {left[0]}" if left else "all participants have"
        if name is None:
            if not left:
                raise UsageError("all participants have done all trials; `share study unblind` comes next")
            return people[left[0]], self.steps[left[0]]
        if name not in people:
            first, last = self.plan.participants[0].name, self.plan.participants[-1].name
            raise UsageError(f"--participant {name}: not in the plan, which has {first} to {last}")
        if not self.steps[name]:
            raise UsageError(f"--participant {name}: has done all trials and answered; {following}")
        return people[name], self.steps[name]


def read_progress(folder: Path, plan: StudyPlan) -> StudyProgress:
    """Return how far a study is. Raises DataError for trials or answers that are not the plan's."""
    records = read_trials(folder, plan)  # checks them, too
    answered, chosen = _read_answered(folder / ANSWERS, plan)
    steps = {}
    for person in plan.participants:
        left: list[StudyStep] = []
        carried: dict[int, str] = {}
        for place, trial in enumerate(person.trials, 1):
            record = records.get((person.name, place))
            if record is None:
                left.append(TrialStep(place, trial.condition, frozenset(), False, 0.0))
            elif record.is_left:
                continue
            elif not record.is_complete:
                done = frozenset(number for number, goal in record.goals.items() if goal.has_ended)
                left.append(TrialStep(place, trial.condition, done, True, record.last_s))
            carried[place] = trial.condition
            if (person.name, trial.condition) not in answered:
                left.append(AnswerStep(place, trial.condition))
        if person.name not in chosen and len(carried) > 1:
            left.append(ChoiceStep(carried))
        steps[person.name] = tuple(left)
    return StudyProgress(plan, steps)


def _read_answered(path: Path, plan: StudyPlan) -> tuple[set[tuple[str, str]], set[str]]:
    """Return who has answered after which condition, and who has chosen. Raises DataError."""
    answered, chosen = set[tuple[str, str]](), set[str]()
    for where, person, row in answer_rows(path, plan):
        with own_format_errors(Path(where)):
            if "answers" in row:
                if row["condition"] not in plan.letters:
                    raise DataError(f"{where}: condition {row['condition']!s:.40} is not in the plan")
                answered.add((person, row["condition"]))
            else:
                chosen.add(person)
    return answered, chosen


def left_goals(step: TrialStep, person: Participant, plan: StudyPlan) -> list[tuple[int, int]]:
    """Return number and spot of the goals of a trial that are left."""
    trial = person.trials[step.place - 1]
    if trial.condition != step.condition:
        raise DataError(f"{person.name}, place {step.place}: is condition {trial.condition}")
    return [(number, spot) for number, spot in enumerate(trial.spots, 1) if number not in step.done]
