"""Levenberg-Marquardt on re-weighted least squares: the most likely poses of one connected part.

Odometry is Gaussian; loops are under a Cauchy kernel, since one false loop must not bend the map.
Source: Triggs et al., *Bundle Adjustment: A Modern Synthesis*, 2000; Cauchy against 30 % false
loops: docs/edge-map.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.config import GraphConfig
from share.geometry import se3
from share.graph.chains import Equations
from share.graph.linear import Edges, Residuals, jacobians, residuals
from share.graph.plumb import cost as plumb_cost
from share.graph.plumb import equations as plumb_equations
from share.graph.plumb import tilting
from share.types import F64

_FIRST_DAMPING, _MOST_DAMPING = 1e-4, 1e8
_LEAST_CURVATURE = 0.5  # of a loop along its residual, beside that across; 0.3 overshot at times


@dataclass(frozen=True, eq=False)
class Minimum:
    """poses (N, 4, 4). free (6, 6): what the held pose may do, a projector. at: the residuals there. weights
    (E,): what the kernel leaves of each edge's information. reason: why there is no minimum and the poses
    are as they were, or empty."""

    poses: F64
    free: F64
    at: Residuals
    weights: F64
    iterations: int
    reason: str = ""


def minimise(poses: F64, plumb: F64, edges: Edges, held: int, config: GraphConfig) -> Minimum:
    """From poses (N, 4, 4), in `chain_order`, with `share.graph.plumb` (N, 3) each. Pose `held` stays, to the
    bit where no plumb line is known; where one is, it tilts about its place. Deterministic."""
    with np.errstate(all="ignore"):
        return _minimise(poses, plumb, edges, held, config)


def _minimise(poses: F64, plumb: F64, edges: Edges, held: int, config: GraphConfig) -> Minimum:
    at, damping, iterations = residuals(poses, edges), 0.0, 0
    free = tilting(poses[held]) if plumb.any() else np.zeros((6, 6))

    def cost_of(at: Residuals, poses: F64) -> float:
        return _cost(at, edges, config) + plumb_cost(poses, plumb)

    cost = cost_of(at, poses)
    if not np.isfinite(cost):
        why = "the error is not finite to begin with"
        return Minimum(poses, free, at, _weights(at, edges, config), 0, why)
    equations = Equations(len(poses), edges, held, free)
    while (len(edges) or free.any()) and iterations < config.max_iterations and damping <= _MOST_DAMPING:
        iterations += 1
        step = _step(equations, at, edges, plumb_equations(poses, plumb), damping, config)
        moved = poses @ se3.exp(step)
        there = residuals(moved, edges)
        lower = cost_of(there, moved)
        if not lower <= cost:  # nor if it is not finite
            damping = max(10 * damping, _FIRST_DAMPING)
            continue
        gain, cost, poses, at = cost - lower, lower, moved, there
        damping = damping / 10 if damping > _FIRST_DAMPING else 0.0
        if np.abs(step).max() < config.step_tolerance or gain <= config.relative_tolerance * cost:
            break
    return Minimum(poses, free, at, _weights(at, edges, config), iterations)


def weighted_jacobians(at: Residuals, weights: F64, edges: Edges) -> tuple[F64, F64]:
    """By a and by b, each (E, 6, 6), so that the sum of their squares is the information."""
    root = np.sqrt(weights)[:, None, None]
    by_a, by_b = jacobians(at, edges)
    return by_a * root, by_b * root


def _step(
    equations: Equations,
    at: Residuals,
    edges: Edges,
    own: tuple[F64, F64],
    damping: float,
    config: GraphConfig,
) -> F64:
    weights = _weights(at, edges, config)
    J, softness = weighted_jacobians(at, weights, edges), np.ones(len(edges))
    if not damping:
        J, softness = _softened(J, at, weights, edges)
    whitened = at.whitened * (np.sqrt(weights) / softness)[:, None]
    try:
        return equations.step(J, whitened, own, damping, config.inner_tolerance)
    except np.linalg.LinAlgError:
        return np.full((len(equations), 6), np.nan)


def _softened(J: tuple[F64, F64], at: Residuals, weights: F64, edges: Edges) -> tuple[tuple[F64, F64], F64]:
    """Jacobians less stiff along each loop's residual, where the kernel bends away, and by how much (E,):
    without that the last millimetres take many steps (Triggs et al., section 4.3). Not for loops so
    far off that the kernel is not convex there: they need it stiff."""
    near = edges.is_loop & (weights > 0.5)
    softness = np.where(near, np.sqrt(np.maximum(2 * weights - 1, _LEAST_CURVATURE)), 1.0)
    along = at.whitened / np.sqrt(np.maximum(at.chi2, 1e-300))[:, None]
    cut = ((1 - softness)[:, None] * along)[:, :, None]
    by_a, by_b = (each - cut * (along[:, None, :] @ each) for each in J)
    return (by_a, by_b), softness


def _weights(at: Residuals, edges: Edges, config: GraphConfig) -> F64:
    """Of Cauchy's kernel: 1 / (1 + chi2 / width^2) for loops."""
    return np.where(edges.is_loop, 1 / (1 + at.chi2 / config.cauchy**2), 1.0)


def _cost(at: Residuals, edges: Edges, config: GraphConfig) -> float:
    width = config.cauchy**2
    return float(np.where(edges.is_loop, width * np.log1p(at.chi2 / width), at.chi2).sum())
