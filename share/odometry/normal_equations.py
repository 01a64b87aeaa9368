"""Normal equations of a window of frames and features, solved by the Schur complement of the features."""

from __future__ import annotations

import numpy as np

from share.types import F64, I64

FRAME_SIZE = 9  # columns of a frame: pose and velocity


def inverse(A: F64) -> F64:
    return np.asarray(np.linalg.inv(A), np.float64)


class BundleNormalEquations:
    """A (D, D), b (D,) of frames, 6 of the biases, the room's inverse depth, 6 of each image's error;
    cross (D, N), rho_information (N,), b_rho (N,) of the features' inverse depths. cost: the sum of
    squares."""

    def __init__(self, frames: int, features: int) -> None:
        self.bias_columns = slice(FRAME_SIZE * frames, FRAME_SIZE * frames + 6)
        self.room_column = FRAME_SIZE * frames + 6
        D = self.room_column + 1 + 6 * frames
        self.A, self.b, self.cross = np.zeros((D, D)), np.zeros(D), np.zeros((D, features))
        self.rho_information, self.b_rho = np.zeros(features), np.zeros(features)
        self.cost = 0.0

    def pose_columns(self, k: int) -> I64:
        """Return the columns of the pose of frame k."""
        return np.arange(FRAME_SIZE * k, FRAME_SIZE * k + 6)

    def offset_columns(self, k: int) -> I64:
        """Return the columns of the image error of frame k."""
        return np.arange(self.room_column + 1 + 6 * k, self.room_column + 7 + 6 * k)

    def add(self, columns: I64, J: F64, r: F64, W: F64) -> None:
        """Add residuals r (m,) with information W (m, m), of which a step J (m, n) in `columns` (n,) is
        subtracted."""
        weighted = J.T @ W
        self.A[np.ix_(columns, columns)] += weighted @ J
        self.b[columns] += weighted @ r
        self.cost += float(r @ W @ r)

    def step(self, damping: float) -> tuple[F64, F64]:
        """Return the steps of the shared unknowns (D,) and of the inverse depths (N,) (Marquardt 1963)."""
        damped = self.rho_information * (1 + damping)
        eliminated = self.cross / damped
        A = self.A + damping * np.diag(np.diag(self.A)) - eliminated @ self.cross.T
        x = np.asarray(np.linalg.solve(A, self.b - eliminated @ self.b_rho), np.float64)
        return x, (self.b_rho - self.cross.T @ x) / damped

    def covariance(self) -> F64:
        """Return the covariance of frames, biases and features."""
        eliminated = self.cross / self.rho_information
        P = inverse(self.A - eliminated @ self.cross.T)[: self.room_column, : self.room_column]
        cross_cov = -P @ eliminated[: self.room_column]
        rho_cov = np.diag(1 / self.rho_information) - eliminated[: self.room_column].T @ cross_cov
        out: F64 = np.block([[P, cross_cov], [cross_cov.T, rho_cov]])
        return (out + out.T) / 2
