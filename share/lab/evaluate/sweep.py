"""Settings tried one after the other: a grid of them, or points that are drawn."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from share.config import Config
from share.errors import UsageError
from share.lab.evaluate import statistics
from share.lab.evaluate.campaign import Planned, check_names
from share.lab.evaluate.figures import RunFigures
from share.lab.evaluate.play import Terms
from share.lab.evaluate.statistics import MEASURES
from share.plain_data import from_mapping, load_yaml, to_mapping
from share.recordings.session import Session

_SEED = 20261123
Point = tuple[str, ...]  # a value of each axis, as YAML has it


@dataclass(frozen=True)
class Axis:
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
    def parse(cls, text: str) -> Axis:
        """`control.kp=0.2,0.8`, `control.kp=0.1:3`, `a.b+c.d=1,2`. Raises UsageError."""
        name, found, said = text.partition("=")
        names = tuple(name.split("+"))
        if not found or not said or any(len(one.split(".")) != 2 for one in names):
            raise UsageError(f"--set {text}: give SECTION.NAME=VALUE,VALUE… or SECTION.NAME=LOW:HIGH")
        if ":" not in said:
            return cls(names, tuple(said.split(",")))
        try:
            low, high = map(float, said.split(":"))
        except ValueError:
            raise UsageError(f"--set {text}: LOW:HIGH are two numbers") from None
        if not 0 <= low < high < math.inf:
            raise UsageError(f"--set {text}: LOW must be below HIGH, and neither negative")
        return cls(names, (), low, high)

    def draw(self, u: float) -> str:
        """At u, from 0 to 1: evenly, or by the logarithm where that is within a range."""
        if self.values:
            return self.values[min(int(u * len(self.values)), len(self.values) - 1)]
        if self.low > 0:
            return f"{self.low * (self.high / self.low) ** u:.4g}"
        return f"{self.low + (self.high - self.low) * u:.4g}"


def grid(axes: Sequence[Axis]) -> list[Point]:
    """Every combination, once. Raises UsageError where an axis is a range."""
    for axis in axes:
        if axis.is_range:
            raise UsageError(f"--set {axis.name}: a range is for --random N; give values for a grid")
    return list(dict.fromkeys(itertools.product(*(axis.values for axis in axes))))


def drawn(axes: Sequence[Axis], count: int, seed: int) -> list[Point]:
    """`count` points; the same seed gives the same ones, and more of them the same first. Fewer where listed
    values make some of them one."""
    u = np.random.default_rng(seed).random((count, len(axes)))
    points = (tuple(axis.draw(x) for axis, x in zip(axes, row, strict=True)) for row in u.tolist())
    return list(dict.fromkeys(points))


def at(config: Config, axes: Sequence[Axis], point: Point) -> Config:
    """`config` but for the settings of `point`. Raises ConfigError naming the one that is wrong."""
    mapping: dict[str, Any] = to_mapping(config)
    for axis, value in zip(axes, point, strict=True):
        for name in axis.names:
            section, key = name.split(".")
            mapping.setdefault(section, {})[key] = load_yaml(value, "--set")
    return from_mapping(Config, mapping, "--set")


def planned(
    sessions: Sequence[Session],
    axes: Sequence[Axis],
    points: Sequence[Point],
    seeds: Sequence[int],
    terms: Terms,
    out: Path,
    config: Config,
) -> list[tuple[Planned, Point]]:
    """All runs, with their points. Raises UsageError, ConfigError."""
    check_names(sessions)
    made = {point: at(config, axes, point) for point in points}
    return [
        (
            Planned(session, replace(terms, seed=seed), out / _name(session, axes, point, seed), made[point]),
            point,
        )
        for seed in seeds
        for session in sessions
        for point in points
    ]


def table(axes: Sequence[Axis], runs: Sequence[tuple[Point, RunFigures]]) -> list[dict[str, Any]]:
    """A row a point, in the order in which they first come: its settings, how many runs, and of each measure
    the mean with its interval."""
    rows = []
    for point in dict.fromkeys(point for point, _ in runs):
        mine = [run for of, run in runs if of == point]
        rng = np.random.default_rng(_SEED)
        sessions = [run.conditions.session for run in mine]
        means = {m.name: statistics.mean([m.of(run) for run in mine], sessions, rng) for m in MEASURES}
        named = dict(zip((axis.name for axis in axes), point, strict=True))
        rows.append({"settings": named, "runs": len(mine), "means": means})
    return rows


def heat(axes: Sequence[Axis], rows: Sequence[Mapping[str, Any]], measure: str) -> np.ndarray[Any, Any]:
    """(V0, V1): the mean of a measure over the first two axes' values, and over all others."""
    first, second = axes[:2]
    out = np.full((len(first.values), len(second.values)), np.nan)
    for i, j in np.ndindex(out.shape):
        here = [
            row["means"][measure].value
            for row in rows
            if row["settings"][first.name] == first.values[i]
            and row["settings"][second.name] == second.values[j]
        ]
        out[i, j] = np.mean(here) if here else np.nan
    return out


def _name(session: Session, axes: Sequence[Axis], point: Point, seed: int) -> str:
    told = ";".join(f"{axis.name}={value}" for axis, value in zip(axes, point, strict=True))
    return f"{session.folder.resolve().name}-{seed}-{hashlib.sha256(told.encode()).hexdigest()[:10]}"
