"""`share study`, from the plan to the report."""

from __future__ import annotations

import csv
import html
import json
import re
import stat
import sys
from functools import partial
from pathlib import Path

import pytest
from helpers.study_folder import fill

from share.config import POLICY_NAMES
from share.lab.study.plan import read_key, read_plan


@pytest.fixture
def study(share, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return partial(share, "study")


def planned(study, *options: object) -> dict[str, str]:
    """Make a plan; return the policies by letter."""
    assert study("plan", "--out", "s", "--participants", 4, "--spots", 2, *options).code == 0
    return read_key(Path("s-key.json"), read_plan(Path("s"))).policies


def carry_out(policies: dict[str, str], participants: int | None = None) -> None:
    fill(Path("s"), read_plan(Path("s")), policies, participants)


def test_a_plan_and_its_key(study):
    done = study("plan", "--out", "s")
    assert done.code == 0
    assert "each condition in each place: 5 times" in done.out and "20 different orders of 20" in done.out
    assert sorted(path.name for path in Path("s").iterdir()) == ["floor.png", "plan.json"]
    assert "round and round at 0.5 m/s: 12.0 m, 24 s a round" in done.out
    assert stat.S_IMODE(Path("s-key.json").stat().st_mode) == 0o600
    assert len(read_plan(Path("s")).spots) == 10


def test_plan_and_unblinding_for_machines(study):
    drawn = json.loads(study("plan", "--out", "s", "--participants", 1, "--seed", 7, "--json").out)
    assert drawn == {"seed": 7, "plan": "s/plan.json", "picture": "s/floor.png", "key": "s-key.json"}
    policies = read_key(Path("s-key.json"), read_plan(Path("s"))).policies
    done = study("unblind", "s", "--key", "s-key.json", "--early", "--json")
    assert json.loads(done.out) == {"policies": policies, "trials_done": 0, "trials_planned": 4}


@pytest.mark.parametrize("kept", ["s/plan.json", "s/floor.png", "s-key.json"])
def test_nothing_is_overwritten(study, kept):
    planned(study)
    names = "s/plan.json", "s/floor.png", "s-key.json"
    for path in set(names) - {kept}:
        Path(path).unlink()
    content = Path(kept).read_bytes()
    done = study("plan", "--out", "s")
    assert done.code == 2 and f"{kept}: exists and is not overwritten" in done.err
    assert Path(kept).read_bytes() == content
    assert [path for path in names if Path(path).exists()] == [kept]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--key", "s/key.json"], "lies beside the plan"),
        (["--policy", "share"], "1 conditions; 2 to 8 can be balanced"),
        (["--policy", "share", "--policy", "share"], "one is given twice"),
        (["--policy", "shar"], "'shar' is not"),
        (["--space", "4"], "is not two numbers such as 4x4"),
        (["--space", "4xnan"], "is not two numbers such as 4x4"),
        (["--distance", "nan"], "'nan' is not a number"),
        (["--space", "4x-4"], "both must be positive"),
        (["--space", "1x1"], "nothing is left of 1 x 1 m"),
        (["--spots", "30", "--apart", "2"], "30 spots 2 m apart were not found"),
        (["--participants", "0"], "0 is not in the range"),
        (["--spots-file", "none.csv"], "does not exist"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(study, options, says):
    done = study("plan", "--out", "s", *options)
    assert done.code == 2 and says in done.err and done.err.count("\n") == 1
    assert not Path("s/plan.json").exists() and not Path("s-key.json").exists()


def test_what_is_blind_stays_blind(study):
    """No file of the study, no file of the report and no output has a policy's name."""
    policies = planned(study)
    carry_out(policies)
    texts = [study("analyze", "s", "--out", "report").out, study("analyze", "s", "--json").out]
    files = [p for folder in ("s", "report") for p in Path(folder).rglob("*") if p.is_file()]
    assert {p.name for p in files} >= {
        "plan.json",
        "events.jsonl",
        "answers.jsonl",
        "report.html",
        "study.png",
    }
    texts += [p.read_text() for p in files if p.suffix != ".png"]
    texts += [str(p) for p in files]
    pictures = [p.read_bytes().decode("latin-1") for p in files if p.suffix == ".png"]
    found = {name for text in texts for name in POLICY_NAMES if re.search(rf"\b{name}\b", text)}
    assert found == set() and not any("covins" in text for text in pictures)
    assert study("unblind", "s", "--key", "s-key.json").code == 0
    assert "covins-g" in study("analyze", "s", "--out", "report").out  # or the search finds nothing


def test_unblinding_early_is_refused_and_recorded(study):
    policies = planned(study)
    carry_out(policies, participants=3)
    done = study("unblind", "s", "--key", "s-key.json")
    assert done.code == 2 and "12 of 16 trials are done" in done.err and not Path("s/unblinded.json").exists()
    done = study("analyze", "s", "--key", "s-key.json")
    assert done.code == 2 and "12 of 16 trials are done" in done.err
    done = study("unblind", "s", "--key", "s-key.json", "--early")
    assert done.code == 0 and all(f"{letter}  {policy}" in done.out for letter, policy in policies.items())
    record = json.loads(Path("s/unblinded.json").read_text())
    assert (record["early"], record["done"], record["planned"]) == (True, 12, 16)
    done = study("analyze", "s", "--out", "report")
    assert done.code == 0 and "NOT THE WHOLE STUDY: 12 of 16 trials" in done.out
    assert "nblinded early, with 12 of 16 trials done" in Path("report/report.md").read_text()
    done = study("unblind", "s", "--key", "s-key.json", "--early")
    assert done.code == 2 and "exists and is not overwritten" in done.err


def test_an_edited_record_of_the_unblinding_is_noticed(study):
    carry_out(planned(study))
    assert study("unblind", "s", "--key", "s-key.json").code == 0
    record = Path("s/unblinded.json")
    record.write_text(
        record.read_text().replace("linear", "x").replace("equal", "linear").replace('"x"', '"equal"')
    )
    done = study("analyze", "s")
    assert done.code == 2 and "was edited, or is of another plan" in done.err


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"early": true', '"early": false'),
        ('"done": 12', '"done": 16'),
        ('"planned": 16', '"planned": 12'),
        ('"when": "2', '"when": "1'),
        ('"hmac_sha256": "', '"hmac_sha256": "0'),
    ],
)
def test_an_edited_note_of_early_unblinding_is_noticed(study, old, new):
    carry_out(planned(study), participants=3)
    assert study("unblind", "s", "--key", "s-key.json", "--early").code == 0
    record = Path("s/unblinded.json")
    text = record.read_text()
    assert old in text
    record.write_text(text.replace(old, new))
    done = study("analyze", "s")
    assert done.code == 2 and "was edited, or is of another plan" in done.err and done.err.count("\n") == 1


