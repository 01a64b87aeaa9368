"""`share evaluate`: a session is played and scored, policies are compared."""

import csv
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from helpers.shell import Done


@pytest.fixture
def evaluate(share) -> Callable[..., Done]:
    """`share evaluate ARGUMENTS`."""
    return partial(share, "evaluate")


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def runs_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.long
def test_run_is_scored_compared_and_never_overwritten(evaluate, plain_session, tmp_path):
    out = tmp_path / "ablation"
    arguments = ("ablation", plain_session, "--policy", "covins-g", "--true-error", "--out", out)
    done = evaluate(*arguments)
    assert done.code == 0, done.err
    assert done.err == ""
    (run,) = (out / "runs").iterdir()
    assert {"config.yaml", "run.json", "edge", "ar1", "robot"} <= {path.name for path in run.iterdir()}
    assert "| AR latency, ms |" in (out / "report.md").read_text()
    text = (out / "report.md").read_text()
    assert "No agents met" in text  # so there is no map whose errors and merges could be drawn
    pictures = {"latency.png", "over-time.png", "where.png"}
    assert {name for name in pictures if f"]({name})" in text} == pictures
    assert text[: text.index("![")].strip() in done.out  # pictures are not for a terminal
    assert "![" not in done.out
    assert {path.name for path in out.glob("*.png")} == pictures
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == len(pictures)
    assert "<td>AR latency, ms</td>" in page.replace(' style="text-align: left;"', "")

    scored = evaluate("score", run, "--csv", tmp_path / "one.csv", "--plots", tmp_path / "plots")
    assert scored.code == 0, scored.err
    assert "policy covins-g, loopback, seed 0; in real time, evaluations report the true error" in scored.out
    assert {path.name for path in (tmp_path / "plots").iterdir()} == {
        f"{plain_session.name}-over-time.png",
        f"{plain_session.name}-where.png",
    }
    rows = rows_of(tmp_path / "one.csv")
    assert [row["agent"] for row in rows] == ["ar1", "ar2", "robot"]
    assert {row["frames"] for row in rows} == {"45"}
    assert rows == rows_of(out / "agents.csv")
    reported = json.loads(evaluate("score", run, "--json").out)["runs"][0]
    where = {"session": plain_session.name, "policy": "covins-g", "link": "", "seed": 0}
    assert reported["conditions"] == {
        **where,
        "clock": "real time",
        "error_source": "the true error",
        "code": reported["record"]["code"],
    }
    assert reported["agents"][0]["odom_n"] == 45
    edge = json.loads((run / "edge" / "edge.json").read_text())
    assert ("last_solve_s" in edge) == (edge["solve_ms"]["n"] > 0)
    assert reported["record"]["machine"]["cores"] >= 1
    assert reported["agents"][0]["latency_ms"] == pytest.approx(float(rows[0]["latency_ms"]), rel=1e-5)

    again = evaluate("run", plain_session, "--out", run)
    assert again.code == 2
    assert "give a new name" in again.err
    before = (run / "run.json").stat().st_mtime_ns
    models = tmp_path / "models.json"
    models.write_text('[{"name": "ours", "rmse_cm": 1, "mae_cm": 1, "rank": 1, "qoe_error": 0}]')
    assert evaluate(*arguments, "--with", models).code == 0  # there is nothing left to play
    assert "Error models" in (out / "report.html").read_text()
    assert (run / "run.json").stat().st_mtime_ns == before
    other = evaluate(*(word for word in arguments if word != "--true-error"))
    assert other.code == 2
    assert "was played with other options" in other.err


@pytest.mark.slow
def test_missing_runs_are_played_by_the_next_call(evaluate, plain_session, tmp_path):
    out = tmp_path / "two"
    arguments = ("ablation", plain_session, "--policy", "share", "--policy", "covins-g", "--out", out)
    assert evaluate(*arguments).code == 0
    kept, gone = sorted((out / "runs").iterdir())
    before = (kept / "run.json").stat().st_mtime_ns
    shutil.rmtree(gone)
    assert evaluate(*arguments).code == 0
    assert len(runs_in(out / "runs")) == 2
    assert (kept / "run.json").stat().st_mtime_ns == before


