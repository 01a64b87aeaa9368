"""Two policies on the same recordings, side by side: a headline, a table and one picture."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from share.colours import series_colours
from share.geometry.interpolation import associate
from share.geometry.se3 import transform
from share.lab.evaluate.charts import agg_pyplot, save_png
from share.lab.evaluate.provenance import busy_text
from share.lab.evaluate.run_metrics import RunMetrics
from share.lab.evaluate.scoring import SessionScore, join_times, merge_locations, run_metrics, score_session
from share.lab.evaluate.statistics import MEASURES
from share.lab.evaluate.trial import Trial
from share.metrics.frame_log import NOTICEABLE_LATENCY_MS
from share.recordings.session import Session
from share.types import F64, AgentKind

_SHOWN = (  # of `MEASURES`
    *("AR latency", "AR frames", "AR frames over 20 ms", "AR corrections", "robot latency"),
    *("AR keyframes sent", "merges per metre", "joint ATE", "agents in one map"),
)
_BIN_S = 0.5  # of the errors over time


@dataclass(frozen=True, eq=False)
class ScoredTrial:
    """A trial with its metrics and scores."""

    trial: Trial
    metrics: RunMetrics
    score: SessionScore

    @classmethod
    def of(cls, trial: Trial) -> ScoredTrial:
        """Raises DataError on damaged files."""
        return cls(trial, run_metrics(trial), score_session(trial.session, trial.folders))

    @property
    def policy(self) -> str:
        return self.metrics.conditions.policy

    @property
    def all_shared_s(self) -> float:
        """When the last agent came to share a map, s; NaN if one never did."""
        joined = join_times(self.trial.folder / "edge" / "events.jsonl")
        return max(joined.values()) if len(joined) == len(self.trial.session.agents) else math.nan


def comparison_rows(scored: Sequence[ScoredTrial]) -> list[list[str]]:
    """Return a table: a row for each quantity, a column for each policy, and the last one's ratio to the
    first."""
    base, subject = scored[0], scored[-1]
    rows = [["", *(one.policy for one in scored), f"{subject.policy} ÷ {base.policy}"]]
    for measure in (one for one in MEASURES if one.name in _SHOWN):
        values = [measure.value_of(one.metrics) for one in scored]
        rows.append([measure.title, *map(_number, values), _ratio(values)])
    values = [one.all_shared_s for one in scored]
    rows.append(["all in a shared map after, s", *map(_number, values), _ratio(values)])
    return rows


def headline(scored: Sequence[ScoredTrial]) -> str:
    """Return a sentence about the last policy against the first."""
    base, subject = scored[0], scored[-1]
    by_name = {measure.name: measure for measure in MEASURES}

    def both(name: str) -> tuple[float, float]:
        return by_name[name].value_of(subject.metrics), by_name[name].value_of(base.metrics)

    latency, error = both("AR latency"), both("joint ATE")
    merges = subject.metrics.merges_done, base.metrics.merges_done
    return (
        f"{subject.policy} against {base.policy}: AR latency {_number(latency[0])} ms against "
        f"{_number(latency[1])}, {merges[0]} merges against {merges[1]}, "
        f"joint ATE {_number(error[0])} cm against {_number(error[1])}"
    )


def busy_note(scored: Sequence[ScoredTrial]) -> str:
    """Return a line where other programs took the cores from what is measured; "" where they did not."""
    machine = scored[0].trial.record["machine"]
    busy = busy_text(machine["load"], machine["cores"], "the first run")
    return f"{busy}: latencies are not those of the policies; repeat it when idle" if busy else ""


def _number(value: float) -> str:
    if math.isnan(value):
        return "–"
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _ratio(values: Sequence[float]) -> str:
    base, subject = values[0], values[-1]
    return f"{subject / base:.2f}" if base and math.isfinite(subject / base) else "–"


# The picture


def draw_side_by_side(path: Path, scored: Sequence[ScoredTrial]) -> None:
    """Write a PNG: how late poses of headsets are, merges over distance, errors over time."""
    pyplot = agg_pyplot()
    figure, (late, merged, wrong) = pyplot.subplots(1, 3, figsize=(15, 5.4), layout="constrained")
    colours = series_colours(one.policy for one in scored)
    for one in scored:
        colour = colours[one.policy]
        _draw_latency(late, one, colour)
        metres = merge_locations(one.trial).metres
        merged.step(
            [0.0, *np.sort(metres), one.metrics.metres],
            [*range(len(metres) + 1), len(metres)],
            where="post",
            color=colour,
            linewidth=2,
            label=f"{one.policy}: {len(metres)}",
        )
        _draw_error(wrong, one, colour)
    late.axvline(NOTICEABLE_LATENCY_MS, color="black", linestyle="--", linewidth=1)
    late.annotate(
        f" {NOTICEABLE_LATENCY_MS:.0f} ms", (NOTICEABLE_LATENCY_MS, 4), fontsize=9, ha="left", va="bottom"
    )
    late.set(
        title="headsets: how soon a pose is there",
        xlabel="ms from the frame's arrival",
        ylabel="% of them",
        xscale="log",
        ylim=(0, 101),
    )
    late.xaxis.set_major_formatter("{x:g}")
    merged.set(title="loops merged", xlabel="path of all agents [m]", ylim=(0, None))
    wrong.set(
        title="position error in the shared map",
        xlabel="time [s]",
        ylabel="cm, rms of agents",
        ylim=(0, None),
    )
    for axis in (late, merged, wrong):
        axis.grid(alpha=0.3)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2)
    figure.suptitle("\n".join(filter(None, (headline(scored), busy_note(scored)))))
    save_png(figure, path, 110)


def _draw_latency(axis: Any, one: ScoredTrial, colour: str) -> None:
    """Draw what share of poses and of corrections has come within x ms."""
    names = [name for name, a in one.trial.session.agents.items() if a.kind is AgentKind.AR]
    parts = [_latencies_ms(one.trial.folders[name] / "latency.csv") for name in names]
    for k, (what, style) in enumerate((("poses", "-"), ("corrections", ":"))):
        values = np.sort(np.concatenate([part[k] for part in parts]))
        if len(values):
            of_all = 100 * np.arange(len(values) + 1) / len(values)
            steps, label = [values[0], *values], f"{one.policy}: {what} ({len(values)})"
            axis.step(steps, of_all, style, where="post", color=colour, linewidth=2, label=label)


def _latencies_ms(path: Path) -> tuple[F64, F64]:
    """Return the latencies of all frames, and of those that a correction answered, from latency.csv."""
    with path.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    track = np.array([float(row["track_ms"]) for row in rows])
    corrected = np.array([float(row["corrected_ms"]) for row in rows if row["corrected_ms"]])
    return track, corrected


def _draw_error(axis: Any, one: ScoredTrial, colour: str) -> None:
    """Draw the error over time, of all agents in the largest map."""
    joint = one.score.joint
    if joint is None:
        return
    start_ns = _start_ns(one.trial.session, one.score)
    seconds, errors = [], []
    for name in joint.agents:
        agent = one.score.agents[name]
        if agent.map is None:
            continue
        stamps, T_est, T_truth = associate(agent.map, agent.truth)
        p = transform(joint.joint.T_truth_est, T_est[:, :3, 3])
        seconds.append((stamps - start_ns(name)) * 1e-9)
        errors.append(100 * np.linalg.norm(p - T_truth[:, :3, 3], axis=1))
    bins, rms = _binned_rms(np.concatenate(seconds), np.concatenate(errors))
    label = f"{one.policy}: {100 * joint.joint.rmse:.2f} cm, {len(joint.agents)} agents"
    axis.plot(bins, rms, color=colour, linewidth=2, label=label)


def _start_ns(session: Session, score: SessionScore) -> Callable[[str], int]:
    """Return a function: the session's start by the clock of an agent."""
    offsets = {name: agent.clock_offset_ns for name, agent in session.agents.items()}
    start = min(int(score.agents[name].truth.stamps_ns[0]) - offsets[name] for name in offsets)
    return lambda name: start + offsets[name]


def _binned_rms(seconds: F64, values: F64) -> tuple[F64, F64]:
    """Return the middles of bins of `_BIN_S` with values, and the rms in each."""
    number = np.floor(seconds / _BIN_S).astype(int)
    bins = np.unique(number)
    rms = [float(np.sqrt(np.mean(values[number == k] ** 2))) for k in bins]
    return (bins + 0.5) * _BIN_S, np.array(rms)
