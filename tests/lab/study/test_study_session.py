"""What is left to do for a participant, and the questions at the researcher's terminal."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from helpers.study_folder import begin, goal_events, small_plan, write_lines

from share.errors import DataError, UsageError
from share.lab.study.asking import PageWords
from share.lab.study.plan import QUESTIONS
from share.lab.study.progress import AnswerStep, ChoiceStep, TrialStep, left_goals, read_progress
from share.lab.study.session import StudySession
from share.lab.study.study_room import EdgeOptions
from share.lab.study.trial_runner import TrialInterruptedError
from share.lab.study.trials import trial_folder

PLAN, _ = small_plan()
P01 = PLAN.participants[0]
LETTERS = [one.condition for one in P01.trials]


def write_trial(study: Path, place: int, goals: int, *more: dict[str, object]) -> None:
    spots = P01.trials[place - 1].spots
    lines = [begin(PLAN, "p01", place)]
    for k in range(goals):
        lines += goal_events(k + 1, spots[k], 5.0, 50.0 * (k + 1))
    write_lines(trial_folder(study, "p01", place) / "events.jsonl", [*lines, *more])


def end(t_s: float) -> dict[str, object]:
    return {"event": "end", "t_s": t_s}


def answer(place: int) -> dict[str, object]:
    return {"participant": "p01", "condition": LETTERS[place - 1], "answers": {"predictability": 5}}


def test_what_is_left_of_a_study_that_has_not_begun(tmp_path: Path) -> None:
    progress = read_progress(tmp_path, PLAN)
    person, steps = progress.choose(None)
    assert person == P01 and [type(one) for one in steps] == [*4 * (TrialStep, AnswerStep), ChoiceStep]
    assert steps[0] == TrialStep(1, LETTERS[0], frozenset(), False, 0.0)


def test_what_is_left_follows_from_the_files(tmp_path: Path) -> None:
    write_trial(tmp_path, 1, 2, end(130.0))
    write_lines(tmp_path / "answers.jsonl", [answer(1)])
    write_trial(tmp_path, 2, 1, {"event": "call", "t_s": 90.0, **_call(2, 2)})
    _, steps = read_progress(tmp_path, PLAN).choose("p01")
    assert steps[0] == TrialStep(2, LETTERS[1], frozenset({1}), True, 90.0)
    assert left_goals(steps[0], P01, PLAN) == [(2, P01.trials[1].spots[1])]
    write_trial(tmp_path, 2, 2, end(130.0))
    assert read_progress(tmp_path, PLAN).choose("p01")[1][0] == AnswerStep(2, LETTERS[1])


def _call(place: int, goal: int) -> dict[str, object]:
    spot = P01.trials[place - 1].spots[goal - 1]
    return {"goal": goal, "spot": spot, "cube_m": [1, 1], "robot_m": None}


def test_a_trial_that_is_left_is_not_asked_for_again(tmp_path: Path) -> None:
    left = {"event": "interrupted", "t_s": 60.0, "reason": "left by the researcher", "is_left": True}
    write_trial(tmp_path, 1, 1, left)
    _, steps = read_progress(tmp_path, PLAN).choose("p01")
    assert [getattr(one, "place", 0) for one in steps] == [2, 2, 3, 3, 4, 4, 0]
    assert steps[-1] == ChoiceStep({place: LETTERS[place - 1] for place in (2, 3, 4)})


def test_participants_that_are_not_there_or_done(tmp_path: Path) -> None:
    for place in range(1, 5):
        write_trial(tmp_path, place, 2, end(130.0))
    choice = {"participant": "p01", "most": "A", "least": None}
    write_lines(tmp_path / "answers.jsonl", [*map(answer, range(1, 5)), choice])
    progress = read_progress(tmp_path, PLAN)
    assert progress.choose(None)[0].name == "p02"
    with pytest.raises(UsageError, match="p01: has done all trials and answered; the next is p02"):
        progress.choose("p01")
    with pytest.raises(UsageError, match="not in the plan, which has p01 to p04"):
        progress.choose("p1")


def test_a_trial_of_another_plan_is_refused(tmp_path: Path) -> None:
    write_lines(trial_folder(tmp_path, "p01", 1) / "events.jsonl", [begin(PLAN, "p01", 1, plan="0")])
    with pytest.raises(DataError, match="was run by another plan"):
        read_progress(tmp_path, PLAN)


@dataclass
class TypingResearcher:
    typed: list[str]
    lines: list[str] = field(default_factory=list)
    end_reason: str = "ended by the researcher"

    def say(self, text: str) -> None:
        self.lines.append(text)

    def poll(self) -> str | None:
        return self.typed.pop(0) if self.typed else None

    def forget_typed(self) -> None:
        pass

    @property
    def wants_end(self) -> bool:
        return not self.typed


def session(folder: Path, *typed: str) -> tuple[StudySession, TypingResearcher]:
    researcher = TypingResearcher(list(typed))
    made = StudySession(folder, PLAN, folder / "key.json", EdgeOptions(), researcher, QUESTIONS, PageWords())
    return made, researcher


def answers(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (folder / "answers.jsonl").read_text().splitlines()]


def test_questions_at_the_terminal(tmp_path: Path) -> None:
    steps = [AnswerStep(1, "B"), ChoiceStep({1: "B", 3: "A"})]
    made, researcher = session(tmp_path, "12", "five", "5", "", "3", "3", "3", "2", "1", "end")
    made.lead(P01, steps)
    assert answers(tmp_path) == [
        {"participant": "p01", "condition": "B", "answers": {"predictability": 5, "responsiveness": None}},
        {"participant": "p01", "most": "A", "least": "B"},
    ]
    assert "'12' is not a whole number from 1 to 10" in researcher.lines
    assert researcher.lines.count("The same round cannot be both.") == 1
    assert "'five' is not a whole number from 1 to 10" in researcher.lines


def test_answers_that_were_broken_off_are_asked_again(tmp_path: Path) -> None:
    made, _ = session(tmp_path, "5")
    with pytest.raises(TrialInterruptedError, match="all that was done is kept"):
        made.lead(P01, [AnswerStep(1, "B")])
    assert not (tmp_path / "answers.jsonl").exists()


def test_a_torn_answer_costs_itself_only(tmp_path: Path) -> None:
    write_lines(tmp_path / "answers.jsonl", [answer(1)])
    with (tmp_path / "answers.jsonl").open("a") as file:
        file.write('{"participant": "p01", "cond')
    made, _ = session(tmp_path, "5", "6", "end")
    made.lead(P01, [AnswerStep(2, LETTERS[1])])
    assert [row["condition"] for row in answers(tmp_path)] == LETTERS[:2]


@pytest.mark.parametrize(
    ("given", "folder"),
    [
        ((), None),
        (("--keys", "a"), Path("a")),
        (("--keys=b",), Path("b")),
        (("--keys", "a", "--keys", "b"), Path("b")),
    ],
)
def test_the_edge_with_keys_gives_no_rights_to_all(given: tuple[str, ...], folder: Path | None) -> None:
    options = EdgeOptions(given)
    assert options.keys_folder == folder
    arguments = options.complete(Path("k.json"), "B", Path("out"))
    assert ("--allow" in arguments) == (folder is None)
    assert arguments[-6:] == ["--http", "0", "--blind", "k.json:B", "--out", "out"]
    assert "--http" not in EdgeOptions(("--http", "8080")).complete(Path("k"), "B", Path("o"))[2:-4]


def test_an_interrupted_trial_is_asked_about_and_left(tmp_path: Path) -> None:
    write_trial(tmp_path, 1, 1)
    _, steps = read_progress(tmp_path, PLAN).choose("p01")
    made, researcher = session(tmp_path, "leaf", " Leave ", "2", "3", "end")
    made.lead(P01, [*steps[:2], steps[-1]])  # of the trials, the first alone
    assert "p01, trial 1 was interrupted after 1 of its spots: Enter goes on" in researcher.lines[0]
    assert answers(tmp_path) == [{"participant": "p01", "most": LETTERS[1], "least": LETTERS[2]}]
    assert read_progress(tmp_path, PLAN).choose("p01")[1][0].place == 2  # type: ignore[union-attr]
