"""Pictures of trials: latency, errors, ratios of policies, runs over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from share.lab.evaluate.charts import draw_bars, draw_lines, draw_paths, draw_ratios
from share.lab.evaluate.policy_report import ReportPictures, agent_mean
from share.lab.evaluate.report import image_link
from share.lab.evaluate.run_metrics import RunMetrics
from share.lab.evaluate.scoring import MergeLocations, ground_truths, merge_locations, traces
from share.lab.evaluate.statistics import compare_policies, policy_names
from share.lab.evaluate.trial import Trial
from share.metrics.frame_log import NOTICEABLE_LATENCY_MS
from share.types import F64

_RATIO_MEASURES = (
    "AR latency",
    "AR corrections",
    "AR frames over 20 ms",
    "robot latency",
    "merges per metre",
    "joint ATE",
    "AR ATE in the map",
    "robot ATE in the map",
)


def draw_report(
    folder: Path, runs: Sequence[RunMetrics], trials: Sequence[Trial], base: str
) -> ReportPictures:
    """Write PNG files to `folder`; return the Markdown that shows them. trials: in the order of `runs`.

    A chart without a value is left out."""
    names, sessions = policy_names(runs), list(dict.fromkeys(run.conditions.session for run in runs))
    agents = list(dict.fromkeys(agent.agent for run in runs for agent in run.agents))
    drawn = {}
    for caption, file, field, unit, line in (
        (
            "Latency of each agent; the line is at 20 ms",
            "latency.png",
            "latency_ms",
            "ms",
            NOTICEABLE_LATENCY_MS,
        ),
        ("ATE of each agent in the shared map", "ate.png", "ate_cm", "cm", None),
    ):
        panels = {
            agent: {
                name: [agent_mean(runs, name, session, agent, field) for session in sessions]
                for name in names
            }
            for agent in agents
        }
        known = {agent: of for agent, of in panels.items() if np.isfinite(list(of.values())).any()}
        (folder / file).unlink(missing_ok=True)  # of an earlier report
        if known:
            draw_bars(folder / file, known, sessions, unit, line, names)
            drawn[caption] = file
    return ReportPictures(
        _draw_ratios(folder, runs, names, base), _image_links(drawn), _draw_timeline(folder, trials)
    )


def _draw_ratios(folder: Path, runs: Sequence[RunMetrics], names: Sequence[str], base: str) -> str:
    compared = {
        name: {
            one.measure.name: one.ratio
            for one in compare_policies(runs, name, base)
            if one.measure.name in _RATIO_MEASURES
        }
        for name in names
        if name != base
    }
    (folder / "parts.png").unlink(missing_ok=True)  # of an earlier report
    if not any(np.isfinite(one.value) for ratios in compared.values() for one in ratios.values()):
        return ""
    draw_ratios(folder / "parts.png", compared, base)
    has_intervals = any(np.isfinite(one.low) for ratios in compared.values() for one in ratios.values())
    whiskers = "; whiskers: 95 % confidence" if has_intervals else ""
    return _image_links({f"Each policy's ratio to {base}{whiskers}": "parts.png"})


def _image_links(files: Mapping[str, str]) -> str:
    return "\n\n".join(image_link(caption, file) for caption, file in files.items())


def draw_sessions(folder: Path, trials: Sequence[Trial]) -> list[Path]:
    """Write PNG files to `folder`, two a session and a third where maps were merged: its runs over time,
    named after their folders."""
    by_session: dict[Path, dict[str, Trial]] = {}
    for trial in trials:
        by_session.setdefault(trial.session.folder, {})[trial.folder.resolve().name] = trial
    return [
        path
        for session, runs in by_session.items()
        for path in _draw_over_time(folder, f"{session.name}-", runs).values()
    ]


def _draw_timeline(folder: Path, trials: Sequence[Trial]) -> str:
    """Draw the first session with its first seed, by every policy."""
    first = trials[0]
    same = {
        trial.options.policy: trial
        for trial in trials
        if (trial.session.folder, trial.options.seed) == (first.session.folder, first.options.seed)
    }
    files = {caption: path.name for caption, path in _draw_over_time(folder, "", same).items()}
    return f"## How a run goes: {first.session.folder.name}\n\n{_image_links(files)}"


def _draw_over_time(folder: Path, prefix: str, trials: Mapping[str, Trial]) -> dict[str, Path]:
    """Draw QoE, rates and merges of runs of one session, by name; return the files by caption."""
    session = next(iter(trials.values())).session
    session_name = session.folder.name
    traces_of = {name: traces(trial) for name, trial in trials.items()}
    panels = {
        f"{what} of {agent}": {
            name: (of[agent].seconds, of[agent].qoe if what == "QoE" else of[agent].rate_hz)
            for name, of in traces_of.items()
        }
        for agent in session.agents
        for what in ("QoE", "rate")
    }
    units = ["" if title.startswith("QoE") else "Hz" for title in panels]
    over_time, merges_file, top_view_file = (
        folder / f"{prefix}{name}.png" for name in ("over-time", "merges", "where")
    )
    draw_lines(over_time, panels, "s", units)
    merges_of = {name: merge_locations(trial) for name, trial in trials.items()}
    counted = {name: (of.metres, np.arange(1.0, len(of.metres) + 1)) for name, of in merges_of.items()}
    merges_file.unlink(missing_ok=True)  # of an earlier report
    has_merges = any(len(of.metres) for of in merges_of.values())
    if has_merges:
        draw_lines(merges_file, {f"merges on {session_name}": counted}, "path of all agents [m]", [""])
    top_views = {
        f"{name}: {len(merges_of[name].metres)} merges": _top_view(trial, merges_of[name])
        for name, trial in trials.items()
    }
    draw_paths(top_view_file, top_views)
    return {
        f"QoE and allowed keyframe rate over time: {session_name}": over_time,
        **({f"Merges over distance: {session_name}": merges_file} if has_merges else {}),
        f"Paths and merges from above: {session_name}; dots: merges after an agent's keyframe": top_view_file,
    }


def _top_view(trial: Trial, merges: MergeLocations) -> dict[str, tuple[F64, F64]]:
    """Return by agent its path (N, 2) and its positions at its merges (M, 2), m."""
    paths = {name: truth.T[:, :2, 3] for name, truth in ground_truths(trial).items()}
    return {name: (path, merges.xy.get(name, path[:0])) for name, path in paths.items()}