def test_a_swapped_key_is_noticed(study):
    policies = planned(study)
    carry_out(policies)
    key = Path("s-key.json")
    key.write_text(
        key.read_text().replace("linear", "LINEAR").replace("equal", "linear").replace("LINEAR", "equal")
    )
    for command in (("unblind", "s"), ("analyze", "s")):
        done = study(*command, "--key", key)
        assert done.code == 2 and "it was edited or swapped" in done.err


def test_policies_stand_in_place_of_letters(study):
    policies = planned(study)
    carry_out(policies)
    by_letter = json.loads(study("analyze", "s", "--json").out)
    by_key = json.loads(study("analyze", "s", "--key", "s-key.json", "--json").out)
    assert by_key["conditions"] == ["share", "covins-g", "linear", "equal"]
    assert by_letter["success"] == {"distance_m": 0.5, "timeout_s": 30.0}

    def means(found, measure):
        return {one["condition"]: one["mean"][0] for one in found["measures"][measure]["conditions"]}

    for k in range(len(by_letter["measures"])):
        lettered, named = means(by_letter, k), means(by_key, k)
        assert {policies[letter]: value for letter, value in lettered.items()} == pytest.approx(named)
    assert by_key["choices"]["most"]["counts"] == [4, 0, 0, 0]


def test_the_rule_of_success_is_settable_and_printed(study):
    carry_out(planned(study))
    strict = study("analyze", "s", "--distance", "0.05", "--timeout", "20")
    assert "stands within 0.05 m of the cube within 20 s" in strict.out
    found = json.loads(study("analyze", "s", "--distance", "0.05", "--json").out)
    assert {one["mean"][0] for one in found["measures"][0]["conditions"]} == {0.0}


@pytest.fixture
def ratings(tmp_path) -> Path:
    path = tmp_path / "ratings.csv"
    orders = ["ABC", "BCA", "CAB", "CBA", "ACB", "BAC"]
    rows = [
        f"p{n},{letter},{place},{4 + ord(letter) - 65 + (n * place) % 3},{n / place:.3f}"
        for n, order in enumerate(orders)
        for place, letter in enumerate(order, 1)
    ]
    path.write_text("participant,condition,place,rating,time\n" + "\n".join(rows) + "\n")
    return path


def test_a_table_of_another_study_is_analysed(study, ratings):
    Path("best.csv").write_text("participant,most,least\np0,A,B\np1,A,\np2,C,B\n")
    done = study("analyze", ratings, "--range", "rating=1:10", "--preferences", "best.csv", "--out", "report")
    assert done.code == 0 and "6 different orders of 6" in done.out and "most preferred" in done.out
    page = Path("report/report.html").read_text()
    assert "width=device-width" in page and page.count("data:image/png;base64") == 2
    rows = list(csv.DictReader(Path("report/tests.csv").read_text().splitlines()))
    assert [row["measure"] for row in rows] == ["rating", "time"]
    assert all(float(row["Friedman p"]) < 1 and float(row["place F"]) > 0 for row in rows)
    assert all(None not in row and None not in row.values() for row in rows)  # as many cells as names
    assert len(Path("report/pairs.csv").read_text().splitlines()) == 1 + 2 * 3
    assert r"\begin{tabular}" in Path("report/tables.tex").read_text()


