"""`share study run` and `share edge --blind`: what cannot be is one line, before an edge starts."""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from helpers.shell import Done
from helpers.study_folder import begin, fill, goal_events, write_lines

from share.cli.blind_edge import edge_settings
from share.cli.stderr import Stderr
from share.cli.study_run import TerminalResearcher
from share.errors import UsageError
from share.lab.study.plan import StudyKey, read_key, read_plan, sealed_settings
from share.lab.study.trials import trial_folder

Run = Callable[..., Done]


@pytest.fixture
def study(share: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.chdir(tmp_path)
    assert share("study", "plan", "--out", "s", "--participants", 4, "--spots", 2).code == 0
    return partial(share, "study", "run")


def key() -> StudyKey:
    return read_key(Path("s-key.json"), read_plan(Path("s")))


def begun(lines: int = 4, **last: Any) -> None:
    """Trial 1 of p01, interrupted after the first goal."""
    plan = read_plan(Path("s"))
    rows = [
        begin(plan, "p01", 1, judge="map"),
        *goal_events(1, plan.participants[0].trials[0].spots[0], 5.0, 9.0),
    ]
    write_lines(
        trial_folder(Path("s"), "p01", 1) / "events.jsonl", [*rows[: lines + 1], *([last] if last else [])]
    )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["none"], "none: has no plan.json"),
        (["s", "--participant", "p09"], "--participant p09: not in the plan, which has p01 to p04"),
        (["s", "--key", "none.json"], "no such file; the key is made with the plan"),
        (["s", "--resume", "--leave"], "give one of them"),
        (["s", "--", "--policy", "share"], "--policy: the study sets it; leave it out behind --"),
        (["s", "--", "--out=x"], "--out: the study sets it"),
        (["s", "--page", "x"], "'x' is not an address to serve at"),
        (["s", "--questions", "none.yaml"], "does not exist"),
    ],
)
def test_what_cannot_be_is_one_line(study: Run, options: list[str], says: str) -> None:
    done = study(*options)
    assert done.code == 2 and says in done.err and done.err.count("\n") == 1
    assert not Path("s/answers.jsonl").exists()


def test_an_edited_plan_and_a_swapped_key_are_refused(study: Run) -> None:
    text = Path("s/plan.json").read_text()
    Path("s/plan.json").write_text(text.replace('"timeout_s": 30.0', '"timeout_s": 60.0'))
    done = study("s")
    assert done.code == 2 and "plan.json: was edited after it was made" in done.err
    Path("s/plan.json").write_text(text)
    Path("s-key.json").write_text(Path("s-key.json").read_text().replace("linear", "fixed"))
    done = study("s")
    assert done.code == 2 and "is not the key that this plan was sealed with" in done.err


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ({"participant": ["p01"], "most": "A"}, "is damaged, or of another version"),
        ({"participant": "p99", "most": "A"}, "participant p99 is not in the plan"),
        ({"participant": "p01", "condition": "Z", "answers": {}}, "condition Z is not in the plan"),
        ({"most": "A"}, "is damaged, or of another version"),
    ],
)
def test_answers_that_are_not_the_plans_are_refused(study: Run, row: dict[str, Any], says: str) -> None:
    write_lines(Path("s/answers.jsonl"), [row])
    done = study("s")
    assert done.code == 1 and "answers.jsonl, line 1" in done.err and says in done.err, done.err
    assert done.err.count("\n") == 1


def test_no_blind_trial_follows_the_unblinding(study: Run, share: Run) -> None:
    assert share("study", "unblind", "s", "--key", "s-key.json", "--early").code == 0
    done = study("s")
    assert done.code == 2 and "the study was unblinded; no blind trial can follow" in done.err


def test_a_study_that_is_done_says_what_follows(study: Run) -> None:
    fill(Path("s"), read_plan(Path("s")), key().policies)
    done = study("s")
    assert done.code == 2 and "all participants have done all trials; `share study unblind`" in done.err
    done = study("s", "--participant", "p02")
    assert done.code == 2 and "p02: has done all trials and answered" in done.err


