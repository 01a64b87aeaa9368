"""What policies gain over another, from runs of the same sessions with the same seeds.

A ratio is of sums over all runs that both have, so one that is slow for everybody cancels; 95 % by drawing
sessions again, each with all its runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from share.geometry import se3
from share.lab.evaluate.run_metrics import AgentMetrics, RunMetrics
from share.types import F64, I64

# ---- How sure a mean over runs is, by drawing their sessions again.
#
# Runs of one session with several seeds have the room and the ways in common, so it is sessions that are
# drawn, each with all its runs: were runs drawn, three seeds would look like three rooms. Sources: B. Efron
# and R. J. Tibshirani, *An Introduction to the Bootstrap*, 1993, chapter 13 (percentiles); A. C. Davison and
# D. V. Hinkley, *Bootstrap Methods and their Application*, 1997, section 3.8 (groups).

_DRAWS = 10_000
_LEVEL = 0.95


class Interval(NamedTuple):
    """A figure, and between which values it lies with 95 % confidence; NaN where one session cannot tell."""

    value: float
    low: float
    high: float


def bootstrap_mean(values: ArrayLike, sessions: Sequence[str], rng: np.random.Generator) -> Interval:
    """Of values (N,) of runs on `sessions` (N), without those that are NaN; all NaN where none is left."""
    v = np.asarray(values, np.float64)
    return bootstrap_ratio(v, np.ones(len(v)), sessions, rng)


def bootstrap_ratio(
    numerator: ArrayLike, denominator: ArrayLike, sessions: Sequence[str], rng: np.random.Generator
) -> Interval:
    """sum(over) / sum(under), (N,) each, of pairs of runs on `sessions` (N); without pairs with a NaN."""
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


_SEED = 1  # of the draws, so that the same runs give the same table
_COMPARE_DIGITS = 9  # in which two errors are compared


@dataclass(frozen=True)
class Measure:
    """One figure of a run. unit: for a person."""

    name: str
    unit: str
    value_of: Callable[[RunMetrics], float]

    @property
    def title(self) -> str:
        """With its unit."""
        return f"{self.name}, {self.unit}" if self.unit else self.name


def _mean_over_kind(kind: str, value: Callable[[AgentMetrics], float]) -> Callable[[RunMetrics], float]:
    """Over agents of a kind that have it; NaN without any."""

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
    Measure("merges a metre", "1/m", lambda run: run.merges_per_metre),
    Measure("AR ATE in the map", "cm", _mean_over_kind("ar", lambda a: a.ate_cm)),
    Measure("robot ATE in the map", "cm", _mean_over_kind("robot", lambda a: a.ate_cm)),
    Measure("AR error told", "cm", _mean_over_kind("ar", lambda a: a.told_cm)),
    Measure("robot error told", "cm", _mean_over_kind("robot", lambda a: a.told_cm)),
    Measure("joint ATE", "cm", lambda run: run.joint_ate_cm),
    Measure("AR RPE over 1 s", "cm", _mean_over_kind("ar", lambda a: a.rpe_1s_cm)),
    Measure("AR until in a shared map", "s", _mean_over_kind("ar", lambda a: a.joined_s)),
    Measure("agents in one map", "", lambda run: float(run.in_one_map)),
    Measure("AR keyframes sent", "Hz", _mean_over_kind("ar", lambda a: a.rate_hz)),
    Measure("AR QoE", "", _mean_over_kind("ar", lambda a: a.qoe)),
    Measure("robot QoE", "", _mean_over_kind("robot", lambda a: a.qoe)),
)


@dataclass(frozen=True)
class PolicyComparison:
    """One measure of one policy: over its runs, and as a part of the base's in the same runs.

    pairs: of `of` such pairs, in how many both have it.
    """

    measure: Measure
    value: Interval
    ratio: Interval
    pairs: int
    total_pairs: int


def policy_names(runs: Sequence[RunMetrics]) -> list[str]:
    """In the order in which they come."""
    return list(dict.fromkeys(run.conditions.policy for run in runs))


def compare_policies(runs: Sequence[RunMetrics], policy: str, base: str) -> list[PolicyComparison]:
    """`policy` against `base`, for each of `MEASURES`."""
    mine, theirs = _by_conditions(runs, policy), _by_conditions(runs, base)
    common = [place for place in mine if place in theirs]
    out = []
    for measure in MEASURES:
        rng = np.random.default_rng(_SEED)
        value = bootstrap_mean(
            [measure.value_of(run) for run in mine.values()], [session for session, _, _ in mine], rng
        )
        over, under = (
            np.array([measure.value_of(runs[place]) for place in common]) for runs in (mine, theirs)
        )
        ratio = bootstrap_ratio(over, under, [session for session, _, _ in common], rng)
        out.append(PolicyComparison(measure, value, ratio, int(np.isfinite(over + under).sum()), len(common)))
    return out


def count_no_worse(runs: Sequence[RunMetrics], policy: str, other: str) -> tuple[int, int]:
    """(in how many of agents' runs the ATE by `policy` is at most that by `other`, of how many)."""
    mine, theirs = _by_conditions(runs, policy), _by_conditions(runs, other)
    pairs = [
        (a.ate_cm, b.ate_cm)
        for place in mine
        if place in theirs
        for a, b in zip(mine[place].agents, theirs[place].agents, strict=True)
    ]
    known = [(a, b) for a, b in pairs if not (math.isnan(a) or math.isnan(b))]
    return sum(round(a, _COMPARE_DIGITS) <= round(b, _COMPARE_DIGITS) for a, b in known), len(known)


def count_no_worse_on_average(runs: Sequence[RunMetrics], policy: str, other: str) -> tuple[int, int]:
    """The same of means over the runs of an agent on a session that both have."""
    mine, theirs = _by_conditions(runs, policy), _by_conditions(runs, other)
    sums: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for place in (place for place in mine if place in theirs):
        session, link, _ = place
        for a, b in zip(mine[place].agents, theirs[place].agents, strict=True):
            if not (math.isnan(a.ate_cm) or math.isnan(b.ate_cm)):
                sums.setdefault((session, link, a.agent), []).append((a.ate_cm, b.ate_cm))
    means = (
        np.array([np.mean(pairs, axis=0) for pairs in sums.values()]).reshape(-1, 2).round(_COMPARE_DIGITS)
    )
    return int((means[:, 0] <= means[:, 1]).sum()), len(means)


def _by_conditions(runs: Sequence[RunMetrics], policy: str) -> dict[tuple[str, str, int], RunMetrics]:
    """By what they share with runs of other policies."""
    return {
        (run.conditions.session, run.conditions.link, run.conditions.seed): run
        for run in runs
        if run.conditions.policy == policy
    }


# ---- Whether errors are as large as an estimator says that they may be.
#
# Truth is laid over odometry by what odometry leaves free and no more: heading and position, at the first
# pose of each unbroken stretch. A wrong tilt is an error, and what it does later is too. Source: Bar-Shalom,
# Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation* (2001), 5.4.2.


@dataclass(frozen=True, eq=False)
class Deviations:
    """Of N poses, along odom's axes: rotation [rad], then translation [m]; told less true.

    errors (N, 6); cov (N, 6, 6): what the estimator says of them.
    """

    errors: F64
    cov: F64

    @property
    def sigmas(self) -> F64:
        """(N, 6)."""
        out: F64 = np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))
        return out


