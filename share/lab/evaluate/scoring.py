"""The figures of a trial, from the files that its agents and its edge left."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from share.errors import DataError
from share.files.json_file import as_we_write_it, read_json, read_json_lines
from share.lab.evaluate.figures import AgentFigures, Conditions, RunFigures
from share.lab.evaluate.play import AgentScore, SessionScore, score
from share.lab.evaluate.together import Together
from share.lab.evaluate.trial import Trial
from share.metrics.ate import Ate
from share.metrics.rpe import Rpe, rpe_frames, rpe_time
from share.recordings.trajectory import Trajectory, read_tum
from share.types import F64


def figures(trial: Trial) -> RunFigures:
    """Raises DataError on damaged files."""
    with as_we_write_it(trial.folder):
        return _figures(trial)


def _figures(trial: Trial) -> RunFigures:
    found = score(trial.session, trial.folders)
    edge = read_json(trial.folder / "edge" / "edge.json")
    joined_s = _joined(trial.folder / "edge" / "events.jsonl")
    agents = tuple(
        _of_agent(name, str(trial.session.agents[name].kind), one, found, edge, joined_s.get(name, math.nan))
        for name, one in found.agents.items()
    )
    merges = edge.get("merges", {})
    terms = trial.terms
    return RunFigures(
        Conditions(
            trial.session.folder.name,
            terms.policy,
            terms.link or "",
            terms.seed,
            trial.clock,
            trial.told,
            trial.record.get("code") or "",
        ),
        agents,
        in_one_map=0 if found.joint is None else len(found.joint.agents),
        joint_ate_cm=_cm(None if found.joint is None else found.joint.joint),
        merges_requested=merges.get("requested", 0),
        merges_skipped=merges.get("skipped", 0),
        merges_done=merges.get("done", 0),
    )


def _of_agent(
    name: str, kind: str, one: AgentScore, found: SessionScore, edge: dict[str, Any], joined_s: float
) -> AgentFigures:
    report, in_map = one.report, None if found.joint is None else found.joint.agents.get(name)
    track, corrected = report["track_ms"], report["corrected_ms"]
    frame, second = _rpe(one, rpe_frames), _rpe(one, rpe_time)
    span_s = float(one.truth.stamps_ns[-1] - one.truth.stamps_ns[0]) / 1e9
    trace = Trace.of(edge["series"].get(name, {}))
    return AgentFigures(
        agent=name,
        kind=kind,
        frames=report["frames"],
        tracked=report["tracked"],
        latency_ms=_number(report["latency_ms"]["mean"]),
        track_ms=_number(track["mean"]),
        track_p50_ms=_number(track["p50"]),
        track_p95_ms=_number(track["p95"]),
        track_p99_ms=_number(track["p99"]),
        over_20ms=_number(report["over_20ms"]),
        corrected=corrected["n"],
        corrected_ms=_number(corrected["mean"]),
        corrected_p50_ms=_number(corrected["p50"]),
        corrected_p95_ms=_number(corrected["p95"]),
        corrected_p99_ms=_number(corrected["p99"]),
        odom_ate_cm=_cm(one.odometry),
        odom_n=0 if one.odometry is None else one.odometry.n,
        ate_cm=_cm(in_map),
        in_map=0 if in_map is None else in_map.n,
        rpe_frame_cm=frame.cm,
        rpe_frame_deg=frame.degrees,
        rpe_frame_n=frame.n,
        rpe_1s_cm=second.cm,
        rpe_1s_deg=second.degrees,
        rpe_1s_n=second.n,
        metres=one.truth.metres,
        joined_s=joined_s,
        keyframes=report["keyframes"],
        sent=report["sent"],
        rate_hz=_number(report["rate_hz"]),
        kb_up_s=report["bytes_up"] / 1e3 / span_s,
        kb_down_s=report["bytes_down"] / 1e3 / span_s,
        cpu_ms_per_frame=_number(report["cpu_ms_per_frame"]),
        qoe=_mean(trace.qoe),
        told_cm=math.sqrt(_mean(trace.error_cm**2)),
    )


class _Relative(NamedTuple):
    """RPE: rms, over n pairs."""

    cm: float
    degrees: float
    n: int


def _rpe(one: AgentScore, measure: Callable[[Trajectory, Trajectory], Rpe]) -> _Relative:
    try:
        rpe = None if one.map is None else measure(one.map, one.truth)
    except DataError:  # too few poses
        rpe = None
    if rpe is None:
        return _Relative(math.nan, math.nan, 0)
    return _Relative(100 * rpe.translation.rmse, math.degrees(rpe.rotation.rmse), rpe.translation.n)


def _joined(events: Path) -> dict[str, float]:
    """When each agent was first in one map with another, s since the first of all came to the edge."""
    began: float | None = None
    together = Together()
    joined: dict[str, float] = {}
    for event in read_json_lines(events):
        if event["event"] == "joined the edge" and began is None:
            began = event["t_s"]
        if event["event"] == "correction":
            together.corrected(event["agent"], event["map_id"])
            for name in together.agents:
                joined.setdefault(name, event["t_s"] - (began or 0.0))
    return joined


def _cm(ate: Ate | None) -> float:
    return math.nan if ate is None else 100 * ate.rmse


def _mean(values: F64) -> float:
    """Of those that are known."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else math.nan


