"""Figures of trials as pictures: latency, errors, what each policy saves, how a run goes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from share.io.charts import draw_bars, draw_lines, draw_parts
from share.metrics.comparison import compare, policies
from share.metrics.figures import RunFigures
from share.metrics.latency import NOTICED_MS
from share.run.report import mean_of
from share.run.traces import merges, traces
from share.run.trial import Trial

_PARTS = (
    "AR latency",
    "AR corrections",
    "AR frames over 20 ms",
    "robot latency",
    "merges a metre",
    "joint ATE",
    "AR ATE in the map",
    "robot ATE in the map",
)


def draw(folder: Path, runs: Sequence[RunFigures], trials: Sequence[Trial], base: str) -> dict[str, Path]:
    """PNG files in `folder`, by what is to be said of each. trials: as `runs`, in order."""
    names, sessions = policies(runs), list(dict.fromkeys(run.conditions.session for run in runs))
    agents = list(dict.fromkeys(agent.agent for run in runs for agent in run.agents))
    out = {}
    for file, field, unit, line, said in (
        (
            "latency.png",
            "latency_ms",
            "ms",
            NOTICED_MS,
            "Latency of each agent; the line is at 20 ms",
        ),
        ("ate.png", "ate_cm", "cm", None, "ATE of each agent in the shared map"),
    ):
        panels = {
            agent: {
                name: [mean_of(runs, name, session, agent, field) for session in sessions] for name in names
            }
            for agent in agents
        }
        draw_bars(folder / file, panels, sessions, unit, line)
        out[said] = folder / file
    others = [name for name in names if name != base]
    if others:
        compared = {
            name: {
                one.measure.name: one.ratio for one in compare(runs, name, base) if one.measure.name in _PARTS
            }
            for name in others
        }
        draw_parts(folder / "parts.png", compared, base)
        out[f"What each policy comes to, as a part of {base}; whiskers: 95 %"] = folder / "parts.png"
    return out | _over_time(folder, trials)


def _over_time(folder: Path, trials: Sequence[Trial]) -> dict[str, Path]:
    """Of the first session, with its first seed, by every policy."""
    first = trials[0]
    where = first.session.folder.name
    same = [
        t for t in trials if t.session.folder == first.session.folder and t.terms.seed == first.terms.seed
    ]
    by_policy = {trial.terms.policy: traces(trial) for trial in same}
    panels = {
        f"{what} of {agent}": {
            name: (found[agent].seconds, found[agent].qoe if what == "QoE" else found[agent].rate_hz)
            for name, found in by_policy.items()
        }
        for agent in first.session.agents
        for what in ("QoE", "rate")
    }
    units = ["" if title.startswith("QoE") else "Hz" for title in panels]
    draw_lines(folder / "over-time.png", panels, "s", units)
    done = {trial.terms.policy: merges(trial) for trial in same}
    counted = {name: (metres, np.arange(1.0, len(metres) + 1)) for name, metres in done.items()}
    draw_lines(folder / "merges.png", {f"merges on {where}": counted}, "m that all agents have gone", [""])
    return {
        f"QoE, and the rate that the edge allows, over time: {where}": folder / "over-time.png",
        f"Merges along the way: {where}": folder / "merges.png",
    }
