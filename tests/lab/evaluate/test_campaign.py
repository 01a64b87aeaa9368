"""The order in which sessions are played, and which earlier runs are used."""

import json
from pathlib import Path

import pytest
import yaml

from share.config import Config, with_policy
from share.errors import UsageError
from share.files.yaml_file import read_settings
from share.lab.evaluate import trial
from share.lab.evaluate.campaign import PlannedRun, plan_policies, play_job, run_all, split_jobs
from share.lab.evaluate.real_time import RunOptions
from share.lab.evaluate.trial import read_trial, run_trial, settings_yaml
from share.plain_data import from_mapping
from share.recordings.session import Session, read_session

TERMS = RunOptions("", "wifi5")


def session(folder: str) -> Session:
    return Session(Path(folder), {}, {})


def test_policies_take_turns_at_being_first():
    runs = plan_policies(
        [session("a"), session("b")], ("share", "covins-g", "equal"), [0, 1], TERMS, Path("out")
    )
    assert [run.out.name for run in runs] == [
        *("a-share-0", "a-covins-g-0", "a-equal-0"),
        *("b-covins-g-0", "b-equal-0", "b-share-0"),
        *("a-equal-1", "a-share-1", "a-covins-g-1"),
        *("b-share-1", "b-covins-g-1", "b-equal-1"),
    ]
    assert {(run.options.policy, run.options.link, run.options.seed) for run in runs[-1:]} == {
        ("equal", "wifi5", 1)
    }


def test_two_sessions_of_one_name_are_refused():
    with pytest.raises(UsageError, match="two sessions have the name room"):
        plan_policies([session("x/room"), session("y/room")], ("share",), [0], TERMS, Path("out"))


def test_a_policy_named_twice_is_played_once():
    assert len(plan_policies([session("a")], ("share", "share"), [0], TERMS, Path("out"))) == 1


@pytest.mark.parametrize(
    ("workers", "sizes"), [(1, [4, 4]), (2, [4, 4]), (3, [2, 2, 2, 2]), (7, [1] * 8), (50, [1] * 8)]
)
def test_no_worker_is_idle_while_a_session_has_runs(workers, sizes):
    runs = plan_policies([session("b"), session("a")], ("share", "covins-g"), [0, 1], TERMS, Path("out"))
    jobs = split_jobs(runs, workers)
    assert [len(job) for job in jobs] == sizes
    assert all(len({one.session.folder for one in job}) == 1 for job in jobs)
    assert sorted((one for job in jobs for one in job), key=runs.index) == runs


def test_each_seed_draws_anew_and_settings_come_back_as_they_were():
    texts = [settings_yaml(Config(), seed) for seed in (0, 3)]
    first, third = (from_mapping(Config, yaml.safe_load(text), "") for text in texts)
    assert first == Config()
    assert third.control.random_seed == first.control.random_seed + 3


def test_settings_of_a_run_have_the_policy_that_is_played(plain_session, tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "play_in_virtual_time", lambda *_: {})
    terms = RunOptions("linear", virtual=True)
    run_trial(read_session(plain_session), terms, Config(), tmp_path / "run", lambda now: None)
    assert read_settings(tmp_path / "run" / "config.yaml") == with_policy(Config(), "linear")


@pytest.fixture
def done(tmp_path) -> PlannedRun:
    """A run that is there, as far as files say."""
    made = session(str(tmp_path / "room"))
    made.folder.mkdir()
    (made.folder / "session.yaml").write_text(
        "schema: 1\nprovenance: {seed: 3}\nagents: {ann: {kind: ar, sensors: stereo, rate_hz: 15}}"
    )
    (one,) = plan_policies([made], ("share",), [0], TERMS, tmp_path / "runs")
    one.out.mkdir(parents=True)
    record = {"session": str(made.folder), "policy": "share", "link": "wifi5", "seed": 0}
    (one.out / "run.json").write_text(json.dumps(record | {"provenance": {"seed": 3}}))
    (one.out / "config.yaml").write_text(settings_yaml(Config(), 0))
    return one


def test_finished_runs_of_a_dead_worker_are_used(done):
    (came,) = play_job([done])
    assert came.folder == done.out


def test_runs_of_an_older_session_are_not_used(done):
    path = done.session.folder / "session.yaml"
    path.write_text(path.read_text().replace("seed: 3", "seed: 4"))
    with pytest.raises(UsageError, match="room was generated again since, with another truth; play it"):
        list(run_all([done], lambda number, now: None))


def test_runs_without_a_new_setting_are_used(done):
    one = done
    settings = yaml.safe_load(settings_yaml(Config(), 0))
    del settings["agent"]["error_model"]
    (one.out / "config.yaml").write_text(yaml.safe_dump(settings))
    ((planned, came),) = run_all([one], lambda number, now: None)
    assert planned is one
    assert came.folder == one.out

    settings["control"]["kp"] = 7.0
    (one.out / "config.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(UsageError, match="was played with other options or settings"):
        list(run_all([one], lambda number, now: None))


def test_runs_whose_settings_name_another_policy_than_was_played_are_used(done):
    """As 0.2.0 and older wrote them."""
    (done.out / "config.yaml").write_text(settings_yaml(with_policy(Config(), "equal"), 0))
    (came,) = play_job([done])
    assert came.folder == done.out


@pytest.mark.parametrize("text", ["{}", "[]", "{", json.dumps({"policy": "share"})])
def test_a_damaged_record_is_reported(tmp_path, text):
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(Exception, match=r"run\.json: is damaged"):
        read_trial(tmp_path)