def test_wrong_use_is_refused_before_anything_is_played(evaluate, plain_session, tmp_path):
    for arguments, what in (
        (("run", plain_session, "--link", "wifi6", "--out", tmp_path / "r"), "wifi6"),
        (("run", plain_session, "--link", "bob=wifi5", "--out", tmp_path / "r"), "are ar1, ar2, robot"),
        (("run", plain_session, "--link", "shared-8", "--out", tmp_path / "r"), "in virtual time only"),
        (("run", tmp_path, "--out", tmp_path / "r"), "has no session.yaml; give a session"),
        (("run", tmp_path / "nosuch", "--out", tmp_path / "r"), "there is no such folder; give a session"),
        (("score", tmp_path), "has no run.json"),
        (("ablation", plain_session, plain_session, "--out", tmp_path / "r"), "two sessions have the name"),
    ):
        done = evaluate(*arguments)
        assert done.code in (1, 2)
        assert what in done.err
        assert done.err.count("\n") == 1
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in plain_session.glob("*.*"):
        shutil.copy(path, bare)
    done = evaluate("run", bare, "--out", tmp_path / "r")
    assert done.code == 2
    assert "scoring needs the truth of all agents" in done.err
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("settings", "given", "said"),
    [
        (
            "edge: {policy: linear}",
            ("--policy", "covins-g"),
            "edge.policy linear is overridden by policy covins-g",
        ),
        ("edge: {policy: linear}", ("--policy", "linear"), None),
        ("edge: {policy: linear}", (), None),
        ("control: {kp: 1}", ("--policy", "covins-g"), None),  # the file does not name a policy
        (
            "edge: {policy: share}",
            ("--policy", "covins-g"),
            "edge.policy share is overridden by policy covins-g",
        ),
        ("", ("--policy", "covins-g"), None),
    ],
)
@pytest.mark.parametrize("command", ["run", "sweep"])
def test_a_policy_other_than_that_of_the_settings_is_said(
    evaluate, plain_session, tmp_path, command, settings, given, said
):
    """It stops at --costs, before anything is played."""
    config = tmp_path / "c.yaml"
    config.write_text(settings)
    axis = ("--set", "control.kp=1") if command == "sweep" else ()
    done = evaluate(
        command, plain_session, *axis, *given, "--config", config, "--costs", "none", "--out", tmp_path / "r"
    )
    lines = [f"share: {config}: {said}"] if said else []
    assert done.err.splitlines()[:-1] == lines
    assert "--costs needs --virtual" in done.err


def test_ablation_says_that_the_policy_of_the_settings_is_not_played(evaluate, plain_session, tmp_path):
    config = tmp_path / "c.yaml"
    config.write_text("edge: {policy: streamed}")
    rest = ("--config", config, "--costs", "none", "--out", tmp_path / "r")
    first, *_ = evaluate("ablation", plain_session, *rest).err.splitlines()
    names = "share, share-paper, covins-g, linear, equal, random, fixed"
    assert first == f"share: {config}: edge.policy streamed is overridden by policies {names}"
    assert "edge.policy" not in evaluate("ablation", plain_session, "--policy", "streamed", *rest).err


def test_without_policy_that_of_the_settings_is_played(evaluate, plain_session, tmp_path):
    config = tmp_path / "c.yaml"
    config.write_text("edge: {policy: streamed}")
    done = evaluate("run", plain_session, "--virtual", "--config", config, "--out", tmp_path / "r")
    assert "policy streamed cannot be played in virtual time" in done.err


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["--virtual", "--agents-first"])  # the latter is in real time
def test_each_agent_can_have_its_own_link(evaluate, plain_session, tmp_path, clock):
    far, out = tmp_path / "far.yaml", tmp_path / "run"
    far.write_text("up: {delay_ms: 150}\ndown: {delay_ms: 150}\n")
    assert evaluate("run", plain_session, clock, "--link", f"wifi5,robot={far}", "--out", out).code == 0
    rtt_ms = {
        agent: json.loads((out / agent / "report.json").read_text())["protocol"]["rtt_ms"]
        for agent in ("ar1", "ar2", "robot")
    }
    assert rtt_ms["robot"] > 300
    assert max(rtt_ms["ar1"], rtt_ms["ar2"]) < 150


@pytest.mark.long
def test_a_run_in_virtual_time_cannot_be_looked_at(evaluate, plain_session, tmp_path):
    done = evaluate("run", plain_session, "--virtual", "--view", "--out", tmp_path / "out")
    assert done.code == 2 and "--view shows a run in real time" in done.err


