"""Scores and metrics of a run, from the files of its agents and its edge, against the ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from share.errors import DataError
from share.files.json_file import none_to_nan, own_format_errors, read_json, read_json_lines
from share.lab.evaluate.real_time import MapMembership
from share.lab.evaluate.run_metrics import AgentMetrics, Conditions, RunMetrics
from share.lab.evaluate.trial import Trial
from share.metrics.ate import Ate, JointAte, ate_if_known, joint_ate
from share.metrics.rpe import Rpe, rpe_frames, rpe_time
from share.recordings.session import Session
from share.recordings.trajectory import Trajectory, read_tum
from share.types import F64


@dataclass(frozen=True, eq=False)
class AgentScore:
    """An agent's `report.json`, the ATE of its odom.tum (SE3-aligned, None with too few poses), its
    map.tum and its ground truth."""

    report: dict[str, Any]
    odometry: Ate | None
    map: Trajectory | None
    truth: Trajectory


@dataclass(frozen=True, eq=False)
class SessionScore:
    """Scores of all agents. `joint`: ATE of map.tum of all agents in the largest map under one alignment.

    `joint` is None where no two agents share a map, since each has a map of its own from the start; a session
    of one agent is scored alone.
    """

    agents: dict[str, AgentScore]
    joint: JointAte | None


def score_session(session: Session, folders: dict[str, Path]) -> SessionScore:
    """Score the files that `share agent --out` left in `folders`. Raises DataError on damaged files."""
    agents = {}
    for name, folder in folders.items():
        truth = read_tum(session.folder / "truth" / f"{name}.tum")
        report = read_json(folder / "report.json")
        odometry = ate_if_known(_trajectory(folder / "odom.tum"), truth)
        agents[name] = AgentScore(report, odometry, _trajectory(folder / "map.tum"), truth)
    return SessionScore(agents, largest_map_ate(agents))


def _trajectory(path: Path) -> Trajectory | None:
    return read_tum(path) if path.stat().st_size else None


def largest_map_ate(agents: dict[str, AgentScore]) -> JointAte | None:
    """Return the joint ATE of the map that most agents were in at their last published pose."""
    members: dict[str, list[str]] = {}
    for name, agent in agents.items():
        if agent.map is not None:
            fallback_map = agent.report["protocol"]["map_id"]  # of runs before map_tum_id was written
            members.setdefault(agent.report.get("map_tum_id", fallback_map), []).append(name)
    if not members:
        return None
    largest = max(members.values(), key=len)
    if len(largest) < min(2, len(agents)):
        return None
    pairs = {name: (agents[name].map, agents[name].truth) for name in largest}
    try:
        return joint_ate({name: (m, t) for name, (m, t) in pairs.items() if m is not None})
    except DataError:
        return None


def run_metrics(trial: Trial) -> RunMetrics:
    """Return the metrics of a trial. Raises DataError on damaged files."""
    with own_format_errors(trial.folder):
        return _run_metrics(trial)


def _run_metrics(trial: Trial) -> RunMetrics:
    session_score = score_session(trial.session, trial.folders)
    edge = read_json(trial.folder / "edge" / "edge.json")
    shared_map_s = join_times(trial.folder / "edge" / "events.jsonl")
    agents = tuple(
        _agent_metrics(
            name,
            str(trial.session.agents[name].kind),
            one,
            session_score,
            edge,
            shared_map_s.get(name, math.nan),
        )
        for name, one in session_score.agents.items()
    )
    merges = edge.get("merges", {})
    options = trial.options
    return RunMetrics(
        Conditions(
            trial.session.folder.name,
            options.policy,
            options.link or "",
            options.seed,
            trial.clock,
            trial.error_source,
            trial.record.get("code") or "",
        ),
        agents,
        agents_in_largest_map=0 if session_score.joint is None else len(session_score.joint.agents),
        joint_ate_cm=_rmse_cm(None if session_score.joint is None else session_score.joint.joint),
        merges_requested=merges.get("requested", 0),
        merges_skipped=merges.get("skipped", 0),
        merges_done=merges.get("done", 0),
    )


def _agent_metrics(
    name: str,
    kind: str,
    score: AgentScore,
    session_score: SessionScore,
    edge: dict[str, Any],
    shared_map_s: float,
) -> AgentMetrics:
    report = score.report
    in_map = None if session_score.joint is None else session_score.joint.agents.get(name)
    track, corrected = report["track_ms"], report["corrected_ms"]
    measured = {
        "latency_ms": report["latency_ms"]["mean"],
        "track_ms": track["mean"],
        "corrected_ms": corrected["mean"],
        **{f"track_{p}_ms": track[p] for p in ("p50", "p95", "p99")},
        **{f"corrected_{p}_ms": corrected[p] for p in ("p50", "p95", "p99")},
        **{key: report[key] for key in ("over_20ms", "rate_hz", "cpu_ms_per_frame")},
    }
    frame, second = _rpe(score, rpe_frames), _rpe(score, rpe_time)
    span_s = float(score.truth.stamps_ns[-1] - score.truth.stamps_ns[0]) / 1e9
    trace = AgentTrace.from_series(edge["series"].get(name, {}))
    return AgentMetrics(
        agent=name,
        kind=kind,
        frames=report["frames"],
        tracked=report["tracked"],
        corrected=corrected["n"],
        **none_to_nan(measured),
        odom_ate_cm=_rmse_cm(score.odometry),
        odom_n=0 if score.odometry is None else score.odometry.n,
        ate_cm=_rmse_cm(in_map),
        ate_n=0 if in_map is None else in_map.n,
        rpe_frame_cm=frame.cm,
        rpe_frame_deg=frame.degrees,
        rpe_frame_n=frame.n,
        rpe_1s_cm=second.cm,
        rpe_1s_deg=second.degrees,
        rpe_1s_n=second.n,
        metres=score.truth.length_m,
        shared_map_s=shared_map_s,
        keyframes=report["keyframes"],
        sent=report["sent"],
        kb_up_s=report["bytes_up"] / 1e3 / span_s,
        kb_down_s=report["bytes_down"] / 1e3 / span_s,
        qoe=_mean(trace.qoe),
        estimated_error_cm=math.sqrt(_mean(trace.error_cm**2)),
    )


class _RpeSummary(NamedTuple):
    """RPE: rms over n pairs."""

    cm: float
    degrees: float
    n: int


def _rpe(score: AgentScore, measure: Callable[[Trajectory, Trajectory], Rpe]) -> _RpeSummary:
    try:
        rpe = None if score.map is None else measure(score.map, score.truth)
    except DataError:  # too few poses
        rpe = None
    if rpe is None:
        return _RpeSummary(math.nan, math.nan, 0)
    return _RpeSummary(100 * rpe.translation.rmse, math.degrees(rpe.rotation.rmse), rpe.translation.n)


def join_times(events: Path) -> dict[str, float]:
    """Return when each agent first shared a map with another, s since the first agent joined the edge."""
    first_s: float | None = None
    membership = MapMembership()
    joined: dict[str, float] = {}
    for event in read_json_lines(events):
        if event["event"] == "agent joined" and first_s is None:
            first_s = event["t_s"]
        if event["event"] == "correction":
            membership.add_correction(event["agent"], event["map_id"])
            for name in membership.sharing_agents:
                joined.setdefault(name, event["t_s"] - (first_s or 0.0))
    return joined


def _rmse_cm(error: Ate | None) -> float:
    return math.nan if error is None else 100 * error.rmse


def _mean(values: F64) -> float:
    """Return the mean without NaN; NaN of none."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else math.nan


