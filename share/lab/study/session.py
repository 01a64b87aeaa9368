"""One participant led through what is left: trials, the questions after each, and the choice at the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share.errors import UsageError
from share.lab.study import trial_events as te
from share.lab.study import trial_machine as tm
from share.lab.study.asking import LEAST, MOST, AskedForm, AskedItem, PageWords, choice_form, trial_form
from share.lab.study.plan import ANSWERS, Participant, StudyPlan, StudyQuestion
from share.lab.study.progress import AnswerStep, ChoiceStep, StudyStep, TrialStep, left_goals
from share.lab.study.question_page import QuestionPage
from share.lab.study.study_log import StudyLog
from share.lab.study.study_room import EdgeOptions, StudyRoom
from share.lab.study.trial_runner import Researcher, TrialHeader, TrialInterruptedError, TrialRunner
from share.lab.study.trials import EVENTS, trial_folder

_POLL_S = 0.05
GO_ON, LEAVE = "go on", "leave"


@dataclass(frozen=True)
class StudySession:
    """page: where the participant answers; None: at the terminal. resume: what becomes of an interrupted
    trial, GO_ON or LEAVE; None: the researcher is asked. is_asked: there is somebody to ask."""

    folder: Path
    plan: StudyPlan
    key: Path
    edge: EdgeOptions
    researcher: Researcher
    questions: tuple[StudyQuestion, ...]
    words: PageWords
    page: QuestionPage | None = None
    resume: str | None = None
    is_asked: bool = True

    def lead(self, person: Participant, steps: Sequence[StudyStep]) -> None:
        """Do all that is left for a participant. Raises TrialInterruptedError, ShareError."""
        left = set[int]()
        for step in steps:
            match step:
                case TrialStep():
                    if step.is_begun and self._fate(person, step) == LEAVE:
                        self._leave(person, step)
                        left.add(step.place)
                    else:
                        self._carry_out(person, step)
                case AnswerStep() if step.place not in left:
                    self._ask_about(person, step)
                case ChoiceStep():
                    there = {n: one for n, one in step.conditions.items() if n not in left}
                    if len(there) > 1:
                        self._ask_choice(person, there)
        self._say(f"{person.name} has done all trials; thank you")

    def _say(self, text: str) -> None:
        self.researcher.say(text)

    # ------------------------------------------------------------ trials

    def _carry_out(self, person: Participant, step: TrialStep) -> None:
        goals = [
            te.CalledSpot(number, spot, self.plan.spots[spot - 1])
            for number, spot in left_goals(step, person, self.plan)
        ]
        folder = trial_folder(self.folder, person.name, step.place)
        total = len(self.plan.spots)
        self._say(
            f"{person.name}, trial {step.place} of {len(person.trials)}: condition {step.condition}, "
            f"{len(goals)} of {total} spots; success is within {self.plan.success.distance_m:g} m in "
            f"{self.plan.success.timeout_s:g} s, judged by the shared map"
        )
        log = StudyLog(folder / EVENTS)
        fields = {
            "participant": person.name,
            "place": step.place,
            "condition": step.condition,
            "plan": self.plan.digest,
        }
        try:
            with StudyRoom(self.edge, self.key, step.condition, _next_edge(folder), self._say) as room:
                machine = tm.TrialMachine(goals, total, self.plan.success)
                runner = TrialRunner(room, log, self.researcher, machine)
                unwell = runner.wait_until_ready()
                runner.run(TrialHeader(fields, step.last_s), unwell)
        except TrialInterruptedError as error:
            where = f"{person.name}, trial {step.place}: {error}"
            raise TrialInterruptedError(
                f"{where}; all that was done is kept: run it again to go on"
            ) from None
        finally:
            log.close()
        if log.was_torn:
            self._say(f"{log.path}: its last line had been cut short and was taken away")

    def _fate(self, person: Participant, step: TrialStep) -> str:
        """Return whether an interrupted trial goes on, or is left."""
        if self.resume is not None:
            return self.resume
        what = f"{person.name}, trial {step.place} was interrupted after {len(step.done)} of its spots"
        if not self.is_asked:
            raise UsageError(f"{what}: give --resume to go on, or --leave to mark it as not carried through")
        self.researcher.forget_typed()
        self._say(f"{what}: Enter goes on with it; type 'leave' to mark it as not carried through")
        while (typed := self._typed().strip().lower()) not in ("", LEAVE):
            self._say(f"'{typed:.40}' is neither: Enter alone goes on; 'leave' marks it; q ends")
        return LEAVE if typed == LEAVE else GO_ON

    def _leave(self, person: Participant, step: TrialStep) -> None:
        log = StudyLog(trial_folder(self.folder, person.name, step.place) / EVENTS)
        line = {
            "event": "interrupted",
            "t_s": step.last_s,
            "reason": "left by the researcher",
            "is_left": True,
        }
        log.append(line)
        log.close()
        self._say(f"{person.name}, trial {step.place} is left; the analysis counts it as missing")

    def _typed(self) -> str:
        """Return the next line of the researcher. Raises TrialInterruptedError for Ctrl-C or q."""
        while not self.researcher.wants_end:
            if (line := self.researcher.poll()) is not None:
                return line
            time.sleep(_POLL_S)
        raise TrialInterruptedError(f"{self.researcher.end_reason}; all that was done is kept")

    # ------------------------------------------------------------ questions

    def _ask_about(self, person: Participant, step: AnswerStep) -> None:
        def keep(answers: Mapping[str, int | None]) -> None:
            about = {"participant": person.name, "condition": step.condition}
            self._append_answers({**about, "answers": dict(answers)})

        self._ask(trial_form(self.questions, self.words, step.place), keep)

    def _ask_choice(self, person: Participant, conditions: Mapping[int, str]) -> None:
        def keep(chosen: Mapping[str, int | None]) -> None:
            row: dict[str, Any] = {"participant": person.name}
            for kind in (MOST, LEAST):
                place = chosen[kind]
                row[kind] = None if place is None else conditions[place]
            self._append_answers(row)

        self._ask(choice_form(self.words, list(conditions)), keep)

    def _append_answers(self, row: Mapping[str, Any]) -> None:
        log = StudyLog(self.folder / ANSWERS)
        try:
            log.append(row)
        finally:
            log.close()

    def _ask(self, form: AskedForm, keep: Callable[[Mapping[str, int | None]], None]) -> None:
        """Ask until the answers are kept."""
        if self.page is None:
            keep(self._ask_here(form))
            return
        self.page.ask(form, keep)
        self._say(f"{form.heading}: the questions are on the page; type 'here' to ask them at this terminal")
        trouble = ""
        try:
            while self.page.answers() is None:
                if self.researcher.wants_end:
                    reason = self.researcher.end_reason
                    raise TrialInterruptedError(f"{reason}; the questions are asked again")
                typed = (self.researcher.poll() or "").strip()
                if typed.lower() == "here":
                    if self.page.withdraw() is None:
                        keep(self._ask_here(form))
                        return
                elif typed:
                    self._say(f"'{typed:.40}' does nothing; 'here' asks at this terminal, q ends")
                if self.page.trouble not in ("", trouble):
                    self._say(f"answers could not be stored, and are still on the page: {self.page.trouble}")
                trouble = self.page.trouble
                time.sleep(_POLL_S)
        finally:
            self.page.withdraw()
        self._say("answered")

    def _ask_here(self, form: AskedForm) -> dict[str, int | None]:
        self._say(form.heading)
        self.researcher.forget_typed()
        while True:
            try:
                return form.checked({one.name: self._ask_item(form, one) for one in form.items})
            except ValueError as error:  # of answers that are each well
                self._say(str(error))

    def _ask_item(self, form: AskedForm, item: AskedItem) -> int | None:
        ends = f" ({item.low} … {item.high})" if item.low or item.high else ""
        first, last = item.options[0][0], item.options[-1][0]
        self._say(f"{item.text} {first} to {last}{ends}; Enter alone: no answer")
        while text := self._typed().strip():
            try:
                return AskedForm(form.heading, (item,)).checked({item.name: int(text)})[item.name]
            except ValueError:
                self._say(f"'{text:.40}' is not a whole number from {first} to {last}")
        return None


def _next_edge(folder: Path) -> Path:
    """Return a new name for the files of an edge of this trial."""
    taken = {one.stem for one in folder.glob("edge-*")} if folder.is_dir() else set()
    return folder / next(name for k in range(1, 10_000) if (name := f"edge-{k}") not in taken)
