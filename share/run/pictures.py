"""Figures of trials as pictures: latency, errors, what each policy saves, how a run goes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    return out | _first(folder, trials)


def draw_each(folder: Path, trials: Sequence[Trial]) -> list[Path]:
    """PNG files in `folder`, two a session: its runs over time, by the names of their folders."""
    by_session: dict[Path, dict[str, Trial]] = {}
    for trial in trials:
        by_session.setdefault(trial.session.folder, {})[trial.folder.resolve().name] = trial
    return [
        path
        for session, runs in by_session.items()
        for path in _over_time(folder, f"{session.name}-", runs).values()
    ]


def _first(folder: Path, trials: Sequence[Trial]) -> dict[str, Path]:
    """Of the first session, with its first seed, by every policy."""
    first = trials[0]
    same = {
        trial.terms.policy: trial
        for trial in trials
        if (trial.session.folder, trial.terms.seed) == (first.session.folder, first.terms.seed)
    }
    return _over_time(folder, "", same)


def _over_time(folder: Path, prefix: str, trials: Mapping[str, Trial]) -> dict[str, Path]:
    """Runs of one session, by name: QoE and rates, and merges; by what is to be said of each."""
    session = next(iter(trials.values())).session
    where = session.folder.name
    found = {name: traces(trial) for name, trial in trials.items()}
    panels = {
        f"{what} of {agent}": {
            name: (of[agent].seconds, of[agent].qoe if what == "QoE" else of[agent].rate_hz)
            for name, of in found.items()
        }
        for agent in session.agents
        for what in ("QoE", "rate")
    }
    units = ["" if title.startswith("QoE") else "Hz" for title in panels]
    over_time, along = folder / f"{prefix}over-time.png", folder / f"{prefix}merges.png"
    draw_lines(over_time, panels, "s", units)
    done = {name: merges(trial) for name, trial in trials.items()}
    counted = {name: (metres, np.arange(1.0, len(metres) + 1)) for name, metres in done.items()}
    draw_lines(along, {f"merges on {where}": counted}, "m that all agents have gone", [""])
    return {
        f"QoE, and the rate that the edge allows, over time: {where}": over_time,
        f"Merges along the way: {where}": along,
    }
