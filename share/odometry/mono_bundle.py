"""Bundle adjustment of the first seconds of a single camera and its IMU.

A single camera measures only the product of velocity and depth. A filter would linearise that product before
it knows either, and become inconsistent. Here all frames of a window are fitted together
(Levenberg-Marquardt), so that derivatives are taken at the solution.

Unknowns are the frames' poses and velocities, linked by the IMU, both biases, inverse depths about that of
the room, and an error that all features of an image share. Errors are those of `share.odometry.state`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.odometry import feature_matching
from share.odometry.imu_propagation import ImuPropagation, integrate
from share.odometry.mono_shooting import (
    BundleObservations,
    ShootingSolver,
    inverse,
    motion_error,
    state_error,
)
from share.odometry.state import IMU_STATE_SIZE, FilterState
from share.types import F64, I64, ImuBatch

FRAME_SIZE = 9  # columns of a frame: pose and velocity
_MAX_ITERATIONS = 20
_MIN_COST_DECREASE = 0.1  # squared sigmas; with less it has converged
_DAMPING = 1e-4  # initial
_CAUCHY_SCALE = 2.0  # sigmas
_BEHIND_RESIDUAL = 1e3  # sigmas, of a feature behind the camera
_MIN_VARIANCE = 1e-12


@dataclass(frozen=True, eq=False)
class WindowFrame:
    """A frame at stamp_ns, IMU time, with the IMU samples since the frame before.

    It observes features feature_ids (M,) at uv (M, 2); keyframes with ids anchor (M,) see them on rays (M,
    2). keyframe_id: its own, -1 if it is no keyframe.
    """

    stamp_ns: int
    imu: ImuBatch
    keyframe_id: int
    feature_ids: I64
    anchor: I64
    ray: F64
    uv: F64


@dataclass(frozen=True, eq=False)
class BundleModel:
    """Noise and priors.

    sigma: of an observed coordinate. common_cov (6, 6): of the error that all features of an image share.
    room_rho: inverse depth of the room, 1/m, with room_log_sigma, the sigma of its logarithm; feature_spread:
    relative sigma of a feature's inverse depth about it.
    """

    noise: ImuNoise
    gravity: float
    sigma: float
    common_cov: F64
    room_rho: float
    room_log_sigma: float
    feature_spread: float


@dataclass(frozen=True, eq=False)
class BundleSolution:
    """T (K, 4, 4) and v (K, 3) of K frames, biases (3,), inverse depths rho (N,) of features feature_ids
    (N,).

    cov: of the errors, 9 of each frame, 6 of the biases, 1 of each feature. cost: mean squared sigmas of an
    observation.
    """

    T: F64
    v: F64
    bg: F64
    ba: F64
    feature_ids: I64
    rho: F64
    cov: F64
    cost: float

    @property
    def relative_baseline(self) -> float:
        """The body's largest distance from its start, relative to the median depth."""
        baseline = np.linalg.norm(self.T[:, :3, 3] - self.T[0, :3, 3], axis=1).max()
        return float(baseline * np.median(self.rho))


def solve_bundle(frames: list[WindowFrame], first: FilterState, model: BundleModel) -> BundleSolution:
    """Solve from `first`, the state known at the first frame, which is a keyframe.

    Raises numpy.linalg.LinAlgError where the problem is singular.
    """
    problem, damping = _BundleProblem(frames, first, model), _DAMPING
    best = problem.normal_equations()
    for _ in range(_MAX_ITERATIONS):
        means = problem.means
        problem.apply_step(*best.step(damping))
        new = problem.normal_equations()
        if not new.cost <= best.cost:
            problem.means, damping = means, damping * 10
            continue
        decrease, best, damping = best.cost - new.cost, new, damping / 10
        if decrease < _MIN_COST_DECREASE:
            break
    return problem.result(best)


class BundleNormalEquations:
    """Normal equations, solved by the Schur complement of the features.

    A (D, D), b (D,) of frames, 6 of the biases, the room's inverse depth, 6 of each image's error; cross (D,
    N), rho_information (N,), b_rho (N,) of the features' inverse depths. cost: the sum of squares.
    """

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


@dataclass(frozen=True, eq=False)
class _BundleMeans:
    """Poses (K, 4, 4), velocities (K, 3), biases (3,), logarithm of the room's inverse depth, inverse
    depths (N,), and the pose error of each image (K, 6), on the right."""

    T: F64
    v: F64
    bg: F64
    ba: F64
    log_room_rho: float
    rho: F64
    image_offsets: F64


