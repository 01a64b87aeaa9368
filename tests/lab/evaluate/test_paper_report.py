"""The rows of `share evaluate paper`, against figures computed by hand."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

from share.config import Config
from share.lab.evaluate.paper_plan import FULL, GAINS, POLICIES, QUICK, plan_runs
from share.lab.evaluate.paper_report import merges_table, summary_rows, table_of, trajectory_table
from share.lab.evaluate.run_metrics import AgentMetrics, Conditions, RunMetrics
from share.lab.evaluate.views_of_others import DriftBesideOthers
from share.lab.train.score import ErrorModelScore
from share.recordings.session import Session

DRIFT = DriftBesideOthers(0.01**2 * 4, 4, 0.005**2 * 9, 9)


def agent(name: str, kind: str, **known: float) -> AgentMetrics:
    blank = {f.name: 0 if f.type == "int" else math.nan for f in dataclasses.fields(AgentMetrics)}
    return AgentMetrics(**{**blank, "agent": name, "kind": kind, **known})  # type: ignore[arg-type]


def run(policy: str, session: str, ms: float, merges: tuple[int, int]) -> RunMetrics:
    ann = agent("ann", "ar", latency_ms=ms, ate_cm=1.0, metres=10.0, rpe_1s_cm=0.4, qoe=0.8, rpe_frame_cm=0.1)
    bot = agent("bot", "robot", latency_ms=2 * ms, ate_cm=2.0, metres=10.0, qoe=0.9)
    asked, skipped = merges
    terms = Conditions(session, policy, "wifi5", 0)
    return RunMetrics(terms, (ann, bot), 2, 1.5, asked, skipped, asked - skipped)


RUNS = [
    run("covins-g", "warehouse-1", 20.0, (100, 0)),
    run("share", "warehouse-1", 10.0, (50, 10)),
    run("share-paper", "warehouse-1", 12.0, (60, 10)),
    run("covins-g", "firestation-1", 20.0, (100, 0)),
    run("share", "firestation-1", 15.0, (60, 20)),
]


def rows() -> dict[str, str]:
    streamed = [run("streamed", "warehouse-1", 40.0, (0, 0))]
    found = summary_rows(RUNS, streamed, DRIFT, [ErrorModelScore("tree", 2.0, 1, 1, 1, cpu_ms=3.0)])
    assert all(row.paper and row.why for row in found)
    return {row.of: row.here for row in found}


def test_each_figure_has_its_row() -> None:
    here = rows()
    assert here["AR latency, ms"].startswith("12.5 (`share-paper` 12, `covins-g` 20)")
    below = here["AR latency below `covins-g`'s"]
    assert below.startswith("37.5 %")
    assert "warehouse 50.0 %" in below and "firestation 25.0 %" in below
    assert here["AR latency of `streamed`, ms"] == "40.0"
    assert here["merges a metre"].startswith("2 against 5")
    assert "60.0 %" in here["merges a metre"] and "30 of 110 (27 %) skipped" in here["merges a metre"]
    assert here["better than `covins-g` by ATE"] == "4 of 4"
    assert here["error estimator"] == "tree: 2.00 cm in 3.0 ms"
    assert "1.00 cm while another is in view, 0.50 cm" in here["observation 2: dynamic scenes"]


def test_what_was_not_played_is_said() -> None:
    found = {row.of: row.here for row in summary_rows(RUNS, [], DriftBesideOthers(), [])}
    assert found["AR latency of `streamed`, ms"] == "not played"
    assert found["error estimator"] == "not compared in this run"
    assert "–" in found["observation 2: dynamic scenes"]
    assert "nan" not in table_of(summary_rows(RUNS, [], DriftBesideOthers(), []))


def test_tables_by_trajectory() -> None:
    text = trajectory_table(RUNS, "latency_ms", ".1f")
    assert "| warehouse-1 | ann | 20.0 | 10.0 | 12.0 |" in text
    assert "| firestation-1 | bot | 40.0 | 30.0 | – |" in text
    assert "| firestation-1 | 5.00 | 2.00 | – |" in merges_table(RUNS)


def test_the_plan_plays_every_policy_every_gain_and_streams(tmp_path: Path) -> None:
    for plan in (QUICK, FULL):
        sessions = [Session(tmp_path / name, {}, {}) for name in plan.sessions]
        runs = plan_runs(plan, sessions, Config(), tmp_path)
        assert {one.options.policy for one in runs.compared} == set(POLICIES)
        assert len(runs.compared) == len(POLICIES) * len(sessions) * plan.seeds
        assert all(one.options.virtual for one in runs.compared)
        assert len(runs.streamed) == plan.streamed and not any(one.options.virtual for one in runs.streamed)
        assert set(runs.swept) == set(GAINS)
        for (a, b), swept in runs.swept.items():
            assert len(swept) == len(plan.gains[a]) * len(plan.gains[b])
        assert len({one.out for one in runs.all}) == len(runs.all)