def deviations(T_odom_body: F64, cov: F64, T_world_body: F64, segment: I64) -> Deviations:
    """Of told poses (N, 4, 4) with covariances (N, 6, 6), perturbed on the right, against the truth
    (N, 4, 4). stretch (N,): which unbroken stretch each belongs to."""
    T_odom_world = np.zeros_like(T_world_body)
    for number in np.unique(segment):
        rows = np.flatnonzero(segment == number)
        T_odom_world[rows] = yaw_alignment(T_odom_body[rows[0]], T_world_body[rows[0]])
    true = T_odom_world @ T_world_body
    R = T_odom_body[:, :3, :3]
    rotation_errors = se3.so3_log(R @ np.swapaxes(true[:, :3, :3], 1, 2))
    errors = np.concatenate([rotation_errors, T_odom_body[:, :3, 3] - true[:, :3, 3]], axis=1)
    axes = np.zeros((len(R), 6, 6))
    axes[:, :3, :3] = axes[:, 3:, 3:] = R
    return Deviations(errors, axes @ cov @ np.swapaxes(axes, 1, 2))


def yaw_alignment(T_odom_body: F64, T_world_body: F64) -> F64:
    """T_odom_world (4, 4), a turn about the vertical and a shift, that makes the positions of the two poses
    equal and leaves no turn about the vertical between them."""
    R = T_odom_body[:3, :3] @ T_world_body[:3, :3].T
    yaw = np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])
    turn = se3.so3_exp(np.array([0.0, 0.0, yaw]))
    return se3.from_rt(turn, T_odom_body[:3, 3] - turn @ T_world_body[:3, 3])


def nees(errors: F64, cov: F64) -> F64:
    """Normalised error squared (N,) of errors (N, D) with covariances (N, D, D): D on average, if these are
    right. A covariance of nought makes it infinite."""
    scale = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    with np.errstate(divide="ignore", invalid="ignore"):
        normalised = errors / scale
        correlation = cov / (scale[:, :, None] * scale[:, None, :])
    known = np.isfinite(correlation).all(axis=(1, 2))
    out = np.full(len(errors), np.inf)
    solved = np.linalg.solve(correlation[known], normalised[known][:, :, None])[:, :, 0]
    out[known] = (normalised[known] * solved).sum(1)
    return out


def share_within(errors: F64, sigmas: F64, sigma_factor: float = 3.0) -> float:
    """Share of errors (N, D), N >= 1, that are within so many sigmas (N, D) on each axis."""
    return float((np.abs(errors) <= sigma_factor * sigmas).all(axis=1).mean())