class _BundleProblem:
    def __init__(self, frames: list[WindowFrame], first: FilterState, model: BundleModel) -> None:
        self._frames, self._first, self._model = frames, first, model
        self._prior = inverse(first.cov[:IMU_STATE_SIZE, :IMU_STATE_SIZE])
        self._common = inverse(model.common_cov)
        frame_of_keyframe = {s.keyframe_id: k for k, s in enumerate(frames) if s.keyframe_id >= 0}
        ids, anchors, ray = (
            np.concatenate([getattr(s, name) for s in frames]) for name in ("feature_ids", "anchor", "ray")
        )
        known = np.isin(anchors, list(frame_of_keyframe))
        self._ids, first_rows = np.unique(ids[known], return_index=True)
        self._anchor = np.array([frame_of_keyframe[h] for h in anchors[known][first_rows].tolist()], np.int64)
        self._ray = ray[known][first_rows]
        self._observations = [self._observations_of(k) for k in range(len(frames))]
        self.means = self._initial_means()

    def _observations_of(self, k: int) -> BundleObservations:
        """Return the observations of frame k of features anchored in other frames, sorted by anchor."""
        frame = self._frames[k]
        indices = np.searchsorted(self._ids, frame.feature_ids).clip(0, len(self._ids) - 1)
        rows = np.flatnonzero((self._ids[indices] == frame.feature_ids) & (self._anchor[indices] != k))
        rows = rows[np.argsort(self._anchor[indices[rows]], kind="stable")]
        indices, ones = indices[rows], np.ones(len(rows))
        frame_index, sigma = np.full(len(rows), k), self._model.sigma * ones
        return BundleObservations(
            frame_index, self._anchor[indices], indices, self._ray[indices], frame.uv[rows], sigma
        )

    def _initial_means(self) -> _BundleMeans:
        first, others = self._observations[0], self._observations[1:]
        solver = ShootingSolver(
            self._first,
            self._propagated,
            first.concatenate(*others),
            len(self._ids),
            1 / self._model.room_rho,
        )
        solver.solve()
        s, rho = solver.state, 1 / solver.depth
        room = float(np.log(np.median(rho)))
        return _BundleMeans(solver.T, solver.v, s.bg, s.ba, room, rho, np.zeros((len(self._frames), 6)))

    def _propagated(self, s: FilterState) -> list[ImuPropagation]:
        """Return the motions by the IMU from the first frame on, where its state is s."""
        out: list[ImuPropagation] = []
        for k in range(len(self._frames) - 1):
            T, v = (out[-1].T, out[-1].v) if out else (s.T, s.v)
            out.append(self._propagate(k, T, v, s.bg, s.ba))
        return out

    def _propagate(self, k: int, T: F64, v: F64, bg: F64, ba: F64) -> ImuPropagation:
        """Return the motion from frame k to the next."""
        m, a, b = self._model, self._frames[k], self._frames[k + 1]
        return integrate(T, v, bg, ba, b.imu, a.stamp_ns, b.stamp_ns, m.noise, m.gravity)

    def apply_step(self, step: F64, delta_rho: F64) -> None:
        """Apply a step of `BundleNormalEquations.step` to the means."""
        m, K = self.means, len(self._frames)
        e, tail = step[: FRAME_SIZE * K].reshape(-1, FRAME_SIZE), step[FRAME_SIZE * K :]
        delta = se3.exp(e[:, :6])
        v = (delta[:, :3, :3] @ m.v[:, :, None])[:, :, 0] + e[:, 6:]
        room, image_offsets = m.log_room_rho + float(tail[6]), m.image_offsets + tail[7:].reshape(K, 6)
        self.means = _BundleMeans(
            delta @ m.T, v, m.bg + tail[:3], m.ba + tail[3:6], room, m.rho + delta_rho, image_offsets
        )

    def normal_equations(self) -> BundleNormalEquations:
        """Return the normal equations at the means."""
        K, m = len(self._frames), self.means
        out = BundleNormalEquations(K, len(self._ids))
        first_now = self._state_of_frame(0)
        out.add(
            np.r_[0:FRAME_SIZE, out.bias_columns],
            np.eye(IMU_STATE_SIZE),
            state_error(self._first, first_now),
            self._prior,
        )
        self._add_depth_prior(out)
        for k in range(K - 1):
            motion = self._propagate(k, m.T[k], m.v[k], m.bg, m.ba)
            F = motion.transition[:FRAME_SIZE]
            J = np.concatenate([-F[:, :FRAME_SIZE], np.eye(FRAME_SIZE), -F[:, FRAME_SIZE:]], axis=1)
            W = inverse(motion.noise_cov[:FRAME_SIZE, :FRAME_SIZE] + _MIN_VARIANCE * np.eye(FRAME_SIZE))
            columns = np.r_[FRAME_SIZE * k : FRAME_SIZE * (k + 2), out.bias_columns]
            out.add(columns, J, motion_error(motion.T, motion.v, m.T[k + 1], m.v[k + 1]), W)
        for k in range(K):
            self._add_frame(out, k)
        return out

    def _state_of_frame(self, k: int, offset: F64 | None = None) -> FilterState:
        """Return the state at frame k, with its image's pose error `offset` (6,)."""
        m = self.means
        T = m.T[k] if offset is None else m.T[k] @ se3.exp(offset)
        state = replace(self._first, T=T, v=m.v[k], bg=m.bg, ba=m.ba, keyframe_poses=m.T)
        return replace(state, feature_ids=self._ids, anchor=self._anchor, ray=self._ray, rho=m.rho)

    def _add_depth_prior(self, out: BundleNormalEquations) -> None:
        """Add the prior of the room's inverse depth, and of the features' about it."""
        m, room = self._model, self.means.log_room_rho
        out.add(
            np.array([out.room_column]),
            np.eye(1),
            np.array([np.log(m.room_rho) - room]),
            np.eye(1) / m.room_log_sigma**2,
        )
        share = self.means.rho * np.exp(-room)
        J_rho = np.exp(-room) / m.feature_spread
        J_room = -share / m.feature_spread
        r = (1 - share) / m.feature_spread
        out.A[out.room_column, out.room_column] += J_room @ J_room
        out.b[out.room_column] += J_room @ r
        out.cross[out.room_column] += J_room * J_rho
        out.rho_information += J_rho**2
        out.b_rho += J_rho * r
        out.cost += float(r @ r)

    def _add_frame(self, out: BundleNormalEquations, k: int) -> None:
        offset_columns = out.offset_columns(k)
        out.add(offset_columns, np.eye(6), -self.means.image_offsets[k], self._common)
        indices, anchor = self._observations[k].feature, self._observations[k].anchor
        if len(indices) == 0:
            return
        r, J, J_rho = self._linearise_frame(k)
        squared = np.nan_to_num((r**2).sum(axis=1), nan=_BEHIND_RESIDUAL**2)
        out.cost += float(_CAUCHY_SCALE**2 * np.log1p(squared / _CAUCHY_SCALE**2).sum())
        weight = 1 / np.sqrt(1 + squared / _CAUCHY_SCALE**2)
        r, J_rho = (np.nan_to_num(x) * weight[:, None] for x in (r, J_rho))
        J = np.nan_to_num(J) * weight[:, None, None]
        out.rho_information[indices] += (J_rho**2).sum(axis=1)
        out.b_rho[indices] += (J_rho * r).sum(axis=1)
        shared = (J * J_rho[:, :, None]).sum(axis=1).T
        for h in np.unique(anchor).tolist():
            rows = anchor == h
            columns = np.r_[out.pose_columns(k), out.pose_columns(h), offset_columns]
            J_rows = J[rows].reshape(-1, 18)
            out.A[np.ix_(columns, columns)] += J_rows.T @ J_rows
            out.b[columns] += J_rows.T @ r[rows].ravel()
            out.cross[np.ix_(columns, indices[rows])] += shared[:, rows]

    def _linearise_frame(self, k: int) -> tuple[F64, F64, F64]:
        """Return residuals (M, 2) of frame k in sigmas, NaN behind the camera, and their derivatives.

        The derivatives: by pose, anchor's pose and image error (M, 2, 18), and by inverse depth (M, 2).
        """
        observations = self._observations[k]
        sigma = self._model.sigma
        state = self._state_of_frame(k, self.means.image_offsets[k])
        predicted = feature_matching.predict(state, observations.feature)
        J_pose = predicted.H_pose / sigma
        J = np.concatenate([J_pose, -J_pose, J_pose @ se3.adjoint(state.T)], axis=2)
        return (observations.uv - predicted.uv) / sigma, J, predicted.H_rho / sigma

    def result(self, best: BundleNormalEquations) -> BundleSolution:
        """Return the solution at the means, whose normal equations are `best`."""
        m, count = self.means, sum(len(s.feature) for s in self._observations)
        return BundleSolution(
            m.T, m.v, m.bg, m.ba, self._ids, m.rho, best.covariance(), best.cost / max(count, 1)
        )
