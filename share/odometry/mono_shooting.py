"""Initial values of the mono bundle adjustment, by single shooting.

The IMU propagates the first frame's state to all others, which depend on its tilt, its velocity and the
biases. In these and in the depths, the constraint that rays intersect is nearly linear (Dong-Si and Mourikis
2012): a few rounds of weighted least squares converge from any start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from share.array_table import ArrayTable
from share.geometry import se3
from share.geometry.camera import rays
from share.odometry.imu_propagation import ImuPropagation
from share.odometry.state import IMU_STATE_SIZE, FilterState
from share.types import F64, I64

_START_SCALES = (100.0, 30.0, 10.0, 5.0, 3.0, 3.0)  # sigmas, round by round; larger residuals weigh less
_MIN_DEPTH_M = 0.1


@dataclass(frozen=True, eq=False)
class BundleObservations(ArrayTable):
    """M observations of features.

    frame, anchor, feature (M,): indices of the observing frame, of the anchor frame and of the feature. ray
    (M, 2): in the anchor. uv (M, 2): observed, with sigma (M,).
    """

    frame: I64
    anchor: I64
    feature: I64
    ray: F64
    uv: F64
    sigma: F64


class ShootingSolver:
    """Solves for the first frame's state and the depths.

    first: the state at the first frame and its covariance. propagate: returns the K - 1 motions between
    frames by the IMU, for a state of the first. depth: initial depth, m, of the N features.
    """

    def __init__(
        self,
        first: FilterState,
        propagate: Callable[[FilterState], list[ImuPropagation]],
        observations: BundleObservations,
        features: int,
        depth: float,
    ) -> None:
        self._first = first
        self._propagate = propagate
        self._observations = observations
        self._prior_depth = depth
        self._prior = inverse(first.cov[:IMU_STATE_SIZE, :IMU_STATE_SIZE])
        self.state, self.depth = first, np.full(features, depth)
        self.T, self.v, self._J_first = self._propagated()

    def solve(self) -> None:
        """Iterate. Raises numpy.linalg.LinAlgError where the problem is singular."""
        for scale in _START_SCALES:
            r, J, J_depth = self._residuals(scale)
            self._step(r, J, J_depth)
            self.T, self.v, self._J_first = self._propagated()

    def _propagated(self) -> tuple[F64, F64, F64]:
        """Return T (K, 4, 4), v (K, 3) of all frames, and the derivatives (K, 15, 15) of their errors by
        that of the first."""
        motions = self._propagate(self.state)
        s, J_first = self.state, [np.eye(IMU_STATE_SIZE)]
        for m in motions:
            J_first.append(m.transition @ J_first[-1])
        T, v = np.array([s.T, *(m.T for m in motions)]), np.array([s.v, *(m.v for m in motions)])
        return T, v, np.array(J_first)

    def _residuals(self, scale: float) -> tuple[F64, F64, F64]:
        """Return weighted residuals (M, 2) in sigmas, their derivatives by the first state's error (M, 2, 15)
        and by depth (M, 2).

        A residual is the distance across the observed ray, divided by the present depth.
        """
        s, T_odom_cam = self._observations, self.T @ self.state.T_body_cam
        frame, anchor, ray = T_odom_cam[s.frame], T_odom_cam[s.anchor], rays(s.ray)[:, :, None]
        direction = anchor[:, :3, :3] @ ray
        point = direction[:, :, 0] * self.depth[s.feature, None] + anchor[:, :3, 3]
        R_cam_odom = frame[:, :3, :3].transpose(0, 2, 1)
        in_camera = (R_cam_odom @ (point - frame[:, :3, 3])[:, :, None])[:, :, 0]
        project = np.concatenate([np.tile(np.eye(2), (len(s.frame), 1, 1)), -s.uv[:, :, None]], axis=2)
        project /= (np.maximum(in_camera[:, 2], _MIN_DEPTH_M) * s.sigma)[:, None, None]
        r = -(project @ in_camera[:, :, None])[:, :, 0]
        weight = 1 / np.sqrt(1 + (r**2).sum(axis=1) / scale**2)
        project = (project @ R_cam_odom) * weight[:, None, None]
        J_pose = se3.point_jacobian(np.eye(3), point, np.ones(len(point)))
        J = project @ (J_pose @ (self._J_first[s.anchor, :6] - self._J_first[s.frame, :6]))
        return r * weight[:, None], J, (project @ direction)[:, :, 0]

    def _step(self, r: F64, J: F64, J_depth: F64) -> None:
        """Take a least-squares step with the depths eliminated."""
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


def inverse(A: F64) -> F64:
    return np.asarray(np.linalg.inv(A), np.float64)


def state_error(target: FilterState, source: FilterState) -> F64:
    """Return the error (15,) of pose, velocity and biases that takes `source` to `target`."""
    return np.concatenate(
        [motion_error(target.T, target.v, source.T, source.v), target.bg - source.bg, target.ba - source.ba]
    )


def motion_error(T: F64, v: F64, from_T: F64, from_v: F64) -> F64:
    """Return the error (9,) that takes one pose and velocity to another."""
    delta = T @ se3.inverse(from_T)
    return np.concatenate([se3.log(delta), v - delta[:3, :3] @ from_v])
