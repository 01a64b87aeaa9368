"""Camera and IMU on one curve: where the cameras sit on the IMU, and how far their clocks are apart.

Method: Furgale, Rehder, Siegwart, *Unified temporal and spatial calibration for multi-sensor systems* (IROS
2013), with splines as in spline.py. Levenberg-Marquardt; the spread that corners are weighed by is found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from share.calibration.bundle import View
from share.calibration.camera_imu.normal import Sigmas, covers, inertial, normal, poses
from share.calibration.camera_imu.sights import Sights, seen, sights
from share.calibration.camera_imu.solve import Arrow, arrow, solve
from share.calibration.camera_imu.start import (
    EDGE_S,
    NODE_S,
    Alignment,
    align,
    first_poses,
    first_state,
    refined_poses,
)
from share.calibration.camera_imu.state import SHARED, SHIFT, State
from share.errors import DataError, MisfitError
from share.geometry.camera import ImuNoise, Rig
from share.geometry.target import Target
from share.types import F64, I64, ImuBatch

_HOLE_NS = 100_000_000  # longer without an IMU sample, and the curve goes its own way
_FIRST_PX = 1.0
_LEAST_PX = 0.01  # below this corners are not found, whatever the residuals say
_BIAS_SIGMA = np.repeat([0.2, 1.0], 3)  # rad/s, m/s^2: no IMU is worse
_LEAST_WALK = 1e-7
_ROUNDS, _STEPS = 3, 30
_STILL = 1e-7  # relative fall of the cost at which it has arrived


@dataclass(frozen=True, eq=False)
class Fit:
    """What was found. covariance (7, 7): of T_imu_cam0 Exp(xi) and the shift. sigmas: what residuals were
    judged by; stated: as the IMU's file has them. of each camera corners (C, 2) px and their frames (C,);
    gyro, accel (N, 3): residuals. stamps_ns: of pictures, camera's clock; imu: samples used."""

    state: State
    covariance: F64
    sigmas: Sigmas
    stated: Sigmas
    sights: Sights
    imu: ImuBatch
    corners: tuple[F64, ...]
    gyro: F64
    accel: F64
    began: Alignment

    @property
    def T_imu_cam0(self) -> F64:
        return self.state.T_imu_cam0

    @property
    def shift_s(self) -> float:
        return self.state.shift_s

    @property
    def sigma_rotation(self) -> F64:
        """(3,) rad, about the IMU's axes."""
        return self._in_imu(slice(0, 3))

    @property
    def sigma_position(self) -> F64:
        """(3,) m, of cam0 along the IMU's axes."""
        return self._in_imu(slice(3, 6))

    @property
    def sigma_shift(self) -> float:
        return float(np.sqrt(self.covariance[SHIFT, SHIFT]))

    def _in_imu(self, part: slice) -> F64:
        R = self.T_imu_cam0[:3, :3]
        return np.sqrt(np.diag(R @ self.covariance[part, part] @ R.T))


def fit(
    stamps_ns: I64,
    views: Sequence[View],
    target: Target,
    rig: Rig,
    imu: ImuBatch,
    noise: ImuNoise,
    within_s: float = 0.5,
    told: Callable[[int, int], None] = lambda done, total: None,
) -> Fit:
    """From views at stamps (F,) rising and the IMU of one recording; intrinsics and T_cam1_cam0 are `rig`'s.
    told: rounds done, of how many.

    Raises DataError where something is missing or not told, MisfitError where the two are not of one motion.
    """
    cameras = tuple(c for c in (rig.cam0, rig.cam1) if c is not None)[: len(views[0].seen) if views else 0]
    mounts = [np.eye(4), np.eye(4) if rig.T_cam1_cam0 is None else rig.T_cam1_cam0]
    T, enough = first_poses(views, target, cameras, mounts)
    corners = sights(stamps_ns, views, target, cameras, rig.T_cam1_cam0).take(enough)
    T = refined_poses(corners, T[enough])
    found = align(corners.stamps_ns, T, imu, within_s)
    state = first_state(corners.stamps_ns, T, imu, found)
    inside = covers(state.curve, corners.stamps_ns, state.shift_s, EDGE_S)
    batch = _Batch(corners.take(inside), _during(imu, state), noise)
    stated = batch.stated()
    sigmas = replace(stated, px=_FIRST_PX)
    for done in range(_ROUNDS):
        told(done, _ROUNDS)
        state = batch.descend(state, sigmas)
        sigmas = batch.spread(state, stated)
    told(_ROUNDS, _ROUNDS)
    return batch.report(state, sigmas, stated, found)