@pytest.mark.parametrize(
    ("options", "says", "code"),
    [
        (["--range", "rating=1"], "is not NAME=LOW:HIGH", 2),
        (["--range", "rating=5:1"], "is not NAME=LOW:HIGH", 2),
        (["--range", "mood=1:5"], "has no such measure; it has rating, time", 1),
        (["--range", "rating=1:5"], "is outside 1 to 5", 1),
        (["--timeout", "3"], "--distance, --timeout: only with a study's folder", 2),
        (["--key", "none.json"], "no such file", 2),
    ],
)
def test_a_wrong_use_of_a_table_is_one_line(study, ratings, options, says, code):
    done = study("analyze", ratings, *options)
    assert done.code == code and says in done.err and done.err.count("\n") == 1


def test_a_folder_without_a_plan_or_trials_is_one_line(study):
    Path("empty").mkdir()
    done = study("analyze", "empty")
    assert done.code == 2 and "make one with `share study plan`" in done.err
    planned(study)
    done = study("analyze", "s")
    assert done.code == 1 and "nothing to analyse" in done.err
    done = study("analyze", "s", "--preferences", "s/plan.json")
    assert done.code == 2 and "are for a CSV file" in done.err


def test_an_edited_plan_is_noticed(study):
    planned(study)
    plan = Path("s/plan.json")
    plan.write_text(plan.read_text().replace('"timeout_s": 30.0', '"timeout_s": 60.0'))
    for command in (["analyze", "s"], ["unblind", "s", "--key", "s-key.json"]):
        done = study(*command)
        assert done.code == 2 and "was edited after it was made" in done.err


def test_a_program_without_scipy_stats_and_pandas_computes_all(study, ratings, monkeypatch):
    """The frozen program has neither."""
    for name in ("scipy.stats", "pandas"):
        monkeypatch.setitem(sys.modules, name, None)
    assert study("analyze", ratings, "--out", "report").code == 0


NAMES = ["[click](javascript:alert(1))", "![x](http://evil.test/p.png)", "<img src=http://evil.test>", "# x"]
NAMES += [
    "=1+2",
    "-a",
    "[s] time",
    "a*b*_c_`d`",
    "1. one",
    r"\<b> \[x](y)",
    "> quote",
    "- item",
    "x <https://evil.test>",
]


def test_names_of_a_file_stay_text_in_every_report(study, ratings):
    """Measures and conditions: no link, picture or title of HTML, no formula of CSV, no option of LaTeX."""
    lines = [line.split(",") for line in ratings.read_text().splitlines()]
    conditions = {"A": "[c](http://evil.test)", "B": "@sum(A1)", "C": r"*$\frac{$*"}
    rows = [[who, conditions[one], place, *[value] * len(NAMES)] for who, one, place, value, _ in lines[1:]]
    rows[0][3:-1] = [""] * (len(NAMES) - 1)  # so that names of measures begin lines of the report
    with ratings.open("w", newline="") as file:
        csv.writer(file).writerows([["participant", "condition", "place", *NAMES], *rows])
    Path("best.csv").write_text("participant,most,least\np0,@sum(A1),\n")
    assert study("analyze", ratings, "--preferences", "best.csv", "--out", "report").code == 0
    page = Path("report/report.html").read_text()
    assert "<a " not in page and "<em>" not in page and "<code>" not in page and page.count("<h1>") == 1
    assert page.count("<img ") == page.count('src="data:image/png') == 2
    assert "<ol>" not in page and "<blockquote>" not in page and page.count("<ul>") == 2
    for name in [*NAMES, *conditions.values()]:
        assert f"<td>{html.escape(name, quote=False)}</td>" in page
    for name in NAMES[:-1]:
        assert f"<li>{html.escape(name[0].upper() + name[1:], quote=False)}: 5 of 6" in page
    assert not re.search(r"(?<!\\)(?:\\\\)*<[a-z]", Path("report/report.md").read_text())
    for path in ("descriptives", "tests", "pairs"):
        for row in csv.DictReader(Path(f"report/{path}.csv").read_text().splitlines()):
            names = [row[key] for key in ("measure", "condition", "first", "second") if key in row]
            assert all(one[0] not in "=+-@" for one in names)
    assert re.search("'=1\\+2,'@sum", Path("report/descriptives.csv").read_text())
    latex = Path("report/tables.tex").read_text()
    assert "{}[s] time" in latex and not re.search(r"\\\\\s*(\\hline\s*)?[\[*]", latex)


def test_too_few_participants_have_figures_and_no_tests(study, ratings):
    lines = ratings.read_text().splitlines(keepends=True)
    ratings.write_text("".join(lines[:7]).replace("rating", "a|b"))
    done = study("analyze", ratings, "--out", "report")
    assert done.code == 0 and "2 of 2 participants are complete: too few for tests, which want 3" in done.out
    assert done.out.count("are complete") == 1
    (row, _) = csv.DictReader(Path("report/tests.csv").read_text().splitlines())
    assert (row["n"], row["Friedman p"], row["slope a place high"]) == ("2", "", "") and None not in row
    assert "<td>a|b</td>" in Path("report/report.html").read_text()
