"""What is held against two agents: how severe it is, and in which words.

A severity of 1 begins a disagreement. Each finding is (severity, of the second agent against the first, of
the first against the second).
"""

from __future__ import annotations

import numpy as np

from share.graph.posegraph import Edge
from share.merge.consistency import Estimate, Witness
from share.types import F64

_SIGMAS = 4.5  # that a difference must have: of thousands of comparisons none by chance
_TILT = np.radians(1.0)  # rad, less does no harm
_ENOUGH = 8  # loops before their ups say anything

Finding = tuple[float, str, str]


def tilt_between(
    up_a: F64, sigma_a: float, up_b: F64, sigma_b: float, edge: Edge
) -> tuple[float, float] | None:
    """Angle between two ups (3,) across a loop, and its sigma, rad; None if one is not known."""
    if not up_a.any() or not up_b.any():
        return None
    there = edge.T_a_b[:3, :3] @ up_b
    cross = np.linalg.norm(np.cross(up_a, there)) / np.linalg.norm(up_a) / np.linalg.norm(up_b)
    sigma = np.sqrt(sigma_a**2 + sigma_b**2 + np.trace(edge.cov[:3, :3]) / 3)
    return float(np.arcsin(min(1.0, float(cross)))), float(sigma)


def by_gravity(loops: list[Witness]) -> list[Finding]:
    known = np.array([w.tilt for w in loops if w.tilt is not None]).reshape(-1, 2)
    if len(known) < _ENOUGH:
        return []
    angle, sigmas = float(np.median(known[:, 0])), float(np.median(known[:, 0] / known[:, 1]))
    text = f"its up is {np.degrees(angle):.1f} degrees off"
    return [(min(angle / _TILT, sigmas / _SIGMAS), text, text)]


def severity_of(found: Estimate, harmless: float) -> float:
    """1 where it is as large as may be, or as sure as must be, whichever comes later."""
    return min(abs(found.value) / harmless, found.significance / _SIGMAS)


def told(found: Estimate, harmless: float, text: str, words: tuple[str, str]) -> Finding:
    """Severity, and the text for either side."""
    size = f"{100 * abs(np.expm1(found.value)):.1f} ± {100 * np.exp(found.value) * found.sigma:.1f}"
    more, less = (text.format(size, word) for word in words)
    return (severity_of(found, harmless), *((more, less) if found.value > 0 else (less, more)))


def worst(said: list[str]) -> str:
    """Of each kind of thing the first."""
    kinds = {" ".join(text.split()[:2]): text for text in reversed(said)}
    return ", ".join(text for text in said if text in kinds.values())
