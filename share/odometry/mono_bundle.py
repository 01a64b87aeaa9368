"""The first seconds of a single camera and its IMU, fitted at once.

To a camera, how fast the body is and how far the room is are one product. A filter has to take slopes
of that product before it knows either, and believes what they say. Here all images of a window are fitted
together (Levenberg-Marquardt), so that slopes are taken where the fit is.

Unknown are poses and velocities of the shots, tied by the IMU; both biases; inverse depths, about that
of the room; and what each image is off by in common. Errors are those of `share.odometry.state`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from share.array_table import ArrayTable
from share.geometry import se3
from share.geometry.camera import ImuNoise, rays
from share.odometry import feature_matching
from share.odometry.feature_matching import pose_jacobian
from share.odometry.imu_propagation import ImuPropagation, integrate
from share.odometry.normal_equations import FRAME_SIZE, BundleNormalEquations, inverse
from share.odometry.state import EXTRINSIC, FilterState
from share.types import F64, I64, ImuBatch

# ---- A start for the fit of a single camera's first seconds, from nothing.
#
# The IMU carries the first shot's state to all others: they hang on its tilt and velocity and the biases. In
# these and in depths, that rays meet is nearly linear (Dong-Si and Mourikis 2012): from anywhere, a few
# rounds of weighted least squares lead there.

IMU_STATE_SIZE = EXTRINSIC.start  # columns of pose, velocity and biases
_START_SCALES = (
    100.0,
    30.0,
    10.0,
    5.0,
    3.0,
    3.0,
)  # sigmas, round by round: what is further off counts ever less
_MIN_DEPTH_M = 0.1  # m


@dataclass(frozen=True, eq=False)
class BundleObservations(ArrayTable):
    """M times a feature was seen: by shot `at` (M,), at uv (M, 2) with sigma (M,); feature `which` (M,),
    which shot `anchor` (M,) sees on ray (M, 2)."""

    frame: I64
    anchor: I64
    feature: I64
    ray: F64
    uv: F64
    sigma: F64


class ShootingSolver:
    """first: the state at the first shot and how well it is known. carry: motions by IMU from shot to shot,
    K - 1 of them, of a state there. depth: about how far features are, m, for N of them."""

    def __init__(
        self,
        first: FilterState,
        propagate: Callable[[FilterState], list[ImuPropagation]],
        observations: BundleObservations,
        features: int,
        depth: float,
    ) -> None:
        self._first, self._propagate, self._observations, self._prior_depth = (
            first,
            propagate,
            observations,
            depth,
        )
        self._prior = inverse(first.cov[:IMU_STATE_SIZE, :IMU_STATE_SIZE])
        self.state, self.depth = first, np.full(features, depth)
        self.T, self.v, self._J_first = self._propagated()

    def solve(self) -> None:
        """Raises numpy.linalg.LinAlgError where nothing can be solved."""
        for scale in _START_SCALES:
            r, J, J_depth = self._residuals(scale)
            self._step(r, J, J_depth)
            self.T, self.v, self._J_first = self._propagated()

    def _propagated(self) -> tuple[F64, F64, F64]:
        """T (K, 4, 4), v (K, 3) of all shots, and how errors depend on that of the first (K, 15, 15)."""
        motions = self._propagate(self.state)
        s, J_first = self.state, [np.eye(IMU_STATE_SIZE)]
        for m in motions:
            J_first.append(m.transition @ J_first[-1])
        T, v = np.array([s.T, *(m.T for m in motions)]), np.array([s.v, *(m.v for m in motions)])
        return T, v, np.array(J_first)

    def _residuals(self, scale: float) -> tuple[F64, F64, F64]:
        """(M, 2) in sigmas, weighted, and what the first state's error (M, 2, 15) and depth (M, 2) take of
        them. It is the way across the ray that was seen, as large as it looks from the depth that we
        have."""
        s, cams = self._observations, self.T @ self.state.T_body_cam
        frame, anchor, ray = cams[s.frame], cams[s.anchor], rays(s.ray)[:, :, None]
        direction = anchor[:, :3, :3] @ ray
        point = direction[:, :, 0] * self.depth[s.feature, None] + anchor[:, :3, 3]
        R_cam_odom = frame[:, :3, :3].transpose(0, 2, 1)
        in_camera = (R_cam_odom @ (point - frame[:, :3, 3])[:, :, None])[:, :, 0]
        project = np.concatenate([np.tile(np.eye(2), (len(s.frame), 1, 1)), -s.uv[:, :, None]], axis=2)
        project /= (np.maximum(in_camera[:, 2], _MIN_DEPTH_M) * s.sigma)[:, None, None]
        r = -(project @ in_camera[:, :, None])[:, :, 0]
        weight = 1 / np.sqrt(1 + (r**2).sum(axis=1) / scale**2)
        project = (project @ R_cam_odom) * weight[:, None, None]
        J_pose = pose_jacobian(np.eye(3), point, np.ones(len(point)))
        J = project @ (J_pose @ (self._J_first[s.anchor, :6] - self._J_first[s.frame, :6]))
        return r * weight[:, None], J, (project @ direction)[:, :, 0]

    def _step(self, r: F64, J: F64, J_depth: F64) -> None:
        """Least squares with depths eliminated."""
        indices, N = self._observations.feature, len(self.depth)
        prior_information = 1 / self._prior_depth**2
        information = prior_information + np.bincount(indices, (J_depth**2).sum(axis=1), N)
        weighted = prior_information * (self._prior_depth - self.depth) + np.bincount(
            indices, (J_depth * r).sum(axis=1), N
        )
        shared = (J * J_depth[:, :, None]).sum(axis=1)
        cross = np.stack([np.bincount(indices, column, N) for column in shared.T])
        flat = J.reshape(-1, IMU_STATE_SIZE)
        A = self._prior + flat.T @ flat - (cross / information) @ cross.T
        b = (
            self._prior @ state_error(self._first, self.state)
            + flat.T @ r.ravel()
            - cross @ (weighted / information)
        )
        x = np.asarray(np.linalg.solve(A, b), np.float64)
        self.depth = np.maximum(self.depth + (weighted - cross.T @ x) / information, _MIN_DEPTH_M)
        delta, s = se3.exp(x[:6]), self.state
        v = delta[:3, :3] @ s.v + x[6:9]
        self.state = replace(s, T=delta @ s.T, v=v, bg=s.bg + x[9:12], ba=s.ba + x[12:])


def state_error(target: FilterState, source: FilterState) -> F64:
    """The error (15,) of pose, velocity and biases that takes one state to another."""
    return np.concatenate(
        [motion_error(target.T, target.v, source.T, source.v), target.bg - source.bg, target.ba - source.ba]
    )


def motion_error(T: F64, v: F64, from_T: F64, from_v: F64) -> F64:
    """The error (9,) that takes one pose and velocity to another."""
    delta = T @ se3.inverse(from_T)
    return np.concatenate([se3.log(delta), v - delta[:3, :3] @ from_v])


_MAX_ITERATIONS, _MIN_COST_DECREASE = (
    20,
    0.1,
)  # at most; of the cost, squared sigmas, below which it is settled
_DAMPING = 1e-4
_CAUCHY_SCALE = 2.0  # sigmas; what is further off counts ever less (Cauchy)
_BEHIND_RESIDUAL = 1e3  # sigmas, of what is behind the camera
_MIN_VARIANCE = 1e-12


@dataclass(frozen=True, eq=False)
class WindowFrame:
    """A frame at stamp_ns, IMU time, with imu since the shot before. It sees at uv (M, 2) the features ids
    (M,), which the keyframes `anchor` (M,) see on rays (M, 2). keyframe: its own id, -1 where it is none."""

    stamp_ns: int
    imu: ImuBatch
    keyframe_id: int
    feature_ids: I64
    anchor: I64
    ray: F64
    uv: F64


@dataclass(frozen=True, eq=False)
class BundleModel:
    """IMU noise and gravity; sigma of a coordinate that is seen; common (6, 6), covariance of what a whole
    image is off by. Rooms: inverse depth 1/m, sigma of its logarithm, and by how much of it a feature
    may differ."""

    noise: ImuNoise
    gravity: float
    sigma: float
    common_cov: F64
    room_rho: float
    room_log_sigma: float
    feature_spread: float


@dataclass(frozen=True, eq=False)
class BundleSolution:
    """Of K shots T (K, 4, 4) and v (K, 3), the biases (3,), inverse depths rho (N,) of features ids (N,).
    cov: of the errors, 9 a shot, 6 of the biases, one a feature. cost: of a sight, squared sigmas."""

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
        """How far the body came, as a part of how far features are."""
        baseline = np.linalg.norm(self.T[:, :3, 3] - self.T[0, :3, 3], axis=1).max()
        return float(baseline * np.median(self.rho))


def solve_bundle(frames: list[WindowFrame], first: FilterState, model: BundleModel) -> BundleSolution:
    """first: what was known at the first shot, which is a keyframe. Raises numpy.linalg.LinAlgError where
    nothing can be solved."""
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


@dataclass(frozen=True, eq=False)
class _BundleMeans:
    """Poses (K, 4, 4), velocities (K, 3), biases (3,), logarithm of the room's inverse depth, inverse
    depths (N,), and by how much the body of each image is off (K, 6), on its right."""

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
        """What a shot sees of features of other ones, by host."""
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
        """By IMU from the first shot on, where the state is s."""
        out: list[ImuPropagation] = []
        for k in range(len(self._frames) - 1):
            T, v = (out[-1].T, out[-1].v) if out else (s.T, s.v)
            out.append(self._propagate(k, T, v, s.bg, s.ba))
        return out

    def _propagate(self, k: int, T: F64, v: F64, bg: F64, ba: F64) -> ImuPropagation:
        """From shot k to the next."""
        m, a, b = self._model, self._frames[k], self._frames[k + 1]
        return integrate(T, v, bg, ba, b.imu, a.stamp_ns, b.stamp_ns, m.noise, m.gravity)

    def apply_step(self, step: F64, delta_rho: F64) -> None:
        """Means by what `Normal.step` says."""
        m, K = self.means, len(self._frames)
        e, tail = step[: FRAME_SIZE * K].reshape(-1, FRAME_SIZE), step[FRAME_SIZE * K :]
        delta = se3.exp(e[:, :6])
        v = (delta[:, :3, :3] @ m.v[:, :, None])[:, :, 0] + e[:, 6:]
        room, image_offsets = m.log_room_rho + float(tail[6]), m.image_offsets + tail[7:].reshape(K, 6)
        self.means = _BundleMeans(
            delta @ m.T, v, m.bg + tail[:3], m.ba + tail[3:6], room, m.rho + delta_rho, image_offsets
        )

    def normal_equations(self) -> BundleNormalEquations:
        """Where the means are."""
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
        """The state at shot k; by: its image's body is off by so much."""
        m = self.means
        T = m.T[k] if offset is None else m.T[k] @ se3.exp(offset)
        state = replace(self._first, T=T, v=m.v[k], bg=m.bg, ba=m.ba, keyframe_poses=m.T)
        return replace(state, feature_ids=self._ids, anchor=self._anchor, ray=self._ray, rho=m.rho)

    def _add_depth_prior(self, out: BundleNormalEquations) -> None:
        """How far rooms are, and that features are as far as the room, more or less."""
        m, room = self._model, self.means.log_room_rho
        out.add(
            np.array([out.room_column]),
            np.eye(1),
            np.array([np.log(m.room_rho) - room]),
            np.eye(1) / m.room_log_sigma**2,
        )
        share = self.means.rho * np.exp(-room)
        J_rho, J_room, r = (
            np.exp(-room) / m.feature_spread,
            -share / m.feature_spread,
            (1 - share) / m.feature_spread,
        )
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
            columns, J_rows = (
                np.r_[out.pose_columns(k), out.pose_columns(h), offset_columns],
                J[rows].reshape(-1, 18),
            )
            out.A[np.ix_(columns, columns)] += J_rows.T @ J_rows
            out.b[columns] += J_rows.T @ r[rows].ravel()
            out.cross[np.ix_(columns, indices[rows])] += shared[:, rows]

    def _linearise_frame(self, k: int) -> tuple[F64, F64, F64]:
        """Of the M sights of shot k, in sigmas: residuals (M, 2), NaN behind the camera, and slopes by
        pose, host's pose and what the image is off by (M, 2, 18), and by inverse depth (M, 2)."""
        observations, sigma, state = (
            self._observations[k],
            self._model.sigma,
            self._state_of_frame(k, self.means.image_offsets[k]),
        )
        predicted = feature_matching.predict(state, observations.feature)
        J_pose = predicted.H_pose / sigma
        J = np.concatenate([J_pose, -J_pose, J_pose @ se3.adjoint(state.T)], axis=2)
        return (observations.uv - predicted.uv) / sigma, J, predicted.H_rho / sigma

    def result(self, best: BundleNormalEquations) -> BundleSolution:
        """best: `normal_equations` of the means."""
        m, count = self.means, sum(len(s.feature) for s in self._observations)
        return BundleSolution(
            m.T, m.v, m.bg, m.ba, self._ids, m.rho, best.covariance(), best.cost / max(count, 1)
        )