def test_two_at_a_time_are_refused(study: Run) -> None:
    Path("s/trials").mkdir()
    handle = os.open("s/trials", os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    done = study("s")
    os.close(handle)
    assert done.code == 2 and "another `share study run` leads this study; end that first" in done.err


def test_an_interrupted_trial_wants_an_answer(study: Run) -> None:
    begun()
    done = study("s")
    assert done.code == 2
    assert "p01, trial 1 was interrupted after 1 of its spots: give --resume to go on, or --leave" in done.err


def test_an_edge_that_does_not_start_is_one_line_and_the_trial_is_not_begun(study: Run) -> None:
    done = study("s", "--", "--bind", "tcp://127.0.0.1:0", "--map", "/dev/null/x")
    assert done.code == 1
    (line,) = [one for one in done.err.splitlines() if one.startswith("share: ")]
    assert "the edge did not start: " in line
    assert not (trial_folder(Path("s"), "p01", 1) / "events.jsonl").exists()
    assert study("s", "--", "--bind", "nowhere").code == 2


def test_a_trial_that_is_left_is_marked_and_not_asked_about(study: Run) -> None:
    begun()
    done = study("s", "--leave", "--", "--map", "/dev/null/x")
    assert done.code == 1 and "p01, trial 1 is left; the analysis counts it as missing" in done.err
    assert "p01, trial 2 of 4" in done.err
    events = [json.loads(one) for one in Path("s/trials/p01-1/events.jsonl").read_text().splitlines()]
    assert events[-1]["is_left"] and events[-1]["t_s"] == 14.0
    done = study("s", "--", "--map", "/dev/null/x")
    assert "p01, trial 2 of 4" in done.err and "was interrupted" not in done.err


def test_a_read_only_folder_is_one_line_without_an_option_of_others(
    study: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, *names: str) -> Path:
        raise UsageError(f"{path}: cannot be written to: Permission denied; give another --out")

    monkeypatch.setattr("share.files.writing.writable_dir", refuse)
    done = study("s")
    assert done.code == 2 and "--out" not in done.err
    assert "s/trials: cannot be written to: Permission denied; let it be written to" in done.err


def test_a_broken_key_does_not_tell_its_policies(study: Run, share: Run) -> None:
    text = Path("s-key.json").read_text()
    Path("s-key.json").write_text(text.replace('"covins-g"', '"covins-h"'))
    done = share("edge", "--bind", "tcp://127.0.0.1:0", "--blind", "s-key.json:A")
    assert done.code == 2 and done.err.count("\n") == 1
    assert "covins" not in done.err and "its policy is not known" in done.err


def test_the_end_of_stdin_is_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    os.write(write, b"first\n")
    os.close(write)
    with os.fdopen(read) as stdin, closing(Stderr()) as stderr:
        monkeypatch.setattr("sys.stdin", stdin)
        terminal = TerminalResearcher(stderr)
        typed = []
        end_s = time.monotonic() + 60
        while not terminal.wants_end and time.monotonic() < end_s:
            typed.append(terminal.poll())
            time.sleep(0.01)
    assert "first" in typed and terminal.wants_end
    assert terminal.end_reason == "stdin has ended, so nobody can press Enter: give it a terminal"


# ---------------------------------------------------------------- share edge --blind


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--blind", "s-key.json"], "expected KEY:LETTER"),
        (["--blind", "s-key.json:Z"], "the key has no 'Z', only A, B, C, D"),
        (["--blind", "none.json:A"], "no such file"),
        (["--blind", "s-key.json:A", "--policy", "share"], "leave out --policy, and edge.policy of --config"),
        (
            ["--blind", "s-key.json:A", "--config", "c.yaml"],
            "leave out --policy, and edge.policy of --config",
        ),
    ],
)
def test_a_blind_edge_that_cannot_be_is_one_line(
    study: Run, share: Run, options: list[str], says: str
) -> None:
    Path("c.yaml").write_text("edge: {policy: linear}\n")
    done = share("edge", "--bind", "tcp://127.0.0.1:0", *options)
    assert done.code == 2 and says in done.err and done.err.count("\n") == 1
    assert not any(name in done.err for name in ("linear", "covins-g"))


def test_a_blind_edge_runs_the_policy_of_its_letter_and_says_its_letter(study: Run) -> None:
    seals = set()
    for letter, policy in key().policies.items():
        settings, blinding = edge_settings(None, None, f"s-key.json:{letter}")
        assert settings.edge.policy == policy and blinding is not None
        report = blinding.covered({"policy": policy, "config": {"edge": {"policy": policy}}, "maps": {}})
        assert report == {"policy": letter, "config": {"sealed_sha256": blinding.seal}, "maps": {}}
        assert blinding.seal == key().seal(sealed_settings(settings))
        seals.add(blinding.seal)
    assert len(seals) == 4


def test_a_plan_has_no_policy_by_which_no_robot_drives(share: Run, tmp_path: Path) -> None:
    done = share("study", "plan", "--out", tmp_path / "x", "--policy", "share", "--policy", "streamed")
    assert done.code == 2 and "'streamed' is not" in done.err
