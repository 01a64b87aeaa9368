"""Sweeps of settings: a grid, or randomly drawn points."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from share.config import Config, with_policy
from share.errors import UsageError
from share.lab.evaluate import statistics
from share.lab.evaluate.campaign import PlannedRun, check_unique_names
from share.lab.evaluate.real_time import RunOptions
from share.lab.evaluate.run_metrics import RunMetrics
from share.lab.evaluate.statistics import MEASURES
from share.plain_data import from_mapping, to_mapping
from share.recordings.session import Session
from share.strict_yaml import load_yaml

_SEED = 20261123
Point = tuple[str, ...]  # a value of each axis, in YAML


@dataclass(frozen=True)
class SweepAxis:
    """Settings (`section.name`) that share a value: one of `values`, or drawn from `low` to `high`."""

    names: tuple[str, ...]
    values: tuple[str, ...] = ()
    low: float = math.nan
    high: float = math.nan

    @property
    def name(self) -> str:
        return "+".join(self.names)

    @property
    def is_range(self) -> bool:
        return not self.values

    @classmethod
    def parse(cls, text: str) -> SweepAxis:
        """Parse `control.kp=0.2,0.8`, `control.kp=0.1:3` or `a.b+c.d=1,2`. Raises UsageError."""
        name, separator, values_text = text.partition("=")
        names = tuple(name.split("+"))
        if not separator or not values_text or any(len(one.split(".")) != 2 for one in names):
            raise UsageError(f"--set {text}: give SECTION.NAME=VALUE,VALUE… or SECTION.NAME=LOW:HIGH")
        if ":" not in values_text:
            return cls(names, tuple(values_text.split(",")))
        try:
            low, high = map(float, values_text.split(":"))
        except ValueError:
            raise UsageError(f"--set {text}: LOW and HIGH must be numbers") from None
        if not 0 <= low < high < math.inf:
            raise UsageError(f"--set {text}: LOW must be below HIGH, and both at least 0")
        return cls(names, (), low, high)

    def draw(self, u: float) -> str:
        """Return the value at u in 0..1: uniform, or log-uniform within a range above 0."""
        if self.values:
            return self.values[min(int(u * len(self.values)), len(self.values) - 1)]
        if self.low > 0:
            return f"{self.low * (self.high / self.low) ** u:.4g}"
        return f"{self.low + (self.high - self.low) * u:.4g}"


def grid(axes: Sequence[SweepAxis]) -> list[Point]:
    """Return every combination, once. Raises UsageError where an axis is a range."""
    for axis in axes:
        if axis.is_range:
            raise UsageError(f"--set {axis.name}: a range needs --random N; give values for a grid")
    return list(dict.fromkeys(itertools.product(*(axis.values for axis in axes))))


def random_points(axes: Sequence[SweepAxis], count: int, seed: int) -> list[Point]:
    """Return `count` points, fewer where listed values make some of them equal.

    Deterministic for a given seed; a larger count extends the list.
    """
    u = np.random.default_rng(seed).random((count, len(axes)))
    points = (tuple(axis.draw(x) for axis, x in zip(axes, row, strict=True)) for row in u.tolist())
    return list(dict.fromkeys(points))


def config_at(config: Config, axes: Sequence[SweepAxis], point: Point) -> Config:
    """Return `config` with the settings of `point`. Raises ConfigError with the name of a wrong one."""
    mapping: dict[str, Any] = to_mapping(config)
    for axis, value in zip(axes, point, strict=True):
        for name in axis.names:
            section, key = name.split(".")
            mapping.setdefault(section, {})[key] = load_yaml(value, "--set")
    return from_mapping(Config, mapping, "--set")


def plan_sweep(
    sessions: Sequence[Session],
    axes: Sequence[SweepAxis],
    points: Sequence[Point],
    seeds: Sequence[int],
    options: RunOptions,
    out: Path,
    config: Config,
) -> list[tuple[PlannedRun, Point]]:
    """Return all runs, with their points. Raises UsageError, ConfigError."""
    check_unique_names(sessions)
    config = with_policy(config, options.policy)
    configs = {point: config_at(config, axes, point) for point in points}
    return [
        (
            PlannedRun(
                session,
                replace(options, policy=configs[point].edge.policy, seed=seed),
                out / _run_name(session, axes, point, seed),
                configs[point],
            ),
            point,
        )
        for seed in seeds
        for session in sessions
        for point in points
    ]


def sweep_table(axes: Sequence[SweepAxis], runs: Sequence[tuple[Point, RunMetrics]]) -> list[dict[str, Any]]:
    """Return a row per point, in order of appearance: its settings, the number of runs, and the mean of
    each measure with its interval."""
    rows = []
    for point in dict.fromkeys(point for point, _ in runs):
        point_runs = [run for of, run in runs if of == point]
        rng = np.random.default_rng(_SEED)
        sessions = [run.conditions.session for run in point_runs]
        means = {
            m.name: statistics.bootstrap_mean([m.value_of(run) for run in point_runs], sessions, rng)
            for m in MEASURES
        }
        settings = dict(zip((axis.name for axis in axes), point, strict=True))
        rows.append({"settings": settings, "runs": len(point_runs), "means": means})
    return rows


def heat_map(
    axes: Sequence[SweepAxis], rows: Sequence[Mapping[str, Any]], measure: str
) -> np.ndarray[Any, Any]:
    """Return (V0, V1): the mean of a measure by the first two axes' values, over all others."""
    first, second = axes[:2]
    out = np.full((len(first.values), len(second.values)), np.nan)
    for i, j in np.ndindex(out.shape):
        means = [
            row["means"][measure].value
            for row in rows
            if row["settings"][first.name] == first.values[i]
            and row["settings"][second.name] == second.values[j]
        ]
        out[i, j] = np.mean(means) if means else np.nan
    return out


def _run_name(session: Session, axes: Sequence[SweepAxis], point: Point, seed: int) -> str:
    key_text = ";".join(f"{axis.name}={value}" for axis, value in zip(axes, point, strict=True))
    return f"{session.folder.resolve().name}-{seed}-{hashlib.sha256(key_text.encode()).hexdigest()[:10]}"
