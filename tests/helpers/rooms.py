"""Simulated pose graphs of a room as an edge has them: agents that walk about 9 x 6 m and meet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.mapping.graph.edges import PoseEdge
from share.types import F64

ODOMETRY = np.diag([0.004**2] * 3 + [0.01**2] * 3)
LOOP = np.diag([0.005**2] * 3 + [0.02**2] * 3)
ROOM = np.array([9.0, 6.0])  # m
STEP = 0.25  # m between keyframes
REACH = 1.0  # m, of a loop


@dataclass(frozen=True, eq=False)
class Room:
    """Keyframe i is agent i % agents'. truth, guess (N, 4, 4): where it was, and where odometry from
    the agent's first keyframe lays it. odometry: by keyframe, None for an agent's first. loops: from
    an older keyframe to one, by the younger; an agent's first has a loop if it has no odometry."""

    truth: F64
    guess: F64
    odometry: list[PoseEdge | None]
    loops: list[list[PoseEdge]]

    def __len__(self) -> int:
        return len(self.truth)

    @property
    def chain(self) -> list[PoseEdge]:
        return [edge for edge in self.odometry if edge is not None]

    @property
    def closures(self) -> list[PoseEdge]:
        return [edge for edges in self.loops for edge in edges]


def simulate(n: int, agents: int, seed: int, density: float = 1.0) -> Room:
    """n keyframes; every second has 1 to 3 loops to older ones within a metre; `density` below 1 thins
    them, above 1 it adds."""
    rng = np.random.default_rng(seed)
    walks = [_walk(rng) for _ in range(agents)]
    truth = np.array([next(walks[i % agents]) for i in range(n)])
    guess = truth.copy()
    odometry: list[PoseEdge | None] = [None] * min(agents, n)
    for i in range(agents, n):
        edge = measured(truth, i - agents, i, ODOMETRY, rng)
        odometry.append(edge)
        guess[i] = se3.orthonormal(guess[i - agents] @ edge.T_a_b)
    loops = [_loops(truth, i, agents, rng, density) for i in range(n)]
    return Room(truth, guess, odometry, loops)


def measured(truth: F64, a: int, b: int, cov: F64, rng: np.random.Generator) -> PoseEdge:
    noise = se3.exp(rng.multivariate_normal(np.zeros(6), cov))
    return PoseEdge(a, b, se3.orthonormal(se3.inverse(truth[a]) @ truth[b] @ noise), cov)


def false_loops(room: Room, count: int, seed: int) -> list[PoseEdge]:
    """Between any two keyframes, and saying anything."""
    rng = np.random.default_rng(seed)
    pairs = (rng.choice(len(room), 2, replace=False) for _ in range(count))
    return [PoseEdge(int(a), int(b), se3.exp(rng.normal(0, [0.5] * 3 + [1.5] * 3)), LOOP) for a, b in pairs]


def _walk(rng: np.random.Generator) -> Iterator[F64]:
    """Straight to one point after the other, looking ahead, the head bobbing."""
    here, ahead = rng.uniform(0.5, ROOM - 0.5), 0.0
    while True:
        goal = rng.uniform(0.5, ROOM - 0.5)
        way = goal - here
        bearing = np.arctan2(way[1], way[0])
        for _ in range(int(np.hypot(*way) / STEP)):
            here = here + STEP * way / np.hypot(*way)
            ahead += np.clip((bearing - ahead + np.pi) % (2 * np.pi) - np.pi, -0.5, 0.5)
            tilt = np.append(rng.normal(0, 0.05, 2), 0)
            T = se3.exp(np.array([0, 0, ahead, 0, 0, 0])) @ se3.exp(np.append(tilt, np.zeros(3)))
            T[:3, 3] = *here, 1.6 + rng.normal(0, 0.03)
            yield T


def _loops(truth: F64, i: int, agents: int, rng: np.random.Generator, density: float) -> list[PoseEdge]:
    if i // agents % 2 or i == 0 or (rng.random() > density and i >= agents):
        return []
    older = np.arange(max(0, i - 10 * agents)) if i >= 11 * agents else np.arange(i)
    other = older[(older % agents != i % agents) | (i - older >= 10 * agents)]
    if not len(other):
        return []
    away = np.linalg.norm(truth[other, :3, 3] - truth[i, :3, 3], axis=1)
    near = other[away < REACH]
    if i < agents:  # an agent joins: by the nearest
        near = other[[away.argmin()]]
    chosen = rng.permutation(near)[: round(rng.integers(1, 4) * max(1.0, density))]
    return [measured(truth, int(a), i, LOOP, rng) for a in chosen]
