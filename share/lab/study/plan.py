"""The plan of a study, which knows conditions by letters only, and the key to the letters, kept apart.

Researcher and participants work with `plan.json`. The key has a random salt, so its digest, which the plan
carries, tells a swapped key but not the policies: of four policies there are only 24 keys to try. The plan's
own digest tells an edited plan.
"""

from __future__ import annotations

import dataclasses
import hashlib
import hmac
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from share.config import POLICY_NAMES, Config
from share.errors import ConfigError, UsageError
from share.files.json_file import parse_json, read_json
from share.files.reading import MAX_SETTINGS_BYTES, read_errors, read_text
from share.lab.study.orders import Balance, draw_orders
from share.plain_data import MAX_NUMBER, from_mapping, to_mapping
from share.types import F64

PLAN, KEY, UNBLINDED, TRIALS, ANSWERS = "plan.json", "key.json", "unblinded.json", "trials", "answers.jsonl"
PAPER_POLICIES = ("share", "covins-g", "linear", "equal")
MAX_PARTICIPANTS = 1000
_PLAN_SCHEMA, _KEY_SCHEMA, _UNBLINDED_SCHEMA = "study plan 1", "study key 1", "study unblinded 1"
_LETTERS = "ABCDEFGH"


@dataclass(frozen=True)
class StudyQuestion:
    """A question after each trial. name: its column. low, high: what the least and greatest answer mean."""

    name: str
    text: str
    low: str
    high: str
    least: int = 1
    greatest: int = 10

    def __post_init__(self) -> None:
        if not self.least < self.greatest:
            raise ValueError(f"question {self.name}: least {self.least} is not below {self.greatest}")
        if not self.name.isprintable() or not self.name.strip():
            raise ValueError(f"question {self.name!r:.40}: its name is empty or not printable")


# Of the paper's two scales; the words are ours, as the paper's sheet is not public.
QUESTIONS = (
    StudyQuestion(
        "predictability",
        "How well could you tell beforehand where the robot would go?",
        "not at all",
        "always",
    ),
    StudyQuestion(
        "responsiveness", "How promptly did the robot answer when you called it?", "far too slowly", "at once"
    ),
)


@dataclass(frozen=True)
class SuccessRule:
    """A goal is reached if the robot stands within `distance_m` of the cube within `timeout_s` of the
    call."""

    distance_m: float = 0.5
    timeout_s: float = 30.0

    def __post_init__(self) -> None:
        if not (self.distance_m > 0 and self.timeout_s > 0):
            raise ValueError("distance and time-out must be positive")


@dataclass(frozen=True)
class PlannedTrial:
    """condition: its letter. spots: in the order in which they are visited, from 1."""

    condition: str
    spots: tuple[int, ...]


@dataclass(frozen=True)
class Participant:
    """An anonymous id, and the trials in their order."""

    name: str
    trials: tuple[PlannedTrial, ...]


