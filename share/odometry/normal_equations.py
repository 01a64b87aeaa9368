"""Normal equations of a window of shots, whose features meet nothing but shots (Schur's complement)."""

from __future__ import annotations

import numpy as np

from share.types import F64, I64

SHOT = 9  # columns of a shot: pose and velocity


def inverse(A: F64) -> F64:
    return np.asarray(np.linalg.inv(A), np.float64)


class Normal:
    """A (D, D), b (D,) of what is shared: shots, 6 of biases, the room, 6 of each image; cross (D, N),
    depth (N,), b_rho (N,) of features' inverse depths. cost: the sum of squares."""

    def __init__(self, shots: int, features: int) -> None:
        self.biases = slice(SHOT * shots, SHOT * shots + 6)
        self.room = SHOT * shots + 6
        D = self.room + 1 + 6 * shots
        self.A, self.b, self.cross = np.zeros((D, D)), np.zeros(D), np.zeros((D, features))
        self.depth, self.b_rho = np.zeros(features), np.zeros(features)
        self.cost = 0.0

    def pose(self, k: int) -> I64:
        """Columns of the pose of shot number k,"""
        return np.arange(SHOT * k, SHOT * k + 6)

    def common(self, k: int) -> I64:
        """and of what its image is off by."""
        return np.arange(self.room + 1 + 6 * k, self.room + 7 + 6 * k)

    def add(self, at: I64, J: F64, r: F64, W: F64) -> None:
        """Residuals r (m,) of information W (m, m), of which J (m, n) times columns `at` (n,) is taken
        away."""
        weighted = J.T @ W
        self.A[np.ix_(at, at)] += weighted @ J
        self.b[at] += weighted @ r
        self.cost += float(r @ W @ r)

    def step(self, damping: float) -> tuple[F64, F64]:
        """By how much all that is shared (D,) and inverse depths (N,) should move (Marquardt 1963)."""
        depth = self.depth * (1 + damping)
        by_depth = self.cross / depth
        A = self.A + damping * np.diag(np.diag(self.A)) - by_depth @ self.cross.T
        x = np.asarray(np.linalg.solve(A, self.b - by_depth @ self.b_rho), np.float64)
        return x, (self.b_rho - self.cross.T @ x) / depth

    def covariance(self) -> F64:
        """Of shots, biases and features."""
        by_depth = self.cross / self.depth
        P = inverse(self.A - by_depth @ self.cross.T)[: self.room, : self.room]
        to_depth = -P @ by_depth[: self.room]
        own = np.diag(1 / self.depth) - by_depth[: self.room].T @ to_depth
        out: F64 = np.block([[P, to_depth], [to_depth.T, own]])
        return (out + out.T) / 2
