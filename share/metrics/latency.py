"""Latency as every table means it (docs/architecture.md; docs/evaluation.md)."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

NOTICED_MS = 20.0  # a headset wearer notices more


class Queue:
    """How long a frame of a recording would wait if frames came at the recording's pace: for what the one
    before left to do."""

    def __init__(self) -> None:
        self._stamp_ns, self._busy_ms = 0, 0.0

    def wait_ms(self, stamp_ns: int) -> float:
        """Of the next frame."""
        return max(0.0, self._busy_ms - (stamp_ns - self._stamp_ns) * 1e-6)

    def served(self, stamp_ns: int, busy_ms: float) -> None:
        """busy_ms: from when the frame came until all work on it was done, its wait included."""
        self._stamp_ns, self._busy_ms = stamp_ns, busy_ms


@dataclass(frozen=True)
class Summary:
    """Of n values; all NaN where n is 0. Percentiles interpolate linearly."""

    n: int
    mean: float
    p50: float
    p95: float
    p99: float
    max: float

    def report(self) -> dict[str, float | None]:
        """For JSON, which knows no NaN: None instead."""
        return {k: None if math.isnan(v) else v for k, v in dataclasses.asdict(self).items()}


@dataclass(frozen=True)
class Latency:
    """Of one agent over a run, ms. over_20ms: share of frames (0..1) whose track_ms exceeds 20."""

    track_ms: Summary
    corrected_ms: Summary
    latency_ms: Summary
    over_20ms: float


def summary(values: ArrayLike) -> Summary:
    """Of values (N,), N >= 0. Raises ValueError where one is not finite."""
    v = np.asarray(values, np.float64)
    if not np.isfinite(v).all():
        raise ValueError("summary: has values that are not finite")
    if v.size == 0:
        return Summary(0, math.nan, math.nan, math.nan, math.nan, math.nan)
    p50, p95, p99 = map(float, np.percentile(v, [50, 95, 99]))
    return Summary(v.size, float(v.mean()), p50, p95, p99, float(v.max()))


def latency(track_ms: ArrayLike, corrected_ms: ArrayLike) -> Latency:
    """track_ms: of every frame; corrected_ms: of every corrected frame (NaN: was not corrected).

    An agent's latency is the mean over the multiset of both: a frame that was corrected counts twice,
    once for its local pose and once for its place in the shared map.
    """
    track = np.asarray(track_ms, np.float64)
    corrected = np.asarray(corrected_ms, np.float64)
    corrected = corrected[~np.isnan(corrected)]
    over = float((track > NOTICED_MS).mean()) if track.size else math.nan
    both = np.concatenate([track, corrected])
    return Latency(summary(track), summary(corrected), summary(both), over)