def _during(imu: ImuBatch, state: State) -> ImuBatch:
    """Samples on the curve. Raises DataError for a hole among them."""
    used = imu.take(covers(state.curve, imu.stamps_ns, 0.0, 0.0))
    longest = int(np.diff(used.stamps_ns).max(initial=0))
    if longest > _HOLE_NS:
        raise DataError(f"IMU: nothing for {longest * 1e-9:.2f} s while the board was seen; record it again")
    return used


@dataclass(frozen=True, eq=False)
class _Batch:
    """One problem."""

    sights: Sights
    imu: ImuBatch
    noise: ImuNoise

    def stated(self) -> Sigmas:
        """A sample's noise, by the density that the IMU's file has and the rate that the samples have."""
        root = float(np.sqrt(1e9 / np.median(np.diff(self.imu.stamps_ns))))
        return Sigmas(_LEAST_PX, self.noise.gyro_density * root, self.noise.accel_density * root)

    def descend(self, state: State, sigmas: Sigmas) -> State:
        """Downhill until the cost stands still. Raises MisfitError where it never does."""
        damping, (system, cost) = 1e-5, self._at(state, sigmas)
        if not np.isfinite(cost):
            raise MisfitError(
                "camera and IMU: the board would lie behind a camera; is --target the board shown?"
            )
        for _ in range(_STEPS):
            knots, border, _ = _solved(system, damping)
            trial = state.moved(knots, border)
            after, trial_cost = self._at(trial, sigmas)
            if not trial_cost < cost:
                if damping > 1e6 or trial_cost - cost < _STILL * cost:
                    return state
                damping *= 10
                continue
            arrived = cost - trial_cost < _STILL * cost
            state, system, cost, damping = trial, after, trial_cost, max(damping / 10, 1e-12)
            if arrived:
                return state
        raise MisfitError(
            f"camera and IMU: no solution after {_STEPS} steps; are --target, --camera and --imu of this rig?"
        )

    def _at(self, state: State, sigmas: Sigmas) -> tuple[Arrow, float]:
        one = normal(state, self.sights, self.imu, sigmas)
        system = arrow(one, state)
        return system, one.cost + self._biases(state, system)

    def _biases(self, state: State, system: Arrow) -> float:
        """Adds what holds the biases: their first node hardly, each next one by the walk. The cost."""
        walk = np.repeat([self.noise.gyro_walk, self.noise.accel_walk], 3)
        weight = 1 / (np.maximum(walk, _LEAST_WALK) ** 2 * NODE_S)
        g = system.g_border[SHARED:].reshape(-1, 6)  # a view
        steps = np.diff(state.biases, axis=0)
        own = np.zeros_like(state.biases)
        own[0] += _BIAS_SIGMA**-2
        own[1:] += weight
        own[:-1] += weight
        here = np.arange(SHARED, SHARED + state.biases.size)
        system.corner[here, here] += own.reshape(-1)
        across = np.tile(weight, len(steps))
        system.corner[here[:-6], here[6:]] -= across
        system.corner[here[6:], here[:-6]] -= across
        g[1:] -= weight * steps
        g[:-1] += weight * steps
        g[0] -= state.biases[0] / _BIAS_SIGMA**2
        return float(((state.biases[0] / _BIAS_SIGMA) ** 2).sum() + (weight * steps**2).sum()) / 2

    def spread(self, state: State, stated: Sigmas) -> Sigmas:
        """What residuals show: of corners as it is, of the IMU where it is more than stated."""
        corners = np.concatenate(self._corners(state))
        px = float(np.median(np.linalg.norm(corners, axis=1))) / 1.1774
        gyro, accel = (float(np.sqrt((part**2).mean())) for part in self._inertial(state))
        return Sigmas(max(px, _LEAST_PX), max(gyro, stated.gyro), max(accel, stated.accel))

    def _corners(self, state: State) -> tuple[F64, ...]:
        T = poses(state, self.sights.stamps_ns)
        return tuple(seen(self.sights, eye, T)[0] for eye in range(len(self.sights.cameras)))

    def _inertial(self, state: State) -> tuple[F64, F64]:
        left = inertial(state, self.imu)[0]
        return left[:, :3], left[:, 3:]

    def report(self, state: State, sigmas: Sigmas, stated: Sigmas, began: Alignment) -> Fit:
        covariance = _solved(self._at(state, sigmas)[0], 0.0)[2][:7, :7]
        gyro, accel = self._inertial(state)
        return Fit(
            state, covariance, sigmas, stated, self.sights, self.imu, self._corners(state), gyro, accel, began
        )


def _solved(system: Arrow, damping: float) -> tuple[F64, F64, F64]:
    try:
        return solve(system, damping)
    except np.linalg.LinAlgError:
        raise DataError(
            "camera and IMU: the recording does not tell the motion; move and turn more"
        ) from None
