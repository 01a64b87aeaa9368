"""How a run went over time: QoE, rates and merges, from the files that its edge left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from share.io.json_file import as_we_write_it, read_json, read_json_lines
from share.io.trajectory import Trajectory, read_tum
from share.run.trial import Trial
from share.types import F64

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