def _number(value: float | None) -> float:
    return math.nan if value is None else value


# ---- How a run went over time: QoE, rates and merges, from the files that its edge left.

_MERGES = ("loop accepted", "maps joined")


@dataclass(frozen=True, eq=False)
class Trace:
    """Of one agent, at its E evaluations: seconds (E,) since the edge began, qoe (E,), rate_hz (E,), NaN
    where there was no limit, error_cm (E,) as it told it, NaN where it had no estimate."""

    seconds: F64
    qoe: F64
    rate_hz: F64
    error_cm: F64

    @classmethod
    def of(cls, series: dict[str, list[float | None]]) -> Trace:
        """From an agent's part of the `series` in edge.json."""
        return cls(*(_numbers(series.get(key, [])) for key in ("t_s", "qoe", "rate_hz", "error_cm")))


def traces(trial: Trial) -> dict[str, Trace]:
    """By agent. Raises DataError on damaged files."""
    path = trial.folder / "edge" / "edge.json"
    with as_we_write_it(path):
        series = read_json(path)["series"]
        return {name: Trace.of(series.get(name, {})) for name in trial.session.agents}


def began_s(events: list[dict[str, Any]]) -> float:
    """When the first agent joined the edge, by the edge's clock: where the truth begins. 0 if none did."""
    return next((e["t_s"] for e in events if e["event"] == "joined the edge"), 0.0)


@dataclass(frozen=True, eq=False)
class Merges:
    """metres (M,): how far all agents together had gone by each. xy: where each agent was at those that its
    keyframes led to, m (K, 2), by agent."""

    metres: F64
    xy: dict[str, F64]


def merges(trial: Trial) -> Merges:
    """Where they were done. Raises DataError on damaged files."""
    path = trial.folder / "edge" / "events.jsonl"
    with as_we_write_it(path):
        return _merges(trial, read_json_lines(path))


def _merges(trial: Trial, events: list[dict[str, Any]]) -> Merges:
    began = began_s(events)
    done = [event for event in events if event["event"] in _MERGES]
    done_s = np.array([event["t_s"] - began for event in done], float)
    who = np.array([event["agent"] for event in done], str)
    found = truths(trial)
    offsets_ns = {name: agent.clock_offset_ns for name, agent in trial.session.agents.items()}
    first_ns = min(truth.stamps_ns[0] - offsets_ns[name] for name, truth in found.items())
    gone, xy = np.zeros(len(done_s)), {}
    for name, truth in found.items():
        # in real time all recordings begin at once, in virtual time when they did
        start_ns = first_ns + offsets_ns[name] if trial.terms.virtual else truth.stamps_ns[0]
        seconds = (truth.stamps_ns - start_ns) * 1e-9
        gone += np.interp(done_s, seconds, truth.way)
        mine = done_s[who == name]
        xy[name] = np.stack([np.interp(mine, seconds, truth.T[:, k, 3]) for k in (0, 1)], axis=1)
    return Merges(gone, xy)


def truths(trial: Trial) -> dict[str, Trajectory]:
    """By agent, each by its own clock. Raises DataError."""
    folder = trial.session.folder / "truth"
    return {name: read_tum(folder / f"{name}.tum") for name in trial.session.agents}


def _numbers(values: list[float | None]) -> F64:
    return np.array([np.nan if value is None else value for value in values], float)
