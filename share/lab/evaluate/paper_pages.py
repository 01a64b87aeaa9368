"""Writes the report of `share evaluate paper`: text, tables, pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from share.config import ControlConfig
from share.errors import ShareError
from share.files.writing import atomic_write
from share.lab.evaluate.charts import draw_heat_maps, draw_lines
from share.lab.evaluate.paper_plan import BASE, PaperPlan, PaperRuns, axes_of
from share.lab.evaluate.paper_report import (
    estimator_section,
    merges_table,
    summary_rows,
    table_of,
    trajectory_table,
)
from share.lab.evaluate.policy_report import ReportPictures
from share.lab.evaluate.report import agents_csv, html_page, image_link, provenance
from share.lab.evaluate.report_charts import draw_report
from share.lab.evaluate.run_metrics import RunMetrics
from share.lab.evaluate.scoring import ground_truths, run_metrics
from share.lab.evaluate.statistics import MEASURES
from share.lab.evaluate.sweep import heat_map, sweep_table
from share.lab.evaluate.trial import Trial
from share.lab.evaluate.views_of_others import DriftBesideOthers, drift_beside_others
from share.lab.train.score import ErrorModelScore
from share.recordings.trajectory import read_tum
from share.runtime.source import open_source
from share.scheduling.qoe import QoeParameters, qoe
from share.types import AgentKind

_HEAT_MEASURES = ("AR latency", "AR ATE in the map", "AR QoE")
_QOE_ERRORS_CM = (0.5, 1.0, 2.0, 5.0)


def write_paper(
    out: Path,
    plan: PaperPlan,
    runs: PaperRuns,
    trials: Mapping[Path, Trial],
    failed: Sequence[str],
    scores: Sequence[ErrorModelScore],
) -> None:
    """Write paper.md, paper.html, agents.csv and pictures to `out`. trials: those that were played, by
    folder. failed: names of those that failed. Raises ShareError where none of a policy was played."""
    compared = [trials[run.out] for run in runs.compared if run.out in trials]
    streamed = [trials[run.out] for run in runs.streamed if run.out in trials]
    metrics, streamed_metrics = ([run_metrics(one) for one in part] for part in (compared, streamed))
    if not any(one.conditions.policy == BASE for one in metrics):
        raise ShareError(f"{out}: no run with {BASE} succeeded; nothing to compare with")
    drift = _drift(compared)
    everything = [*metrics, *streamed_metrics]
    parts = [
        "# The paper's tables and figures",
        f"FAILED, and not in this report: {', '.join(failed)}." if failed else "",
        provenance(everything, [*compared, *streamed]),
        table_of(summary_rows(metrics, streamed_metrics, drift, scores)),
        *_trajectory_tables(metrics, everything),
        *_policy_parts(out, plan, runs, trials, draw_report(out, metrics, compared, BASE)),
        "## Estimators of the error",
        estimator_section(scores),
        "## Observation 2: dynamic scenes",
        _dynamic_text(drift),
    ]
    text = "\n\n".join(part for part in parts if part) + "\n"
    atomic_write(out / "agents.csv", agents_csv(everything))
    atomic_write(out / "paper.md", text)
    atomic_write(out / "paper.html", html_page("The paper's tables and figures", text, out))


def _trajectory_tables(metrics: Sequence[RunMetrics], everything: Sequence[RunMetrics]) -> list[str]:
    """Return a table of each figure by trajectory. everything: with streamed runs, which have no map."""
    return [
        "## Latency of each trajectory, ms",
        trajectory_table(everything, "latency_ms", ".1f"),
        "## ATE in the shared map, cm",
        trajectory_table(everything, "ate_cm", ".2f"),
        "`streamed` has no shared map. ATE of odometry alone, each path aligned by itself:",
        trajectory_table(everything, "odom_ate_cm", ".2f"),
        "## RPE over 1 s in the map, cm",
        trajectory_table(metrics, "rpe_1s_cm", ".2f"),
        "## Merges along the path, a metre",
        merges_table(metrics),
    ]


def _policy_parts(
    out: Path, plan: PaperPlan, runs: PaperRuns, trials: Mapping[Path, Trial], pictures: ReportPictures
) -> list[str]:
    """Return the sections that compare policies and gains."""
    return [
        pictures.timeline,
        "## Gains of the PID controller, by `share-paper`",
        *_heat_maps(out, plan, runs, trials),
        "## QoE",
        _qoe_curves(out),
        "## Ablation: policies compared",
        pictures.comparison,
        pictures.agents,
    ]


def _drift(trials: Sequence[Trial]) -> DriftBesideOthers:
    """Return odometry drift with and without others in view, once per session: policies do not affect it."""
    total = DriftBesideOthers()
    for trial in {trial.session.folder: trial for trial in trials}.values():
        truths = ground_truths(trial)
        offsets_ns = {name: agent.clock_offset_ns for name, agent in trial.session.agents.items()}
        for name, truth in truths.items():
            path = trial.folders[name] / "odom.tum"
            if not path.stat().st_size:
                continue
            estimate = read_tum(path)
            others = [
                (other.stamps_ns - offsets_ns[one] + offsets_ns[name], other.T)
                for one, other in truths.items()
                if one != name
            ]
            rig = open_source(f"{trial.session.folder}/{name}").rig
            total += drift_beside_others(
                rig, (estimate.stamps_ns, estimate.T), (truth.stamps_ns, truth.T), others
            )
    return total


def _dynamic_text(drift: DriftBesideOthers) -> str:
    with_mm, without_mm = 10 * drift.with_cm, 10 * drift.without_cm
    return (
        f"In {100 * drift.share_with:.0f} % of the seconds another agent is in the picture. Odometry drifts "
        f"by {with_mm:.1f} mm over these, by {without_mm:.1f} mm over those without one (rms)."
    )


def _heat_maps(out: Path, plan: PaperPlan, runs: PaperRuns, trials: Mapping[Path, Trial]) -> list[str]:
    """Draw a heat map for each pair of gains; return the Markdown that shows them."""
    links = []
    for pair, swept in runs.swept.items():
        played = [(point, run_metrics(trials[run.out])) for run, point in swept if run.out in trials]
        if not played:
            continue
        axes = axes_of(plan, pair)
        rows = sweep_table(axes, played)
        maps = {one.title: heat_map(axes, rows, one.name) for one in MEASURES if one.name in _HEAT_MEASURES}
        name = f"gains-{'-'.join(pair)}.png"
        draw_heat_maps(out / name, maps, (axes[0].name, axes[0].values), (axes[1].name, axes[1].values))
        links.append(image_link(f"{pair[0]} by {pair[1]}, `{runs.swept[pair][0][0].options.policy}`", name))
    return links


def _qoe_curves(out: Path) -> str:
    """Draw QoE by delay for several errors; return the Markdown that shows it."""
    delays_ms = np.linspace(0.0, 500.0, 251)
    panels = {}
    for kind in AgentKind:
        terms = QoeParameters.from_config(ControlConfig(), kind)
        panels[f"QoE of {'a headset' if kind is AgentKind.AR else 'a robot'} by delay, for errors"] = {
            f"{cm:g} cm": (delays_ms, np.array([qoe(ms, cm, terms) for ms in delays_ms.tolist()]))
            for cm in _QOE_ERRORS_CM
        }
    draw_lines(out / "qoe.png", panels, "delay until corrections [ms]", ["", ""])
    return image_link("QoE by delay and error, as configured by default", "qoe.png")
