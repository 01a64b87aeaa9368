"""Agents that walk a simulated room with drifting odometry, and loops between what they see."""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.mapping.atlas import Atlas
from share.mapping.graph.solver import GraphSolution, PoseGraphSolver
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_solving import AppliedSolution, SolveJob
from share.types import F64, Keyframe, View

EMPTY = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))
STEP = np.diag([0.002**2] * 3 + [0.005**2] * 3)
SEEN = np.diag([0.003**2] * 3 + [0.01**2] * 3)
UP, UP_SIGMA = np.array([0.0, 0.0, 1.0]), float(np.radians(0.5))


class Walker:
    """truth (n, 4, 4) in the room; keyframes whose odometry starts anywhere and drifts."""

    def __init__(
        self,
        name: str,
        seed: int,
        n: int = 60,
        phase: float = 0.0,
        breaks: tuple[int, ...] = (),
        turn: float = 3.5 * np.pi,
    ) -> None:
        self.name = name
        rng = np.random.default_rng(seed)
        s = phase + np.linspace(0, turn, n)
        zero = np.zeros(n)
        t = np.column_stack([2.5 * np.cos(s), 2.0 * np.sin(s), 1.3 + 0.2 * np.sin(2 * s)])
        self.truth = se3.from_rt(se3.so3_exp(np.column_stack([zero, zero, s])), t)
        self.keyframes: list[Keyframe] = []
        self.T_odom_body: list[F64] = []
        for i in range(n):
            fresh = i == 0 or i in breaks
            if fresh:
                yaw = np.array([0, 0, rng.uniform(-3, 3), *rng.uniform(-1, 1, 3)])
                T, odom = se3.exp(yaw), se3.exp(yaw)
            else:
                T = se3.inverse(self.truth[i - 1]) @ self.truth[i]
                T = T @ se3.exp(rng.multivariate_normal(np.zeros(6), STEP))
                odom = self.T_odom_body[-1] @ T
            self.T_odom_body.append(odom)
            before = -1 if fresh else i - 1
            self.keyframes.append(Keyframe(i, before, i * 10**8, T, STEP, odom, UP, UP_SIGMA, EMPTY))


def loop(a: Walker, i: int, b: Walker, j: int, rng: np.random.Generator, wrong: F64 | None = None) -> Loop:
    """Keyframe j of b as recognised in keyframe i of a; `wrong` (4, 4) is added to a false one."""
    T = se3.inverse(a.truth[i]) @ b.truth[j] @ se3.exp(rng.multivariate_normal(np.zeros(6), SEEN))
    return Loop(KeyframeKey(a.name, i), KeyframeKey(b.name, j), T if wrong is None else T @ wrong, SEEN, 80)


def near_loops(a: Walker, b: Walker, rng: np.random.Generator, every: int = 4) -> list[Loop]:
    """Loops where the two truly were near each other, from every so many keyframes of b."""
    out = []
    for j in range(0, len(b.truth), every):
        away = np.linalg.norm(a.truth[:, :3, 3] - b.truth[j, :3, 3], axis=1)
        if a is b:
            away[max(0, j - 14) :] = np.inf
        i = int(away.argmin())
        if away[i] < 1.0:
            out.append(loop(a, i, b, j, rng))
    return out


def answer(atlas: Atlas, map_id: str) -> tuple[SolveJob, GraphSolution]:
    """By a solver that knows nothing before."""
    atlas.graph.edges.reset()
    job, solver = atlas.solving.make_job(map_id), PoseGraphSolver()
    solver.update(job.change)
    return job, solver.solve(job.anchor, job.covariance_nodes)


def settle(atlas: Atlas) -> list[AppliedSolution]:
    done = []
    while atlas.solving.due_maps():
        done.append(atlas.solving.apply(*answer(atlas, atlas.solving.due_maps()[0])))
    return done


def error(poses: F64, truth: F64) -> float:
    """RMS position error, m, after one rigid alignment of all."""
    from share.geometry.se3 import umeyama

    T = umeyama(poses[:, :3, 3], truth[:, :3, 3])
    return float(np.sqrt(((se3.transform(T, poses[:, :3, 3]) - truth[:, :3, 3]) ** 2).sum(1).mean()))
