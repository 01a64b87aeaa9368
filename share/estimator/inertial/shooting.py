"""A start for the fit of a single camera's first seconds, from nothing.

The IMU carries the first shot's state to all others: they hang on its tilt and velocity and the biases.
In these and in depths, that rays meet is nearly linear (Dong-Si and Mourikis 2012): from anywhere, a few
rounds of weighted least squares lead there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from share.columns import Columns
from share.estimator.inertial.imu import Motion
from share.estimator.inertial.normal import inverse
from share.estimator.inertial.observe import lever
from share.estimator.inertial.state import EXTRINSIC, State
from share.geometry import se3
from share.geometry.camera import rays
from share.types import F64, I64

SIDE = EXTRINSIC.start  # columns of pose, velocity and biases
_USUAL = 100.0, 30.0, 10.0, 5.0, 3.0, 3.0  # sigmas, round by round: what is further off counts ever less
_NEAREST = 0.1  # m


@dataclass(frozen=True, eq=False)
class Sights(Columns):
    """M times a feature was seen: by shot `at` (M,), at uv (M, 2) with sigma (M,); feature `which` (M,),
    which shot `host` (M,) sees on ray (M, 2)."""

    at: I64
    host: I64
    which: I64
    ray: F64
    uv: F64
    sigma: F64


class Shooting:
    """first: the state at the first shot and how well it is known. carry: motions by IMU from shot to shot,
    K - 1 of them, of a state there. depth: about how far features are, m, for N of them."""

    def __init__(
        self,
        first: State,
        carry: Callable[[State], list[Motion]],
        sights: Sights,
        features: int,
        depth: float,
    ) -> None:
        self._first, self._carry, self._sights, self._usual_depth = first, carry, sights, depth
        self._prior = inverse(first.cov[:SIDE, :SIDE])
        self.state, self.depth = first, np.full(features, depth)
        self.T, self.v, self._by_first = self._carried()

    def solve(self) -> None:
        """Raises numpy.linalg.LinAlgError where nothing can be solved."""
        for usual in _USUAL:
            r, J, by_depth = self._residuals(usual)
            self._step(r, J, by_depth)
            self.T, self.v, self._by_first = self._carried()

    def _carried(self) -> tuple[F64, F64, F64]:
        """T (K, 4, 4), v (K, 3) of all shots, and how errors depend on that of the first (K, 15, 15)."""
        motions = self._carry(self.state)
        s, by_first = self.state, [np.eye(SIDE)]
        for m in motions:
            by_first.append(m.transition @ by_first[-1])
        T, v = np.array([s.T, *(m.T for m in motions)]), np.array([s.v, *(m.v for m in motions)])
        return T, v, np.array(by_first)

    def _residuals(self, usual: float) -> tuple[F64, F64, F64]:
        """(M, 2) in sigmas, weighted, and what the first state's error (M, 2, 15) and depth (M, 2) take of
        them. It is the way across the ray that was seen, as large as it looks from the depth that we
        have."""
        s, cams = self._sights, self.T @ self.state.T_body_cam
        at, host, ray = cams[s.at], cams[s.host], rays(s.ray)[:, :, None]
        along = host[:, :3, :3] @ ray
        point = along[:, :, 0] * self.depth[s.which, None] + host[:, :3, 3]
        turn = at[:, :3, :3].transpose(0, 2, 1)
        seen = (turn @ (point - at[:, :3, 3])[:, :, None])[:, :, 0]
        across = np.concatenate([np.tile(np.eye(2), (len(s.at), 1, 1)), -s.uv[:, :, None]], axis=2)
        across /= (np.maximum(seen[:, 2], _NEAREST) * s.sigma)[:, None, None]
        r = -(across @ seen[:, :, None])[:, :, 0]
        weight = 1 / np.sqrt(1 + (r**2).sum(axis=1) / usual**2)
        across = (across @ turn) * weight[:, None, None]
        by_pose = lever(np.eye(3), point, np.ones(len(point)))
        J = across @ (by_pose @ (self._by_first[s.host, :6] - self._by_first[s.at, :6]))
        return r * weight[:, None], J, (across @ along)[:, :, 0]

    def _step(self, r: F64, J: F64, by_depth: F64) -> None:
        """Least squares with depths eliminated."""
        which, N = self._sights.which, len(self.depth)
        own = 1 / self._usual_depth**2
        known = own + np.bincount(which, (by_depth**2).sum(axis=1), N)
        wanted = own * (self._usual_depth - self.depth) + np.bincount(which, (by_depth * r).sum(axis=1), N)
        shared = (J * by_depth[:, :, None]).sum(axis=1)
        cross = np.stack([np.bincount(which, column, N) for column in shared.T])
        flat = J.reshape(-1, SIDE)
        A = self._prior + flat.T @ flat - (cross / known) @ cross.T
        b = self._prior @ off(self._first, self.state) + flat.T @ r.ravel() - cross @ (wanted / known)
        x = np.asarray(np.linalg.solve(A, b), np.float64)
        self.depth = np.maximum(self.depth + (wanted - cross.T @ x) / known, _NEAREST)
        by, s = se3.exp(x[:6]), self.state
        v = by[:3, :3] @ s.v + x[6:9]
        self.state = replace(s, T=by @ s.T, v=v, bg=s.bg + x[9:12], ba=s.ba + x[12:])


def off(to: State, of: State) -> F64:
    """The error (15,) of pose, velocity and biases that takes one state to another."""
    return np.concatenate([gap(to.T, to.v, of.T, of.v), to.bg - of.bg, to.ba - of.ba])


def gap(T: F64, v: F64, from_T: F64, from_v: F64) -> F64:
    """The error (9,) that takes one pose and velocity to another."""
    by = T @ se3.inverse(from_T)
    return np.concatenate([se3.log(by), v - by[:3, :3] @ from_v])
