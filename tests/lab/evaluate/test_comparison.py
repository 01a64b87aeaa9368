"""Comparison of policies against figures computed by hand."""

import dataclasses
import math
from types import SimpleNamespace

import pytest

from share.lab.evaluate import report_charts
from share.lab.evaluate.policy_report import best_in_bold, latex_table, markdown
from share.lab.evaluate.run_metrics import AgentMetrics, Conditions, RunMetrics
from share.lab.evaluate.statistics import (
    MEASURES,
    compare_policies,
    count_no_worse,
    count_no_worse_on_average,
    policy_names,
)

NAN = math.nan


def agent(name: str, kind: str, **known: float) -> AgentMetrics:
    """Everything else is 0 or unknown."""
    blank = {f.name: 0 if f.type == "int" else NAN for f in dataclasses.fields(AgentMetrics)}
    return AgentMetrics(**{**blank, "agent": name, "kind": kind, **known})  # type: ignore[arg-type]


def run(
    policy: str,
    session: str,
    latency: tuple[float, float],
    ate: tuple[float, float],
    done: int,
    seed: int = 0,
) -> RunMetrics:
    agents = tuple(
        agent(name, kind, latency_ms=ms, ate_cm=cm, metres=10.0)
        for name, kind, ms, cm in zip(("ann", "bot"), ("ar", "robot"), latency, ate, strict=True)
    )
    return RunMetrics(Conditions(session, policy, "wifi5", seed), agents, 2, 1.0, 2 * done, 0, done)


RUNS = [
    run("covins-g", "one", (20.0, 40.0), (1.0, 2.0), 100),
    run("share", "one", (10.0, 40.0), (1.0, 3.0), 20),
    run("share", "two", (20.0, 44.0), (0.9, NAN), 10),
    run("covins-g", "two", (30.0, 40.0), (1.0, 2.0), 50),
    run("covins-g", "three", (500.0, 500.0), (9.0, 9.0), 900),  # share has not played it
]


RECORD = {
    "machine": {"cpu": "a CPU", "cores": 2, "system": "Linux", "load": 0.5},
    "began": "2026-11-27",
    "version": "0.3.0",
}
TRIALS = [SimpleNamespace(record=RECORD)]


def test_errors_are_those_of_the_first_policy_beside_the_base():
    """Whether or not the base is named first."""
    for runs in (RUNS, RUNS[1:] + RUNS[:1]):
        text = markdown(runs, TRIALS, "covins-g")
        assert "## Errors with `share`" in text
        assert "against `covins-g`: 2 of 3 ATEs in the shared map are no larger" in text
        assert "share a map" not in text.replace("in which it shared a map", "")  # as they did in all runs


def unmet(of: RunMetrics) -> RunMetrics:
    """The run, if its agents had not met."""
    agents = tuple(dataclasses.replace(one, ate_cm=NAN) for one in of.agents)
    return dataclasses.replace(of, agents=agents, agents_in_largest_map=0, joint_ate_cm=NAN, merges_done=0)


def test_the_report_says_where_agents_never_met():
    text = markdown([unmet(one) for one in RUNS[:2]], TRIALS[:1], "covins-g")
    assert "**No agents met in any of the 2 runs, so no map was shared:**" in text
    assert "0 of 0" not in text and "there are no errors to compare" in text
    half = markdown([RUNS[0], unmet(RUNS[1])], TRIALS[:1], "covins-g")
    assert "share a map in not all runs: 1 of 1 with `covins-g`, 0 of 1 with `share`" in half


def test_charts_without_a_value_are_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(report_charts, "_draw_timeline", lambda folder, trials: "")
    (tmp_path / "ate.png").write_bytes(b"of an earlier report")
    pictures = report_charts.draw_report(tmp_path, [unmet(one) for one in RUNS[:2]], TRIALS, "covins-g")
    assert {path.name for path in tmp_path.iterdir()} == {"latency.png", "parts.png"}
    assert "latency.png" in pictures.agents and "ate.png" not in pictures.agents
    pictures = report_charts.draw_report(tmp_path, RUNS[:2], TRIALS, "covins-g")
    assert (tmp_path / "ate.png").is_file() and "ate.png" in pictures.agents


def found(policy: str) -> dict[str, tuple[float, float]]:
    return {
        one.measure.name: (one.value.value, one.ratio.value)
        for one in compare_policies(RUNS, policy, "covins-g")
    }


