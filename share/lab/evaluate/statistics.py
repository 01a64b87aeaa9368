"""Statistics of runs: comparison of policies, bootstrap intervals.

Policies are compared over runs of the same sessions, links and seeds. A ratio is of sums over all pairs of
runs, so whatever slows all policies alike cancels. 95 % intervals by bootstrap over sessions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from share.lab.evaluate.run_metrics import AgentMetrics, RunMetrics
from share.types import F64

# Bootstrap over sessions.
#
# Runs of one session with several seeds share room and paths, so sessions are resampled, each with all its
# runs: resampling runs would make three seeds look like three rooms. Sources: B. Efron and R. J. Tibshirani,
# *An Introduction to the Bootstrap*, 1993, chapter 13 (percentiles); A. C. Davison and D. V. Hinkley,
# *Bootstrap Methods and their Application*, 1997, section 3.8 (groups).

_DRAWS = 10_000
_LEVEL = 0.95


class Interval(NamedTuple):
    """A value and its 95 % confidence interval; bounds are NaN where there is one session."""

    value: float
    low: float
    high: float


def bootstrap_mean(values: ArrayLike, sessions: Sequence[str], rng: np.random.Generator) -> Interval:
    """Return the mean of values (N,) of runs on `sessions` (N), without NaN; all NaN where none is left."""
    v = np.asarray(values, np.float64)
    return bootstrap_ratio(v, np.ones(len(v)), sessions, rng)


def bootstrap_ratio(
    numerator: ArrayLike, denominator: ArrayLike, sessions: Sequence[str], rng: np.random.Generator
) -> Interval:
    """Return sum(numerator) / sum(denominator), (N,) each, over pairs of runs on `sessions` (N), without
    pairs with a NaN."""
    a, b = np.asarray(numerator, np.float64), np.asarray(denominator, np.float64)
    known = np.isfinite(a) & np.isfinite(b)
    names, session_index = np.unique(np.array(sessions, str)[known], return_inverse=True)
    count = len(names)
    a, b = (np.bincount(session_index, values[known], count).astype(np.float64) for values in (a, b))
    if not b.sum():
        return Interval(math.nan, math.nan, math.nan)
    value = float(a.sum() / b.sum())
    if count == 1:
        return Interval(value, math.nan, math.nan)
    resampled = rng.integers(count, size=(_DRAWS, count))
    denominators = b[resampled].sum(1)
    ratios: F64 = a[resampled].sum(1)[denominators != 0] / denominators[denominators != 0]
    low, high = np.quantile(ratios, [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return Interval(value, float(low), float(high))


_SEED = 1  # of the bootstrap: the same runs give the same table
_COMPARE_DIGITS = 9  # decimals to which two errors are compared


@dataclass(frozen=True)
class Measure:
    """A quantity of a run. `name`: its column in sweep.csv. `better`: -1 where less is better, 1 where more
    is, 0 where neither."""

    name: str
    unit: str
    value_of: Callable[[RunMetrics], float]
    better: int = -1

    @property
    def title(self) -> str:
        """Name with unit."""
        return f"{self.name}, {self.unit}" if self.unit else self.name


def _mean_over_kind(kind: str, value: Callable[[AgentMetrics], float]) -> Callable[[RunMetrics], float]:
    """Return a function: the mean over a run's agents of a kind, without NaN; NaN without any."""

    def mean_of_run(run: RunMetrics) -> float:
        values = [value(agent) for agent in run.agents_of_kind(kind)]
        known = [v for v in values if not math.isnan(v)]
        return float(np.mean(known)) if known else math.nan

    return mean_of_run


