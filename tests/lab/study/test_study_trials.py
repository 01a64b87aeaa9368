"""Trials, answers and tables: what is read of them, and what is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.study_folder import begin, fill, goal_events, small_plan, write_lines

from share.errors import DataError
from share.lab.study.observations import REPEATED_CALLS, read_study, read_table
from share.lab.study.plan import SuccessRule
from share.lab.study.study_analysis import analyse
from share.lab.study.study_tables import value_text
from share.lab.study.trials import REACHED, REACHED_LONGER, read_trials, trial_folder, trial_measures

RULE = SuccessRule()
PLAN, KEY = small_plan()
P01 = PLAN.participants[0].name
STANDS = goal_events(1, 1, 5.0, 9.0)[2]
STATUS = {"event": "status", "t_s": 14.0, "goal": 1}


def write_trial(study: Path, *lines: dict[str, Any]) -> Path:
    path = trial_folder(study, P01, 1) / "events.jsonl"
    write_lines(path, list(lines))
    return path


def measures(*goals: list[dict[str, Any]], study: Path, rule: SuccessRule = RULE) -> dict[str, float]:
    write_trial(
        study, begin(PLAN, P01, 1), *[line for goal in goals for line in goal], {"event": "end", "t_s": 99.0}
    )
    return trial_measures(read_trials(study, PLAN)[P01, 1].goals.values(), rule)


def test_success_is_a_stand_near_the_cube_in_time(tmp_path: Path) -> None:
    """The way is 3 m, so the longer time-out is 39.8 s."""
    found = measures(goal_events(1, 1, 29.9, 0.0), goal_events(2, 2, 35.0, 100.0), study=tmp_path)
    assert (found[REACHED], found[REACHED_LONGER]) == (50.0, 100.0)
    assert found["time until the robot stands there, s"] == 29.9
    assert found["time to first motion, s"] == 0.5
    assert found["path over straight line"] == pytest.approx(3.3 / 3)
    assert found["final distance, m"] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("took_s", "off_m", "rule", "reached"),
    [
        (30.0, 0.5, RULE, 100.0),
        (30.01, 0.1, RULE, 0.0),
        (10.0, 0.51, RULE, 0.0),
        (10.0, 0.51, SuccessRule(0.6, 30), 100.0),
        (30.01, 0.1, SuccessRule(0.5, 31), 100.0),
        (None, 0.0, RULE, 0.0),
    ],
)
def test_distance_and_time_out_are_the_rules(
    tmp_path: Path, took_s: float | None, off_m: float, rule: SuccessRule, reached: float
) -> None:
    goals = [goal_events(k, k, took_s, 100.0 * k, off_m) for k in (1, 2)]
    assert measures(*goals, study=tmp_path, rule=rule)[REACHED] == reached


def test_a_robot_that_stands_afar_and_then_comes_has_come(tmp_path: Path) -> None:
    far = goal_events(1, 1, 5.0, 0.0, off_m=2.0)
    near = goal_events(1, 1, 12.0, 0.0)[2:3]
    found = measures(far + near, goal_events(2, 2, None, 100.0), study=tmp_path)
    assert found[REACHED] == 50.0 and found["time until the robot stands there, s"] == 12.0


def test_a_goal_that_is_called_again_begins_anew(tmp_path: Path) -> None:
    lines = [
        *goal_events(1, 1, None, 10.0),
        {"event": "interrupted", "t_s": 50.0, "reason": "the edge is gone"},
        begin(PLAN, P01, 1),
        *goal_events(1, 1, 8.0, 200.0),
        *goal_events(2, 2, 8.0, 300.0),
        {"event": "end", "t_s": 400.0},
    ]
    write_trial(tmp_path, begin(PLAN, P01, 1), *lines)
    record = read_trials(tmp_path, PLAN)[P01, 1]
    assert record.is_complete and record.goals[1].reached_s(RULE) == 8.0


def test_repeated_calls_are_counted_by_spot(tmp_path: Path) -> None:
    fill(tmp_path, PLAN, KEY.policies)
    assert "repeated" not in " ".join(read_study(tmp_path, PLAN, RULE).notes)
    calls = [goal_events(1, 1, None, 10.0), goal_events(1, 1, None, 50.0), goal_events(1, 1, 8.0, 90.0)]
    calls += [goal_events(2, 2, None, 200.0), goal_events(2, 2, 8.0, 300.0)]
    assert REPEATED_CALLS not in read_study(tmp_path, PLAN, RULE).measures
    measures(*calls, study=tmp_path)
    table = read_study(tmp_path, PLAN, RULE)
    counts = table.measures[REPEATED_CALLS]
    letter = PLAN.letters.index(PLAN.participants[0].trials[0].condition)
    assert counts[0, letter] == 3 and counts.sum() == 3  # a measure, compared between conditions as others
    notes = table.notes
    assert any("3 calls were repeated" in note and note.endswith("spot 1 2, spot 2 1") for note in notes)


def test_a_power_cut_costs_one_line(tmp_path: Path) -> None:
    path = write_trial(tmp_path, begin(PLAN, P01, 1), *goal_events(1, 1, 8.0, 10.0))
    path.write_text(path.read_text() + '{"event": "ca')
    record = read_trials(tmp_path, PLAN)[P01, 1]
    assert not record.is_complete and record.goals[1].reached_s(RULE) == 8.0


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ([begin(PLAN, P01, 1, participant="p02")], "was run by participant p02, not p01"),
        ([begin(PLAN, P01, 1, place=2)], "was run by place 2, not 1"),
        ([begin(PLAN, P01, 1, condition="Z")], "was run by condition Z"),
        ([begin(PLAN, P01, 1, plan="0")], "was run by another plan"),
        ([begin(PLAN, P01, 1, judge="me")], "judge 'me'; known: mocap, map"),
        (goal_events(1, 1, 1.0, 1.0), "call before begin"),
        ([begin(PLAN, P01, 1), {"event": "dance"}], "event 'dance' is not known"),
        ([begin(PLAN, P01, 1), {"t_s": 1}], "line 2: is damaged"),
        ([begin(PLAN, P01, 1), {"event": "moves", "t_s": 1.0, "goal": 1}], "line 2: is damaged"),
        (
            [begin(PLAN, P01, 1), {**goal_events(1, 1, None, 1.0)[0], "cube_m": ["nan", 1]}],
            "'nan' is not a number",
        ),
        ([begin(PLAN, P01, 1), *goal_events(3, 1, None, 1.0)], "goal 3 at spot 1; the plan has 2"),
        ([begin(PLAN, P01, 1), *goal_events(1, 1, -5.0, 9.0)], "is before the call"),
        *(
            ([begin(PLAN, P01, 1), goal_events(1, 1, None, 1.0)[0] | changes], says)
            for changes, says in (
                ({"path_m": 1.1e6}, "is not from 0 to 1e.06 m"),
                ({"path_m": -1}, "path_m -1 is not from 0"),
                ({"spot": 1.9}, "1.9 is not a whole number"),
                ({"spot": True}, "True is not a whole number"),
                ({"spot": "2"}, "'2' is not a whole number"),
                ({"goal": 1.0}, "1.0 is not a whole number"),
                ({"spot": 3}, "goal 1 at spot 3; the plan has 2"),
                ({"robot_m": [1, -10001]}, "is beyond 10000 m"),
                ({"cube_m": [1e308, 1]}, "is beyond 10000 m"),
            )
        ),
        (
            [begin(PLAN, P01, 1), *goal_events(1, 1, 5.0, 9.0)[:2], STANDS | {"path_m": -0.1}],
            "path_m -0.1 is not from 0",
        ),
        (
            [begin(PLAN, P01, 1), *goal_events(1, 1, 5.0, 9.0)[:2], STANDS | {"robot_m": [2e4, 1]}],
            "is beyond 10000 m",
        ),
        (
            [
                *(begin(PLAN, P01, 1), *goal_events(1, 2, 5.0, 9.0), *goal_events(2, 2, 5.0, 99.0)),
                {"event": "end", "t_s": 200.0},
            ],
            "goals share spot 2; the plan visits each spot once",
        ),
        *(
            (
                [begin(PLAN, P01, 1), *goal_events(1, 1, None, 9.0), STATUS | {"status": status}],
                "status is not printable text",
            )
            for status in ("ok\n\n# x", "", "\x1b[2J", 3, "x" * 101)
        ),
        (
            [begin(PLAN, P01, 1), *goal_events(1, 1, 5.0, 9.0), {"event": "end"}],
            "complete, with 1 of 2 goals",
        ),
    ],
)
def test_wrong_events_are_refused_with_their_line(tmp_path: Path, lines: list[Any], says: str) -> None:
    write_trial(tmp_path, *lines)
    with pytest.raises(DataError, match=says):
        read_trials(tmp_path, PLAN)


@pytest.mark.parametrize("name", ["answers.jsonl", f"trials/{P01}-1/events.jsonl"])
def test_a_file_larger_than_any_trial_is_refused(tmp_path: Path, soon: None, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        for _ in range(30):
            file.write(b'{"event": "moves"}\n' * 50_000)
    with pytest.raises(DataError, match=f"{path.name}.*MB"):
        read_study(tmp_path, PLAN, RULE)


def test_a_trial_that_is_not_planned_is_refused(tmp_path: Path) -> None:
    write_lines(tmp_path / "trials" / "p99-1" / "events.jsonl", [])
    with pytest.raises(DataError, match="p99-1: the plan has no such trial"):
        read_trials(tmp_path, PLAN)


def add_answer(study: Path, row: dict[str, Any]) -> None:
    fill(study, PLAN, KEY.policies)
    path = study / "answers.jsonl"
    path.write_text(path.read_text() + json.dumps(row) + "\n")


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ({"participant": "p09", "answers": {}}, "p09 is not in the plan"),
        ({"participant": P01, "condition": "Z", "answers": {}}, "condition Z is not in the plan"),
        ({"participant": P01, "condition": "A", "answers": {"mood": 3}}, "question mood is not in the plan"),
        (
            {"participant": P01, "condition": "A", "answers": {"predictability": 11}},
            "11 is not a whole number from 1",
        ),
        (
            {"participant": P01, "condition": "A", "answers": {"predictability": 5.5}},
            "5.5 is not a whole number",
        ),
        (
            {"participant": P01, "condition": "A", "answers": {"predictability": 5}},
            "has answered predictability of A",
        ),
        ({"participant": P01, "most": "A"}, "p01 has said before which is most preferred"),
        ({"condition": "A"}, "is damaged"),
    ],
)
def test_wrong_answers_are_refused_with_their_line(tmp_path: Path, row: dict[str, Any], says: str) -> None:
    add_answer(tmp_path, row)
    with pytest.raises(DataError, match=f"answers.jsonl, line 21: .*{says}"):
        read_study(tmp_path, PLAN, RULE)


def test_half_a_study_is_analysed_as_what_it_is(tmp_path: Path) -> None:
    fill(tmp_path, PLAN, KEY.policies, participants=3)
    table = read_study(tmp_path, PLAN, RULE)
    assert (table.done, table.planned) == (12, 16)
    found = analyse(table)
    reached = found.measures[0]
    assert reached.complete == 3 and [one.count for one in reached.conditions] == [3] * 4
    assert reached.friedman is not None and reached.friedman.participants == 3


def test_a_study_without_trials_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nothing to analyse"):
        analyse(read_study(tmp_path, PLAN, RULE))


def test_an_unfinished_trial_is_missing_and_said(tmp_path: Path) -> None:
    fill(tmp_path, PLAN, KEY.policies)
    write_trial(tmp_path, begin(PLAN, P01, 1, judge="map"), *goal_events(1, 1, 8.0, 10.0))
    table = read_study(tmp_path, PLAN, RULE)
    assert table.done == 15 and np.isnan(table.measures[REACHED]).sum() == 1
    notes = " ".join(table.notes)
    assert "1 trials were begun and not carried through" in notes and "judged by the map" not in notes
    assert [one.complete for one in analyse(table).measures if one.name == REACHED] == [3]


def test_judges_that_change_and_cubes_that_lie_elsewhere_are_said(tmp_path: Path) -> None:
    fill(tmp_path, PLAN, KEY.policies)
    goals = [*goal_events(1, 1, 8.0, 10.0), *goal_events(2, 2, 8.0, 60.0)]
    cubes = [{**line, "cube_m": [2.0, 2.0]} if line.get("spot") == 2 else line for line in goals]
    write_trial(tmp_path, begin(PLAN, P01, 1, judge="map"), *cubes, {"event": "end", "t_s": 99.0})
    notes = read_study(tmp_path, PLAN, RULE).notes
    assert any("trials are judged 1 by map and 15 by mocap; they do not compare" in note for note in notes)
    assert any(
        "15 of 32 cubes lay more than 0.5 m from their planned spot, the farthest 1.41 m from spot 2" in note
        for note in notes
    )  # `fill` puts all at spot 1


def test_a_robot_whose_place_was_unknown_at_the_call(tmp_path: Path) -> None:
    goals = [goal_events(1, 1, 31.0, 10.0), goal_events(2, 2, 8.0, 60.0)]
    goals[0][0]["robot_m"] = None
    found = measures(*goals, study=tmp_path)
    assert (found[REACHED], found[REACHED_LONGER]) == (50.0, 50.0)  # no way is known, by which to wait longer
    assert found["path over straight line"] == pytest.approx(3.3 / 3)


def test_a_judge_that_changes_within_a_trial_is_refused(tmp_path: Path) -> None:
    write_trial(tmp_path, begin(PLAN, P01, 1), begin(PLAN, P01, 1, judge="map"))
    with pytest.raises(DataError, match="line 2: judge map, before mocap"):
        read_trials(tmp_path, PLAN)


def test_nobody_preferred_is_no_error(tmp_path: Path) -> None:
    fill(tmp_path, PLAN, KEY.policies, participants=3)
    path = tmp_path / "answers.jsonl"
    path.write_text(path.read_text() + '{"participant": "p04", "most": null, "least": "A"}\n')
    assert [ones[3] for ones in read_study(tmp_path, PLAN, RULE).choices.values()] == ["", "A"]


HEAD = "participant,condition,place,rating\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "has no line of data"),
        (HEAD, "has no line of data"),
        ("a,b\n1,2\n", "its first line must be participant,condition,place"),
        (
            HEAD + "p1,A,1,5\np1,A,2,6\np2,B,1,6\n",
            "line 3: participant p1 has condition A a second time, first in line 2",
        ),
        (HEAD + "p1,A,1,5\np1,B,1,6\n", "line 3: participant p1 has place 1 a second time"),
        (HEAD + "p1,A,1,5\np1,B,3,6\n", "place 3, where there are 2 conditions"),
        (HEAD + "p1,A,first,5\n", "place 'first' is not a whole number"),
        (HEAD + "p1,A,1,good\n", "rating: 'good' is not a number"),
        (HEAD + "p1,A,1,nan\n", "rating: 'nan' is not a number"),
        (HEAD + "p1,A,1,11\np1,B,2,1\n", "rating 11 is outside 1 to 10"),
        (HEAD + "p1,A,1\n", "line 2: 3 cells; 4 are wanted"),
        (HEAD.replace("rating", ""), "has no line of data"),
        (HEAD.replace("rating", "a\x1b[2J") + "p1,A,1,5\n", "its first line must be"),
        (HEAD + "p1\x1b,A,1,5\n", "is empty, or not printable"),
        (HEAD + ",A,1,5\n", "participant or condition is empty"),
        (HEAD + "p1,A,1,5\n", "1 participants and 1 conditions"),
        (HEAD + 'p1,"A,1,5\n', "is not CSV"),
    ],
)
def test_wrong_tables_are_refused_with_their_line(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DataError, match=says):
        read_table(tmp_path / "a.csv", {"rating": (1, 10)}, None)


def test_a_table_has_gaps(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(HEAD + "p2,A,1,5\np1,B,,7\np1,A,,\n")
    table = read_table(tmp_path / "a.csv", {}, None)
    assert table.participants == ("p1", "p2") and table.places.tolist() == [[0, 0], [1, 0]]
    assert np.array_equal(table.measures["rating"], [[math.nan, 7], [5, math.nan]], equal_nan=True)


def test_names_compare_composed(tmp_path: Path) -> None:
    """A name that macOS has decomposed is the same person."""
    (tmp_path / "a.csv").write_text(
        "participant,condition,place,g\u00fcte\nj\u00f6rg,A,1,5\njo\u0308rg,B,2,7\n"
    )
    (tmp_path / "b.csv").write_text("participant,most,least\njo\u0308rg,A,B\n")
    table = read_table(tmp_path / "a.csv", {"gu\u0308te": (1, 10)}, tmp_path / "b.csv")
    assert table.participants == ("j\u00f6rg",) and table.choices["most"] == ("A",)
    assert table.measures["g\u00fcte"].tolist() == [[5.0, 7.0]]


def test_a_table_larger_than_any_study_is_refused(tmp_path: Path, soon: None) -> None:
    (tmp_path / "a.csv").write_text(HEAD + "p,A,1,5\n" * 9000)
    with pytest.raises(DataError, match="has over 8001 lines"):
        read_table(tmp_path / "a.csv", {}, None)
    (tmp_path / "a.csv").write_text(HEAD + "p,A,1,5\n" * 2_000_000)
    with pytest.raises(DataError, match="MB"):
        read_table(tmp_path / "a.csv", {}, None)
    (tmp_path / "a.csv").write_text(
        ",".join(["participant", "condition", "place", *map(str, range(101))]) + "\np,A,1\n"
    )
    with pytest.raises(DataError, match="has 101 measures; at most 100"):
        read_table(tmp_path / "a.csv", {}, None)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1e-8, "1e-08"),
        (-3.4e-5, "-3.4e-05"),
        (0.004, "0.004"),
        (0.0, "0.00"),
        (-1e-17, "0.00"),
        (1.005, "1.00"),
        (-0.2, "-0.20"),
        (math.nan, "–"),
    ],
)
def test_a_small_value_is_not_shown_as_none(value: float, text: str) -> None:
    assert value_text(value) == text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("who,most,least\np1,A,B\n", "its first line must be participant,most,least"),
        ("participant,most,least\np1,A,B\np1,B,A\n", "participant p1 comes twice"),
        ("participant,most,least\np7,A,B\n", "participant p7 has no trial"),
        ("participant,most,least\np1,A,C\n", "condition C is not among A, B"),
        ("participant,most,least\np1,A\n", "needs two more cells"),
    ],
)
def test_wrong_preferences_are_refused(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "a.csv").write_text(HEAD + "p1,A,1,5\np1,B,2,7\n")
    (tmp_path / "b.csv").write_text(text)
    with pytest.raises(DataError, match=says):
        read_table(tmp_path / "a.csv", {}, tmp_path / "b.csv")


def test_what_was_not_as_it_should_be_is_told(tmp_path: Path) -> None:
    end, trial = {"event": "end", "t_s": 2000.0}, PLAN.participants[0].trials[0]
    other = next(one for one in PLAN.participants[1:] if one.trials[0].condition != trial.condition)
    moved = {"event": "cube moved", "t_s": 101.0, "goal": 1, "cube_m": [1.5, 1.0]}
    floor = {"event": "floor moved", "t_s": 102.0, "goal": 1, "moved_m": 0.4}
    taken = {"event": "cube moved", "t_s": 201.0, "goal": 2, "cube_m": None}

    def notes(*more: dict[str, Any], **begins: Any) -> str:
        goals = goal_events(1, 1, 5.0, 100.0), goal_events(2, 2, 5.0, 200.0)
        write_trial(tmp_path, begin(PLAN, P01, 1, **begins), *goals[0], *goals[1], *more, end)
        path = trial_folder(tmp_path, other.name, 1) / "events.jsonl"
        write_lines(path, [begin(PLAN, other.name, 1, config_sha256="cd"), *goals[0], *goals[1], end])
        return "\n".join(read_study(tmp_path, PLAN, RULE).notes)

    well = notes(config_sha256="ab", unwell=[])  # another condition has another configuration
    assert not any(words in well for words in ("moved", "not all was well", "CHANGES"))
    told = notes(moved, moved, taken, floor, unwell=["clocks", "robot"])
    assert "2 of 4 cubes were moved or removed after they had called" in told
    assert "the floor's marker moved during 1 of 2 trials" in told
    assert "1 of 2 trials were begun though not all was well: clocks 1, robot 1" in told
    again = begin(PLAN, P01, 1, config_sha256="ef")  # after an interruption
    changed = notes(again, config_sha256="ab")
    assert f"CONFIGURATION CHANGES within condition {trial.condition}: 2 of them in 1 trials" in changed
    write_trial(tmp_path, begin(PLAN, P01, 1), *goal_events(1, 1, 5.0, 100.0), taken)
    with pytest.raises(DataError, match="goal 2 was not called"):
        read_study(tmp_path, PLAN, RULE)