@dataclass(frozen=True)
class StudyPlan:
    """Who meets which letter when, and where. Positions: x, y in m. path: walked by the researcher."""

    letters: tuple[str, ...]
    key_sha256: str
    spots: tuple[tuple[float, float], ...]
    path: tuple[tuple[float, float], ...]
    participants: tuple[Participant, ...]
    walk_m_s: float = 0.5
    success: SuccessRule = field(default_factory=SuccessRule)
    questions: tuple[StudyQuestion, ...] = QUESTIONS

    def __post_init__(self) -> None:
        for name, count in Counter(one.name for one in self.participants).items():
            if count > 1:
                raise ValueError(f"participant {name} is in it {count} times")
        for one in self.participants:
            if sorted(trial.condition for trial in one.trials) != sorted(self.letters):
                raise ValueError(f"participant {one.name} does not meet each condition once")
            wanted = list(range(1, len(self.spots) + 1))
            if any(sorted(trial.spots) != wanted for trial in one.trials):
                raise ValueError(f"participant {one.name} does not visit each spot once in each trial")

    @property
    def balance(self) -> Balance:
        """How often each condition is in each place and follows each other."""
        number = {letter: k for k, letter in enumerate(self.letters)}
        orders = [[number[trial.condition] for trial in one.trials] for one in self.participants]
        return Balance.of(np.array(orders))

    @property
    def digest(self) -> str:
        """SHA-256 of all that it says."""
        text = json.dumps(dataclasses.asdict(self), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class StudyKey:
    """policies: by letter, drawn with the salt: random, so that no digest tells them. seed: of spots and
    orders."""

    policies: dict[str, str]
    salt: str
    seed: str

    def __post_init__(self) -> None:
        for letter, name in self.policies.items():
            if name not in POLICY_NAMES:
                raise ValueError(f"{letter}: its policy is not known")  # nor told: a study may be blind

    def seal(self, config: str) -> str:
        """Return the digest by which a blind report shows a configuration, without telling it.

        config: its text (`sealed_settings`)."""
        return hashlib.sha256(f"{self.salt}\0{config}".encode()).hexdigest()

    def text(self) -> str:
        """Return the content of its file."""
        return json.dumps({"schema": _KEY_SCHEMA, **dataclasses.asdict(self)}, indent=1) + "\n"

    @property
    def digest(self) -> str:
        """SHA-256 of its file, which the plan carries."""
        return hashlib.sha256(self.text().encode()).hexdigest()


def sealed_settings(config: Config) -> str:
    """Return a configuration as the text that is sealed."""
    return json.dumps(to_mapping(config), sort_keys=True, separators=(",", ":"))


@dataclass(frozen=True)
class PlanWishes:
    """What is asked for. spots, path (N, 2), m; salt: random text."""

    participants: int
    policies: tuple[str, ...]
    spots: F64
    path: F64
    success: SuccessRule
    questions: tuple[StudyQuestion, ...] = QUESTIONS


def draw_plan(wishes: PlanWishes, seed: int, salt: str) -> tuple[StudyPlan, StudyKey]:
    """Draw letters by the salt; by the seed, orders of conditions and of the spots for each trial.

    A small seed is found again from the spots of the plan; the letters must not follow from it. Raises
    UsageError.
    """
    rng = np.random.default_rng([seed, 2])  # spots are drawn with [seed, 1]
    secret = np.random.default_rng(int.from_bytes(hashlib.sha256(salt.encode()).digest()))
    count = len(wishes.policies)
    if len(set(wishes.policies)) < count:
        raise UsageError("--policy: one is given twice; each condition has a policy of its own")
    letters = tuple(_LETTERS[:count])
    shuffled = [wishes.policies[k] for k in secret.permutation(count)]
    key = StudyKey(dict(zip(letters, shuffled, strict=True)), salt, str(seed))
    try:
        orders = draw_orders(count, wishes.participants, rng)
    except ValueError as error:
        raise UsageError(f"--policy: {error}") from None
    digits = max(2, len(str(wishes.participants)))
    spot_count = len(wishes.spots)
    people = tuple(
        Participant(
            f"p{number:0{digits}d}",
            tuple(PlannedTrial(letters[k], tuple((rng.permutation(spot_count) + 1).tolist())) for k in order),
        )
        for number, order in enumerate(orders, 1)
    )
    spots, path = (tuple((x, y) for x, y in points.tolist()) for points in (wishes.spots, wishes.path))
    plan = StudyPlan(
        letters, key.digest, spots, path, people, success=wishes.success, questions=wishes.questions
    )
    return plan, key


def plan_text(plan: StudyPlan) -> str:
    """Return the content of its file."""
    content = {"schema": _PLAN_SCHEMA, **dataclasses.asdict(plan), "sha256": plan.digest}
    lines = [f" {json.dumps(name)}: {_rows_text(value)}" for name, value in content.items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _rows_text(value: Any) -> str:
    """Return JSON, with a line for each participant or question."""
    if isinstance(value, tuple) and value and isinstance(value[0], dict):
        return "[\n  " + ",\n  ".join(map(json.dumps, value)) + "\n ]"
    return json.dumps(value)


def read_plan(folder: Path) -> StudyPlan:
    """Read the plan of a study's folder. Raises UsageError if there is none, ConfigError if it was edited."""
    path = folder / PLAN
    if not path.is_file():
        raise UsageError(f"{folder}: has no {PLAN}; make one with `share study plan`")
    data = _without_schema(read_json(path), _PLAN_SCHEMA, path)
    digest = data.pop("sha256", "")
    plan = from_mapping(StudyPlan, data, str(path), lowest=-MAX_NUMBER)
    if plan.digest != digest:
        raise ConfigError(
            f"{path}: was edited after it was made; restore it, since trials were run by the plan as it was"
        )
    return plan


def read_key(path: Path, plan: StudyPlan | None) -> StudyKey:
    """Read a key; plan: the one it must belong to. Raises ConfigError for another key, or a damaged one."""
    with read_errors(path, UsageError, missing="no such file; the key is made with the plan, once"):
        text = read_text(path, MAX_SETTINGS_BYTES)
    if plan is not None and hashlib.sha256(text.encode()).hexdigest() != plan.key_sha256:
        raise ConfigError(f"{path}: is not the key that this plan was sealed with; it was edited or swapped")
    try:
        data = parse_json(text)
    except ValueError as error:
        raise ConfigError(f"{path}: is damaged: {error}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: is not a key of a study")
    return from_mapping(StudyKey, _without_schema(data, _KEY_SCHEMA, path), str(path))


def _without_schema(data: dict[str, Any], schema: str, path: Path) -> dict[str, Any]:
    if data.pop("schema", None) != schema:
        raise ConfigError(f"{path}: is not a file of this kind and version ('{schema}')")
    return data


def read_questions(path: Path) -> tuple[StudyQuestion, ...]:
    """Read the list `questions` of a YAML file. Raises ConfigError."""
    from share.files.yaml_file import parse_yaml

    with read_errors(path, UsageError):
        text = read_text(path, MAX_SETTINGS_BYTES, "utf-8-sig")
    rows = parse_yaml(text, str(path)).get("questions")
    if not isinstance(rows, list) or not rows:
        raise ConfigError(f"{path}: questions: expected a list of questions")
    asked = tuple(
        from_mapping(StudyQuestion, row, f"{path}: question {number}", lowest=-MAX_NUMBER)
        for number, row in enumerate(rows, 1)
    )
    if len({one.name for one in asked}) < len(asked):
        raise ConfigError(f"{path}: two questions have the same name")
    return asked


def renamed(letters: Sequence[str], policies: Mapping[str, str], where: str) -> dict[str, str]:
    """Return the policy of each letter. Raises ConfigError that names a letter without one."""
    missing = [letter for letter in letters if letter not in policies]
    if missing:
        raise ConfigError(f"{where}: has no policy of {', '.join(missing)}; it has {', '.join(policies)}")
    return {letter: policies[letter] for letter in letters}


@dataclass(frozen=True)
class Unblinding:
    """The key, and how much of the study was done when it was told."""

    key: StudyKey
    when: str
    done: int
    planned: int
    early: bool

    @property
    def digest(self) -> str:
        """HMAC-SHA256 of all but the key, keyed by its salt.

        The salt stands in the same file, so this tells an edit by hand, not a forger who computes it anew.
        """
        text = json.dumps([self.when, self.done, self.planned, self.early])
        return hmac.new(self.key.salt.encode(), text.encode(), hashlib.sha256).hexdigest()


def unblinding_text(unblinding: Unblinding) -> str:
    """Return the content of its file."""
    fields = dataclasses.asdict(unblinding)
    content = {"schema": _UNBLINDED_SCHEMA, **fields, "hmac_sha256": unblinding.digest}
    return json.dumps(content, indent=1) + "\n"


def read_unblinding(study: Path, plan: StudyPlan) -> Unblinding | None:
    """Return what `share study unblind` wrote to a study's folder; None while it is blind."""
    path = study / UNBLINDED
    if not path.exists():
        return None
    data = _without_schema(read_json(path), _UNBLINDED_SCHEMA, path)
    digest = data.pop("hmac_sha256", "")
    unblinding = from_mapping(Unblinding, data, str(path))
    if unblinding.key.digest != plan.key_sha256 or unblinding.digest != digest:
        raise ConfigError(
            f"{path}: was edited, or is of another plan; remove it, and run `share study unblind` again"
        )
    return unblinding
