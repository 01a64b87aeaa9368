"""Figures of trials as pictures: latency, errors, what each policy saves, how a run goes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from share.lab.evaluate.charts import draw_bars, draw_lines, draw_parts, draw_ways
from share.lab.evaluate.figures import RunFigures
from share.lab.evaluate.report import Shown, mean_of, picture
from share.lab.evaluate.scoring import Merges, merges, traces, truths
from share.lab.evaluate.statistics import compare, policies
from share.lab.evaluate.trial import Trial
from share.metrics.frame_log import NOTICED_MS
from share.types import F64

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


def draw(folder: Path, runs: Sequence[RunFigures], trials: Sequence[Trial], base: str) -> Shown:
    """PNG files in `folder`. trials: as `runs`, in order."""
    names, sessions = policies(runs), list(dict.fromkeys(run.conditions.session for run in runs))
    agents = list(dict.fromkeys(agent.agent for run in runs for agent in run.agents))
    for file, field, unit, line in (
        ("latency.png", "latency_ms", "ms", NOTICED_MS),
        ("ate.png", "ate_cm", "cm", None),
    ):
        panels = {
            agent: {
                name: [mean_of(runs, name, session, agent, field) for session in sessions] for name in names
            }
            for agent in agents
        }
        draw_bars(folder / file, panels, sessions, unit, line)
    return Shown(
        _parts(folder, runs, names, base),
        _shown(
            {
                "Latency of each agent; the line is at 20 ms": "latency.png",
                "ATE of each agent in the shared map": "ate.png",
            }
        ),
        _course(folder, trials),
    )


def _parts(folder: Path, runs: Sequence[RunFigures], names: Sequence[str], base: str) -> str:
    compared = {
        name: {one.measure.name: one.ratio for one in compare(runs, name, base) if one.measure.name in _PARTS}
        for name in names
        if name != base
    }
    if not compared:
        return ""
    draw_parts(folder / "parts.png", compared, base, names)
    return _shown({f"What each policy comes to, as a part of {base}; whiskers: 95 %": "parts.png"})


def _shown(files: Mapping[str, str]) -> str:
    return "\n\n".join(picture(said, file) for said, file in files.items())


def draw_each(folder: Path, trials: Sequence[Trial]) -> list[Path]:
    """PNG files in `folder`, three a session: its runs over time, by the names of their folders."""
    by_session: dict[Path, dict[str, Trial]] = {}
    for trial in trials:
        by_session.setdefault(trial.session.folder, {})[trial.folder.resolve().name] = trial
    return [
        path
        for session, runs in by_session.items()
        for path in _over_time(folder, f"{session.name}-", runs).values()
    ]


def _course(folder: Path, trials: Sequence[Trial]) -> str:
    """Of the first session, with its first seed, by every policy."""
    first = trials[0]
    same = {
        trial.terms.policy: trial
        for trial in trials
        if (trial.session.folder, trial.terms.seed) == (first.session.folder, first.terms.seed)
    }
    files = {said: path.name for said, path in _over_time(folder, "", same).items()}
    return f"## How a run goes: {first.session.folder.name}\n\n{_shown(files)}"


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
    over_time, along, above = (folder / f"{prefix}{name}.png" for name in ("over-time", "merges", "where"))
    draw_lines(over_time, panels, "s", units)
    done = {name: merges(trial) for name, trial in trials.items()}
    counted = {name: (of.metres, np.arange(1.0, len(of.metres) + 1)) for name, of in done.items()}
    draw_lines(along, {f"merges on {where}": counted}, "m that all agents have gone", [""])
    seen = {
        f"{name}: {len(done[name].metres)} merges": _from_above(trial, done[name])
        for name, trial in trials.items()
    }
    draw_ways(above, seen)
    return {
        f"QoE, and the rate that the edge allows, over time: {where}": over_time,
        f"Merges along the way: {where}": along,
        f"Where they were, from above: {where}; a dot is a merge that an agent's keyframe led to": above,
    }


def _from_above(trial: Trial, done: Merges) -> dict[str, tuple[F64, F64]]:
    """By agent: its way (N, 2), and where it was at its merges (M, 2), m."""
    ways = {name: truth.T[:, :2, 3] for name, truth in truths(trial).items()}
    return {name: (way, done.xy.get(name, way[:0])) for name, way in ways.items()}