def test_ratios_are_of_sessions_that_both_have_played():
    share = found("share")
    assert share["AR latency"] == pytest.approx((15.0, 30 / 50))
    assert share["robot latency"] == pytest.approx((42.0, 84 / 80))
    assert share["merges per metre"] == pytest.approx((0.75, 30 / 150))
    assert share["robot ATE in the map"] == pytest.approx((3.0, 3 / 2))  # in two it was in no map
    assert math.isnan(share["AR QoE"][0])


def test_a_comparison_counts_its_pairs():
    pairs = {
        one.measure.name: (one.pairs, one.total_pairs) for one in compare_policies(RUNS, "share", "covins-g")
    }
    assert pairs["AR latency"] == (2, 2)
    assert pairs["robot ATE in the map"] == (1, 2)
    assert pairs["AR QoE"] == (0, 2)


def test_more_seeds_of_one_session_give_no_interval():
    again = [dataclasses.replace(r, conditions=dataclasses.replace(r.conditions, seed=1)) for r in RUNS]
    once, twice = (
        {one.measure.name: one.ratio for one in compare_policies(runs, "share", "covins-g")}["AR latency"]
        for runs in (RUNS, RUNS + again)
    )
    assert once == twice


def test_the_ratio_of_the_base_is_one():
    assert {ratio for _, ratio in found("covins-g").values() if not math.isnan(ratio)} == {1.0}


def test_runs_with_no_larger_error_are_counted():
    assert count_no_worse(RUNS, "share", "covins-g") == (2, 3)
    assert count_no_worse(RUNS, "covins-g", "share") == (2, 3)


def test_means_with_no_larger_error_are_counted():
    again = [
        run("share", "one", (10.0, 40.0), (1.0, 3.0), 20, seed=1),
        run("covins-g", "one", (10.0, 40.0), (0.4, 3.5), 20, seed=1),  # means: 0.7 for 1.0, 2.75 for 3.0
    ]
    assert count_no_worse_on_average(RUNS, "share", "covins-g") == (2, 3)
    assert count_no_worse_on_average(RUNS + again, "share", "covins-g") == (1, 3)
    assert count_no_worse_on_average(RUNS + again, "covins-g", "share") == (2, 3)


def test_policies_keep_their_order_and_every_measure_has_a_name():
    assert policy_names(RUNS) == ["covins-g", "share"]
    assert len({measure.name for measure in MEASURES}) == len(MEASURES)


def test_a_report_begins_with_a_sentence_and_has_one_quantity_a_cell():
    text = markdown(RUNS, TRIALS, "covins-g")
    headline = text.split("\n\n")[1]
    assert headline.startswith("**`share`: AR latency 15 ms, 0.60 of `covins-g`'s; merges per metre 0.75")
    rows = [line for line in text.splitlines() if line.startswith("|")]
    cells = [cell.strip() for line in rows for cell in line.split("|")[1:-1]]
    assert not any(";" in cell for cell in cells)
    assert "AR QoE" not in text  # nobody has one
    assert "| AR latency, ms | 183 | **15** |" in text
    assert "| robot ATE in the map | 1.50 | – | 1 of 2 |" in text  # over two sessions there are intervals
    assert "| two | bot | **2** | – |" not in text and "| two | bot | 2 | – |" in text


def test_with_one_session_there_is_no_interval_anywhere():
    text = markdown(RUNS[:2], TRIALS, "covins-g")
    assert "95 %" not in text
    assert "| AR latency | 0.50 |" in text


def test_the_best_is_bold_unless_all_are_equal_or_none_is_better():
    assert best_in_bold([2.0, 1.0, NAN], -1) == ["2", "**1**", "–"]
    assert best_in_bold([2.0, 1.0], 1) == ["**2**", "1"]
    assert best_in_bold([2.0, 1.0], 0) == ["2", "1"]
    assert best_in_bold([2.0, 2.0], -1) == ["2", "2"]
    assert best_in_bold([2.0, NAN], -1) == ["2", "–"]


def test_the_table_in_latex_has_the_same_values():
    text = latex_table(RUNS, "covins-g")
    assert "AR latency, ms & 183 & \\textbf{15} \\\\" in text
    assert text.count("\\begin{tabular}{lrr}") == text.count("\\end{tabular}") == 1
    rows = [line for line in text.splitlines() if "&" in line]
    assert {line.count("&") for line in rows} == {2}
