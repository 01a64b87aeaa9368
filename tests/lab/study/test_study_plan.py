"""Plans, keys, spots."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.study_folder import small_plan

from share.config import POLICY_NAMES
from share.errors import ConfigError, UsageError
from share.lab.study.plan import PAPER_POLICIES, plan_text, read_key, read_plan, read_questions
from share.lab.study.spots import Space, draw_spots, loop_path, read_points
from share.lab.study.trials import EVENT_KINDS


def save(folder: Path, text: str) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "plan.json").write_text(text)
    return folder


def test_a_plan_reads_back(tmp_path: Path) -> None:
    plan, key = small_plan(7)
    assert read_plan(save(tmp_path / "study", plan_text(plan))) == plan
    (tmp_path / "key.json").write_text(key.text())
    assert read_key(tmp_path / "key.json", plan) == key
    assert set(key.policies.values()) == set(PAPER_POLICIES)


def test_a_plan_names_no_policy() -> None:
    text = plan_text(small_plan(20)[0])
    assert [name for name in POLICY_NAMES if re.search(rf"\b{name}\b", text)] == []


def test_orders_follow_the_seed_and_letters_the_salt() -> None:
    """Who finds the seed from the spots of plan.json learns nothing of the letters."""
    plan, key = small_plan(8, seed=1)
    assert small_plan(8, seed=1) == (plan, key)
    others = [small_plan(8, seed=seed) for seed in range(2, 12)]
    assert len({one.participants for one, _ in others}) == 10
    salted = [small_plan(8, seed=1, salt=f"{n:032x}") for n in range(100)]
    assert {one.participants for one, _ in salted} == {plan.participants}
    assert len({tuple(one.policies.values()) for _, one in salted}) > 15
    spots = {trial.spots for one in plan.participants for trial in one.trials}
    assert spots == {(1, 2), (2, 1)}


def test_the_digest_of_a_key_does_not_tell_it() -> None:
    """Who knows all but the salt cannot try the 24 keys."""
    key = small_plan(4)[1]
    assert dataclasses.replace(key, salt="cd" * 16).seal("share") != key.seal("share") != key.seal("equal")


def edited(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"walk_m_s": 0.5', '"walk_m_s": 0.6', "was edited after it was made"),
        ('"timeout_s": 30.0', '"timeout_s": 90.0', "was edited after it was made"),
        ('"p02"', '"p01"', "participant p01 is in it 2 times"),
        ('"spots": [1, 2]', '"spots": [1, 1]', "does not visit each spot once"),
        ('"schema": "study plan 1"', '"schema": "study plan 9"', "is not a file of this kind and version"),
        ('"letters"', '"leters"', "did you mean 'letters'"),
        ("{", "", "is damaged"),
    ],
)
def test_an_edited_plan_is_noticed(tmp_path: Path, old: str, new: str, says: str) -> None:
    folder = save(tmp_path / "study", edited(plan_text(small_plan(6)[0]), old, new))
    with pytest.raises((ConfigError, Exception), match=says) as caught:
        read_plan(folder)
    assert caught.value.exit_code in (1, 2)  # type: ignore[attr-defined]


def test_a_swapped_key_is_noticed(tmp_path: Path) -> None:
    plan, key = small_plan()
    path = tmp_path / "key.json"
    letters = list(key.policies)
    swapped = key.policies | {letters[0]: key.policies[letters[1]], letters[1]: key.policies[letters[0]]}
    path.write_text(dataclasses.replace(key, policies=swapped).text())
    with pytest.raises(ConfigError, match="it was edited or swapped"):
        read_key(path, plan)
    path.write_text(small_plan(seed=6)[1].text())
    with pytest.raises(ConfigError, match="is not the key that this plan was sealed with"):
        read_key(path, plan)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[]", "is not a key"),
        ("{", "is damaged"),
        ("{}", "is not a file of this kind"),
        (
            json.dumps({"schema": "study key 1", "policies": {"A": "shar"}, "salt": "", "seed": "1"}),
            "not known",
        ),
    ],
)
def test_a_damaged_key_is_refused(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "key.json").write_text(text)
    with pytest.raises(ConfigError, match=says):
        read_key(tmp_path / "key.json", None)


def test_spots_keep_their_distances() -> None:
    for seed in range(5):
        spots = draw_spots(Space(4, 4, -2, -2), 10, 0.5, 0.8, np.random.default_rng(seed))
        gaps = np.linalg.norm(spots[:, None] - spots[None], axis=2)[np.triu_indices(10, 1)]
        assert np.abs(spots).max() <= 1.5 and gaps.min() >= 0.799
    assert loop_path(Space(4, 3), 0.5).tolist() == [
        [0.5, 0.5],
        [3.5, 0.5],
        [3.5, 2.5],
        [0.5, 2.5],
        [0.5, 0.5],
    ]


@pytest.mark.usefixtures("soon")
def test_spots_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UsageError, match="10 spots 2 m apart were not found"):
        draw_spots(Space(4, 4), 10, 0.5, 2.0, np.random.default_rng(1))
    with pytest.raises(UsageError, match="nothing is left of 4 x 4 m"):
        draw_spots(Space(4, 4), 1, 2.0, 0.1, np.random.default_rng(1))


def test_points_are_read_from_csv_and_yaml(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y\n1, 2\n\n3,1.5\n")
    (tmp_path / "a.yaml").write_text("spots: [[1, 2], [3, 1.5]]\n")
    for name in ("a.csv", "a.yaml"):
        assert read_points(tmp_path / name, "spots", 1, Space(4, 4)).tolist() == [[1, 2], [3, 1.5]]


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.csv", "", "0 points; 1 to 200"),
        ("a.csv", "1,2,3\n", "point 1: expected x and y"),
        ("a.csv", "1,b\n", "point 1: expected numbers"),
        ("a.csv", "1,nan\n", "not finite"),
        ("a.csv", "1,2\n1,5\n", "point 2, 1 5, is outside of the space"),
        ("a.yaml", "path: []\n", "'spots' is missing"),
        ("a.yaml", "spots: 3\n", "expected a list"),
        ("a.yaml", "spots: [3]\n", "point 1: expected x and y"),
    ],
)
def test_bad_points_are_refused(tmp_path: Path, name: str, text: str, says: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=says):
        read_points(tmp_path / name, "spots", 1, Space(4, 4))


def test_questions_are_read(tmp_path: Path) -> None:
    path = tmp_path / "questions.yaml"
    path.write_text("questions:\n- {name: ease, text: How easy, low: hard, high: easy, greatest: 7}\n")
    assert [(one.name, one.least, one.greatest) for one in read_questions(path)] == [("ease", 1, 7)]
    path.write_text("questions:\n- {name: ease, text: a, low: b, high: c, least: 7, greatest: 7}\n")
    with pytest.raises(ConfigError, match="least 7 is not below 7"):
        read_questions(path)
    path.write_text("questions: []\n")
    with pytest.raises(ConfigError, match="expected a list of questions"):
        read_questions(path)


FILES = (Path(__file__).resolve().parents[3] / "docs" / "lookup" / "files.md").read_text()


def first_column(title: str) -> list[str]:
    """Return the names in the first cells of the table below a heading."""
    part = FILES.partition(f"### `{title}`\n")[2].partition("\n###")[0]
    return re.findall(r"^\| `([\w ]+)` \|", part, re.MULTILINE)


def test_the_page_on_files_has_every_key_and_event() -> None:
    assert first_column("plan.json")[0:] == list(json.loads(plan_text(small_plan()[0])))
    assert first_column("trials/PARTICIPANT-PLACE/events.jsonl")[1:] == list(EVENT_KINDS)