# A run over time: QoE, rates and merges, from the files of its edge.

_MERGE_EVENTS = ("loop accepted", "maps merged")


@dataclass(frozen=True, eq=False)
class AgentTrace:
    """An agent's E evaluations: seconds (E,) since the edge started, qoe (E,), rate_hz (E,), NaN where
    unlimited, and error_cm (E,), its estimated error, NaN without one."""

    seconds: F64
    qoe: F64
    rate_hz: F64
    error_cm: F64

    @classmethod
    def from_series(cls, series: dict[str, list[float | None]]) -> AgentTrace:
        """Read an agent's part of `series` in edge.json."""
        return cls(*(_nan_array(series.get(key, [])) for key in ("t_s", "qoe", "rate_hz", "error_cm")))


def traces(trial: Trial) -> dict[str, AgentTrace]:
    """Return the traces by agent. Raises DataError on damaged files."""
    path = trial.folder / "edge" / "edge.json"
    with own_format_errors(path):
        series = read_json(path)["series"]
        return {name: AgentTrace.from_series(series.get(name, {})) for name in trial.session.agents}


def first_join_s(events: list[dict[str, Any]]) -> float:
    """Return when the first agent joined the edge, s of the edge's clock, which is where the truth starts;
    0 if none did."""
    return next((e["t_s"] for e in events if e["event"] == "agent joined"), 0.0)


@dataclass(frozen=True, eq=False)
class MergeLocations:
    """Where M merges were done. metres (M,): distance travelled by all agents together until each. xy: by
    agent, its position m (K, 2) at the merges that its keyframes led to."""

    metres: F64
    xy: dict[str, F64]


def merge_locations(trial: Trial) -> MergeLocations:
    """Return where merges were done. Raises DataError on damaged files."""
    path = trial.folder / "edge" / "events.jsonl"
    with own_format_errors(path):
        return _merge_locations(trial, read_json_lines(path))


def _merge_locations(trial: Trial, events: list[dict[str, Any]]) -> MergeLocations:
    first_s = first_join_s(events)
    done = [event for event in events if event["event"] in _MERGE_EVENTS]
    done_s = np.array([event["t_s"] - first_s for event in done], float)
    agent_names = np.array([event["agent"] for event in done], str)
    ground_truth = ground_truths(trial)
    offsets_ns = {name: agent.clock_offset_ns for name, agent in trial.session.agents.items()}
    first_ns = min(truth.stamps_ns[0] - offsets_ns[name] for name, truth in ground_truth.items())
    travelled_m, xy = np.zeros(len(done_s)), {}
    for name, truth in ground_truth.items():
        # in real time all recordings start together, in virtual time at their recorded times
        start_ns = first_ns + offsets_ns[name] if trial.options.virtual else truth.stamps_ns[0]
        seconds = (truth.stamps_ns - start_ns) * 1e-9
        travelled_m += np.interp(done_s, seconds, truth.travelled_m)
        own_times = done_s[agent_names == name]
        xy[name] = np.stack([np.interp(own_times, seconds, truth.T[:, k, 3]) for k in (0, 1)], axis=1)
    return MergeLocations(travelled_m, xy)


def ground_truths(trial: Trial) -> dict[str, Trajectory]:
    """Return each agent's ground truth by its own clock. Raises DataError on damaged files."""
    folder = trial.session.folder / "truth"
    return {name: read_tum(folder / f"{name}.tum") for name in trial.session.agents}


def _nan_array(values: list[float | None]) -> F64:
    return np.array([np.nan if value is None else value for value in values], float)
