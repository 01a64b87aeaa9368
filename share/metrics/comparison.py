"""What policies gain over another, from runs of the same sessions with the same seeds.

A ratio is of sums over all runs that both have, so one that is slow for everybody cancels; 95 % by drawing
sessions again, each with all its runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from share.metrics import bootstrap
from share.metrics.bootstrap import Interval
from share.metrics.figures import AgentFigures, RunFigures

_SEED = 1  # of the draws, so that the same runs give the same table
_DIGITS = 9  # in which two errors are compared


@dataclass(frozen=True)
class Measure:
    """One figure of a run. unit: for a person."""

    name: str
    unit: str
    of: Callable[[RunFigures], float]

    @property
    def titled(self) -> str:
        """With its unit."""
        return f"{self.name}, {self.unit}" if self.unit else self.name


def _mean(kind: str, value: Callable[[AgentFigures], float]) -> Callable[[RunFigures], float]:
    """Over agents of a kind that have it; NaN without any."""

    def of(run: RunFigures) -> float:
        values = [value(agent) for agent in run.of(kind)]
        known = [v for v in values if not math.isnan(v)]
        return float(np.mean(known)) if known else math.nan

    return of


MEASURES = (
    Measure("AR latency", "ms", _mean("ar", lambda a: a.latency_ms)),
    Measure("AR frames", "ms", _mean("ar", lambda a: a.track_ms)),
    Measure("AR frames over 20 ms", "%", _mean("ar", lambda a: 100 * a.over_20ms)),
    Measure("AR corrections", "ms", _mean("ar", lambda a: a.corrected_ms)),
    Measure("robot latency", "ms", _mean("robot", lambda a: a.latency_ms)),
    Measure("merges a metre", "1/m", lambda run: run.merges_per_metre),
    Measure("AR ATE in the map", "cm", _mean("ar", lambda a: a.ate_cm)),
    Measure("robot ATE in the map", "cm", _mean("robot", lambda a: a.ate_cm)),
    Measure("AR error told", "cm", _mean("ar", lambda a: a.told_cm)),
    Measure("robot error told", "cm", _mean("robot", lambda a: a.told_cm)),
    Measure("joint ATE", "cm", lambda run: run.joint_ate_cm),
    Measure("AR RPE over 1 s", "cm", _mean("ar", lambda a: a.rpe_1s_cm)),
    Measure("AR until in a shared map", "s", _mean("ar", lambda a: a.joined_s)),
    Measure("agents in one map", "", lambda run: float(run.in_one_map)),
    Measure("AR keyframes sent", "Hz", _mean("ar", lambda a: a.rate_hz)),
    Measure("AR QoE", "", _mean("ar", lambda a: a.qoe)),
    Measure("robot QoE", "", _mean("robot", lambda a: a.qoe)),
)


@dataclass(frozen=True)
class Compared:
    """One measure of one policy: over its runs, and as a part of the base's in the same runs.

    pairs: of `of` such pairs, in how many both have it.
    """

    measure: Measure
    value: Interval
    ratio: Interval
    pairs: int
    of: int


def policies(runs: Sequence[RunFigures]) -> list[str]:
    """In the order in which they come."""
    return list(dict.fromkeys(run.conditions.policy for run in runs))


def compare(runs: Sequence[RunFigures], policy: str, base: str) -> list[Compared]:
    """`policy` against `base`, for each of `MEASURES`."""
    mine, theirs = _by_place(runs, policy), _by_place(runs, base)
    both = [place for place in mine if place in theirs]
    out = []
    for measure in MEASURES:
        rng = np.random.default_rng(_SEED)
        value = bootstrap.mean(
            [measure.of(run) for run in mine.values()], [session for session, _, _ in mine], rng
        )
        over, under = (np.array([measure.of(runs[place]) for place in both]) for runs in (mine, theirs))
        ratio = bootstrap.ratio(over, under, [session for session, _, _ in both], rng)
        out.append(Compared(measure, value, ratio, int(np.isfinite(over + under).sum()), len(both)))
    return out


def no_worse(runs: Sequence[RunFigures], policy: str, other: str) -> tuple[int, int]:
    """(in how many of agents' runs the ATE by `policy` is at most that by `other`, of how many)."""
    mine, theirs = _by_place(runs, policy), _by_place(runs, other)
    pairs = [
        (a.ate_cm, b.ate_cm)
        for place in mine
        if place in theirs
        for a, b in zip(mine[place].agents, theirs[place].agents, strict=True)
    ]
    known = [(a, b) for a, b in pairs if not (math.isnan(a) or math.isnan(b))]
    return sum(round(a, _DIGITS) <= round(b, _DIGITS) for a, b in known), len(known)


def no_worse_on_average(runs: Sequence[RunFigures], policy: str, other: str) -> tuple[int, int]:
    """The same of means over the runs of an agent on a session that both have."""
    mine, theirs = _by_place(runs, policy), _by_place(runs, other)
    sums: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for place in (place for place in mine if place in theirs):
        session, link, _ = place
        for a, b in zip(mine[place].agents, theirs[place].agents, strict=True):
            if not (math.isnan(a.ate_cm) or math.isnan(b.ate_cm)):
                sums.setdefault((session, link, a.agent), []).append((a.ate_cm, b.ate_cm))
    means = np.array([np.mean(pairs, axis=0) for pairs in sums.values()]).reshape(-1, 2).round(_DIGITS)
    return int((means[:, 0] <= means[:, 1]).sum()), len(means)


def _by_place(runs: Sequence[RunFigures], policy: str) -> dict[tuple[str, str, int], RunFigures]:
    """By what they share with runs of other policies."""
    return {
        (run.conditions.session, run.conditions.link, run.conditions.seed): run
        for run in runs
        if run.conditions.policy == policy
    }