MEASURES = (
    Measure("AR latency", "ms", _mean_over_kind("ar", lambda a: a.latency_ms)),
    Measure("AR frames", "ms", _mean_over_kind("ar", lambda a: a.track_ms)),
    Measure("AR frames over 20 ms", "%", _mean_over_kind("ar", lambda a: 100 * a.over_20ms)),
    Measure("AR corrections", "ms", _mean_over_kind("ar", lambda a: a.corrected_ms)),
    Measure("robot latency", "ms", _mean_over_kind("robot", lambda a: a.latency_ms)),
    Measure("merges per metre", "1/m", lambda run: run.merges_per_metre),
    Measure("AR ATE in the map", "cm", _mean_over_kind("ar", lambda a: a.ate_cm)),
    Measure("robot ATE in the map", "cm", _mean_over_kind("robot", lambda a: a.ate_cm)),
    Measure("AR estimated error", "cm", _mean_over_kind("ar", lambda a: a.estimated_error_cm), 0),
    Measure("robot estimated error", "cm", _mean_over_kind("robot", lambda a: a.estimated_error_cm), 0),
    Measure("joint ATE", "cm", lambda run: run.joint_ate_cm),
    Measure("AR RPE over 1 s", "cm", _mean_over_kind("ar", lambda a: a.rpe_1s_cm)),
    Measure("AR time to shared map", "s", _mean_over_kind("ar", lambda a: a.shared_map_s)),
    Measure("agents in one map", "", lambda run: float(run.agents_in_largest_map), 1),
    Measure("AR keyframes sent", "Hz", _mean_over_kind("ar", lambda a: a.rate_hz), 0),
    Measure("AR QoE", "", _mean_over_kind("ar", lambda a: a.qoe), 1),
    Measure("robot QoE", "", _mean_over_kind("robot", lambda a: a.qoe), 1),
)


@dataclass(frozen=True)
class PolicyComparison:
    """One measure of one policy: over its runs, and as a ratio to the base in the same runs.

    `pairs`: how many of `total_pairs` have both values.
    """

    measure: Measure
    value: Interval
    ratio: Interval
    pairs: int
    total_pairs: int


def policy_names(runs: Sequence[RunMetrics]) -> list[str]:
    """Return the policies in order of appearance."""
    return list(dict.fromkeys(run.conditions.policy for run in runs))


def compare_policies(runs: Sequence[RunMetrics], policy: str, base: str) -> list[PolicyComparison]:
    """Compare `policy` with `base` in each of `MEASURES`."""
    mine, theirs = _by_conditions(runs, policy), _by_conditions(runs, base)
    common = [key for key in mine if key in theirs]
    out = []
    for measure in MEASURES:
        rng = np.random.default_rng(_SEED)
        value = bootstrap_mean(
            [measure.value_of(run) for run in mine.values()], [session for session, _, _ in mine], rng
        )
        over, under = (np.array([measure.value_of(runs[key]) for key in common]) for runs in (mine, theirs))
        ratio = bootstrap_ratio(over, under, [session for session, _, _ in common], rng)
        out.append(PolicyComparison(measure, value, ratio, int(np.isfinite(over + under).sum()), len(common)))
    return out


def count_no_worse(runs: Sequence[RunMetrics], policy: str, other: str) -> tuple[int, int]:
    """Return in how many of agents' runs the ATE with `policy` is at most that with `other`, and of how
    many."""
    mine, theirs = _by_conditions(runs, policy), _by_conditions(runs, other)
    pairs = [
        (a.ate_cm, b.ate_cm)
        for key in mine
        if key in theirs
        for a, b in zip(mine[key].agents, theirs[key].agents, strict=True)
    ]
    known = [(a, b) for a, b in pairs if not (math.isnan(a) or math.isnan(b))]
    return sum(round(a, _COMPARE_DIGITS) <= round(b, _COMPARE_DIGITS) for a, b in known), len(known)


def count_no_worse_on_average(runs: Sequence[RunMetrics], policy: str, other: str) -> tuple[int, int]:
    """Return the same counts for means over an agent's runs on a session and link."""
    mine, theirs = _by_conditions(runs, policy), _by_conditions(runs, other)
    sums: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for key in (key for key in mine if key in theirs):
        session, link, _ = key
        for a, b in zip(mine[key].agents, theirs[key].agents, strict=True):
            if not (math.isnan(a.ate_cm) or math.isnan(b.ate_cm)):
                sums.setdefault((session, link, a.agent), []).append((a.ate_cm, b.ate_cm))
    means = (
        np.array([np.mean(pairs, axis=0) for pairs in sums.values()]).reshape(-1, 2).round(_COMPARE_DIGITS)
    )
    return int((means[:, 0] <= means[:, 1]).sum()), len(means)


def _by_conditions(runs: Sequence[RunMetrics], policy: str) -> dict[tuple[str, str, int], RunMetrics]:
    """Return the runs of a policy by session, link and seed."""
    return {
        (run.conditions.session, run.conditions.link, run.conditions.seed): run
        for run in runs
        if run.conditions.policy == policy
    }
