"""A path that drifts, and loops that say so."""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.mapping.graph.edges import PoseEdge
from share.types import F64

ODOMETRY = np.diag([0.004**2] * 3 + [0.01**2] * 3)
LOOP = np.diag([0.005**2] * 3 + [0.02**2] * 3)


def noisy(T: F64, cov: F64, rng: np.random.Generator) -> F64:
    return T @ se3.exp(rng.multivariate_normal(np.zeros(6), cov))


def loops_of_a_room(n: int, seed: int, loop_count: int) -> tuple[F64, F64, list[PoseEdge], list[PoseEdge]]:
    """Truth (n, 4, 4) of three rounds through a room, dead reckoning, and the edges."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 6 * np.pi, n)
    t = np.column_stack([3 * np.cos(s), 2 * np.sin(s), 1.2 + 0.2 * np.sin(3 * s)])
    zero = np.zeros(n)
    truth = se3.from_rt(se3.so3_exp(np.column_stack([zero, zero, s])), t)
    step = se3.inverse(truth[:-1]) @ truth[1:]
    odometry = [PoseEdge(i, i + 1, noisy(T, ODOMETRY, rng), ODOMETRY) for i, T in enumerate(step)]
    guess = [truth[0]]
    for edge in odometry:
        guess.append(guess[-1] @ edge.T_a_b)
    loops = []
    for _ in range(loop_count):
        a = int(rng.integers(0, n * 2 // 3))
        b = min(n - 1, a + n // 3 + int(rng.integers(-3, 4)))
        loops.append(PoseEdge(a, b, noisy(se3.inverse(truth[a]) @ truth[b], LOOP, rng), LOOP))
    return truth, np.array(guess), odometry, loops


def rms(poses: F64, truth: F64) -> float:
    return float(np.sqrt(((poses - truth)[:, :3, 3] ** 2).sum(1).mean()))
