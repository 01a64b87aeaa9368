"""What a participant is asked after a trial and at the end, and which answers there are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share.errors import ConfigError, UsageError
from share.files.reading import MAX_SETTINGS_BYTES, read_errors, read_text
from share.lab.study.plan import StudyPlan, StudyQuestion, read_questions
from share.plain_data import from_mapping

MOST, LEAST = "most", "least"


@dataclass(frozen=True)
class PageWords:
    """What the page says beside the questions; `words` of a file of questions. {round}: a trial's place."""

    language: str = "en"
    heading: str = "After round {round}"
    last_heading: str = "After the last round"
    round: str = "Round {round}"
    most: str = "Which round did you like most?"
    least: str = "Which round did you like least?"
    same: str = "The same round cannot be both."
    send: str = "Send"
    incomplete: str = "Not all is answered. Press Send again to leave it so."
    thanks: str = "Thank you."
    wait: str = "The questions come here after each round."
    gone: str = "No connection. Your answers are kept here; please tell the researcher."


@dataclass(frozen=True)
class AskedItem:
    """One question. options: values and what stands on their buttons. low, high: what the first and the last
    mean; empty: nothing."""

    name: str
    text: str
    options: tuple[tuple[int, str], ...]
    low: str = ""
    high: str = ""


@dataclass(frozen=True)
class AskedForm:
    """What is asked at a time. Answers are values by item; None: not answered. same: what is said if two
    answers are the same, where they must not be; empty: they may."""

    heading: str
    items: tuple[AskedItem, ...]
    same: str = ""

    def checked(self, given: Mapping[str, Any]) -> dict[str, int | None]:
        """Return the answers, one for each item. Raises ValueError that says what is wrong."""
        unknown = [name for name in given if name not in {one.name for one in self.items}]
        if unknown:
            raise ValueError(f"'{unknown[0]!s:.40}' was not asked")
        answers: dict[str, int | None] = {}
        for one in self.items:
            value, values = given.get(one.name), [value for value, _ in one.options]
            if value is not None and (type(value) is not int or value not in values):
                wanted = f"a whole number from {min(values)} to {max(values)}"
                raise ValueError(f"{one.name}: {value!s:.40} is not {wanted}")
            if self.same and value is not None and value in answers.values():
                raise ValueError(self.same)
            answers[one.name] = value
        return answers


def trial_form(questions: tuple[StudyQuestion, ...], words: PageWords, place: int) -> AskedForm:
    """Return what is asked after a trial. place: from 1."""
    items = tuple(
        AskedItem(
            one.name,
            one.text,
            tuple((value, str(value)) for value in range(one.least, one.greatest + 1)),
            one.low,
            one.high,
        )
        for one in questions
    )
    return AskedForm(words.heading.replace("{round}", str(place)), items)


def choice_form(words: PageWords, places: list[int]) -> AskedForm:
    """Return what is asked at the end: the best and the worst of the trials at these places."""
    options = tuple((place, words.round.replace("{round}", str(place))) for place in places)
    items = AskedItem(MOST, words.most, options), AskedItem(LEAST, words.least, options)
    return AskedForm(words.last_heading, items, words.same)


def read_wording(path: Path, plan: StudyPlan) -> tuple[tuple[StudyQuestion, ...], PageWords]:
    """Read the plan's questions in another wording, and `words`. Raises ConfigError, also where they are not
    the same questions."""
    from share.files.yaml_file import parse_yaml

    questions = read_questions(path)
    asked, planned = (
        {one.name: (one.least, one.greatest) for one in ones} for ones in (questions, plan.questions)
    )
    if asked != planned:
        names = ", ".join(f"{name} {low} to {high}" for name, (low, high) in planned.items())
        raise ConfigError(
            f"{path}: asks something else than the plan, which has {names}; only words may differ"
        )
    with read_errors(path, UsageError):
        data = parse_yaml(read_text(path, MAX_SETTINGS_BYTES, "utf-8-sig"), str(path))
    words = data.get("words") if "words" in data else {}
    return questions, from_mapping(PageWords, words, f"{path}: words")