@pytest.mark.slow
def test_same_seed_gives_the_same_virtual_run(evaluate, plain_session, tmp_path):
    """And odometry is that of real time, to the last digit."""
    virtual = ("--virtual", "--true-error", "--link", "wifi5")
    for name in ("one", "two"):
        assert evaluate("run", plain_session, *virtual, "--out", tmp_path / name).code == 0
    assert evaluate("run", plain_session, *virtual, "--seed", 1, "--out", tmp_path / "other").code == 0
    every_frame = tmp_path / "every-frame.yaml"  # also on a busy machine
    every_frame.write_text("agent: {late_ms: 0}")
    real = ("--config", every_frame, "--out", tmp_path / "real")
    assert evaluate("run", plain_session, *real).code == 0
    slow = tmp_path / "slow"
    shutil.copytree(tmp_path / "real", slow)
    times = {f"{step}_ms": {"n": 1, "p50": 5.0, "p95": 9.0} for step in ("place", "verify", "solve")}
    (slow / "edge" / "edge.json").write_text(json.dumps(times))  # so short a run may solve nothing
    for agent in ("ar1", "ar2", "robot"):
        report = json.loads((slow / agent / "report.json").read_text())
        report["track_ms"] |= {"p50": 15.0, "p95": 15.0}  # with a keyframe still less than a frame lasts
        (slow / agent / "report.json").write_text(json.dumps(report))
    assert evaluate("run", plain_session, *virtual, "--costs", slow, "--out", tmp_path / "as").code == 0
    rows = (tmp_path / "as/ar1/latency.csv").read_text().split()[1:]
    assert {row.split(",")[1] for row in rows} == {"15.000"}
    for agent in ("ar1", "ar2", "robot"):
        for file in ("odom.tum", "map.tum", "latency.csv"):
            one, two, other = (
                (tmp_path / run / agent / file).read_bytes() for run in ("one", "two", "other")
            )
            assert one == two
        assert one != other  # latencies are drawn
        odom, real = ((tmp_path / run / agent / "odom.tum").read_bytes() for run in ("one", "real"))
        assert odom == real


@pytest.mark.slow
def test_virtual_runs_can_be_parallel(evaluate, plain_session, tmp_path):
    """Two sessions by two policies; the table has them in the order that was asked for."""
    twin = tmp_path / "twin"
    shutil.copytree(plain_session, twin)
    out = tmp_path / "out"
    policies = ("--policy", "share", "--policy", "covins-g")
    done = evaluate("ablation", plain_session, twin, *policies, "--virtual", "--workers", 2, "--out", out)
    assert done.code == 0, done.err
    assert len(runs_in(out / "runs")) == 4
    assert "|  | share | covins-g |" in done.out
    rows = rows_of(out / "agents.csv")
    halves = [
        sorted(str({**row, "session": ""}) for row in rows if row["session"] == session.name)
        for session in (plain_session, twin)
    ]
    assert halves[0] == halves[1]  # whichever process played them
    refused = evaluate("ablation", twin, "--workers", 2, "--out", out)
    assert refused.code == 2
    assert "needs --virtual" in refused.err


@pytest.mark.slow
def test_sweep_keeps_existing_runs(evaluate, plain_session, tmp_path):
    out = tmp_path / "out"
    axes = ("--set", "control.kp=0.2,0.8", "--set", "control.rate_max_hz=2,5")
    arguments = ("sweep", plain_session, "--virtual", *axes, "--out", out)
    done = evaluate(*arguments)
    assert done.code == 0, done.err
    rows = rows_of(out / "sweep.csv")
    assert [(row["control.kp"], row["control.rate_max_hz"]) for row in rows] == [
        ("0.2", "2"),
        ("0.2", "5"),
        ("0.8", "2"),
        ("0.8", "5"),
    ]
    assert all(float(row["AR latency"]) > 5 for row in rows)
    assert (out / "sweep.md").read_text().strip() in done.out
    assert (out / "heat.png").read_bytes().startswith(b"\x89PNG")
    kept = {path: path.stat().st_mtime_ns for path in (out / "runs").glob("*/run.json")}
    shutil.rmtree(next(iter(kept)).parent)
    assert evaluate(*arguments).code == 0
    again = {path: path.stat().st_mtime_ns for path in (out / "runs").glob("*/run.json")}
    assert sum(again[path] == was for path, was in kept.items()) == 3

    drawn = evaluate(
        "sweep",
        plain_session,
        "--virtual",
        "--set",
        "control.kp=0.1:3",
        "--random",
        2,
        "--out",
        tmp_path / "r",
    )
    assert drawn.code == 0, drawn.err
    assert len(rows_of(tmp_path / "r" / "sweep.csv")) == 2
    assert evaluate("sweep", plain_session, "--set", "control.kpp=1", "--out", tmp_path / "x").code == 2
    assert not (tmp_path / "x").exists()
