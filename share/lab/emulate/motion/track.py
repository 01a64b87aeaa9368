"""The planar part of a motion: position, heading and speed at every instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.types import F64

KNOT_S = 0.005  # between the knots of a path: represents motion up to 60 Hz


@dataclass(frozen=True, eq=False)
class PlanarTrack:
    """seconds (M,) from 0 every KNOT_S; xy (M, 2) m; heading (M,) rad, without jumps; speed (M,) m/s."""

    seconds: F64
    xy: F64
    heading: F64
    speed: F64


def knot_times(duration: float) -> F64:
    """Return seconds (M,) from 0, every KNOT_S, to at least `duration`."""
    return np.arange(int(np.ceil(duration / KNOT_S - 1e-9)) + 1, dtype=np.float64) * KNOT_S


def random_wander(
    rng: np.random.Generator, seconds: F64, periods: tuple[float, float], waves: int = 4
) -> F64:
    """Return a random signal (M,) with `periods` (shortest, longest) s, rms 1, that does not repeat."""
    rates = 2 * np.pi / rng.uniform(*periods, waves)
    phases = rng.uniform(0, 2 * np.pi, waves)
    out: F64 = np.sin(seconds[:, None] * rates + phases).sum(axis=1) * np.sqrt(2 / waves)
    return out


def min_jerk(x: F64) -> F64:
    """Return the minimum-jerk step from 0 to 1 for x from 0 to 1 (Flash & Hogan, J. Neurosci. 5(7), 1985): at
    rest and without acceleration at both ends, slope 1.875 in the middle."""
    x = x.clip(0, 1)
    out: F64 = x**3 * (10 - 15 * x + 6 * x**2)
    return out
