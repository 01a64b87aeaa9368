"""Least squares over a whole recording, by Levenberg and Marquardt, and how large its residuals are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.errors import DataError, MisfitError
from share.geometry.camera import ImuNoise
from share.lab.calibrate.camera_imu import normal
from share.lab.calibrate.camera_imu.normal import Sigmas
from share.lab.calibrate.camera_imu.sights import Sights, seen
from share.lab.calibrate.camera_imu.solve import Arrow, arrow, border_steps, gathered, solve
from share.lab.calibrate.camera_imu.start import NODE_S
from share.lab.calibrate.camera_imu.state import SHARED, State
from share.lab.calibrate.corners import LEAST_SPREAD, spread
from share.types import F64, I64, ImuBatch

_BIAS_SIGMA = np.repeat([0.2, 1.0], 3)  # rad/s, m/s^2: no IMU is worse
_LEAST_WALK = 1e-7
_STEPS = 30
_STILL = 1e-7  # relative fall of the cost at which it has arrived
_SLOW_NS = 200_000_000  # means over so long show errors that are not noise


@dataclass(frozen=True, eq=False)
class Batch:
    """One problem: corners, the IMU while they were seen, and its stated noise."""

    sights: Sights
    imu: ImuBatch
    noise: ImuNoise

    def stated(self) -> Sigmas:
        """A sample's noise, by the density that the IMU's file has and the rate that the samples have."""
        root = float(np.sqrt(1e9 / np.median(np.diff(self.imu.stamps_ns))))
        return Sigmas(LEAST_SPREAD, self.noise.gyro_density * root, self.noise.accel_density * root)

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
        one = normal.normal(state, self.sights, self.imu, sigmas)
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
        px = spread(np.concatenate(self.corners(state)))
        gyro, accel = (rough(self.imu.stamps_ns, part) for part in self.inertial(state))
        return Sigmas(px, max(gyro, stated.gyro), max(accel, stated.accel))

    def corners(self, state: State) -> tuple[F64, ...]:
        """Of each camera (C, 2) px, seen less predicted."""
        T = normal.poses(state, self.sights.stamps_ns)
        return tuple(seen(self.sights, eye, T)[0] for eye in range(len(self.sights.cameras)))

    def inertial(self, state: State) -> tuple[F64, F64]:
        """gyro, accel (N, 3), measured less predicted."""
        left = normal.inertial(state, self.imu)[0]
        return left[:, :3], left[:, 3:]

    def covariance(self, state: State, sigmas: Sigmas) -> F64:
        """(7, 7) of the mounting and the shift, if intrinsics and T_cam1_cam0 are exact."""
        return _solved(self._at(state, sigmas)[0], 0.0)[2][:7, :7]

    def by_rig(self, state: State, sigmas: Sigmas) -> F64:
        """(7, P): where mounting and shift go if the rig's own parameters, in the order of
        `bundle.Solution`, are moved by one each."""
        falls = normal.rig_sensitivity(state, self.sights, sigmas)
        return -border_steps(self._at(state, sigmas)[0], *gathered(falls, state))[:7]


def _solved(system: Arrow, damping: float) -> tuple[F64, F64, F64]:
    try:
        return solve(system, damping)
    except np.linalg.LinAlgError:
        raise DataError(
            "camera and IMU: the recording does not tell the motion; move and turn more"
        ) from None


def slow(stamps_ns: I64, residuals: F64) -> float:
    """Of residuals (N, 3) the rms of means over 0.2 s, times the root of how many are in each: the same as
    their own rms where they are white, and more where scale, axes or the board are not as taken to be."""
    place = (stamps_ns - stamps_ns[0]) // _SLOW_NS
    count = np.maximum(np.bincount(place), 1)
    sums = np.stack([np.bincount(place, column) for column in residuals.T])
    return float(np.sqrt((sums**2 / count).mean()))


def rough(stamps_ns: I64, residuals: F64) -> float:
    """The larger of their rms and of `slow`: what one sample is to be believed."""
    return max(float(np.sqrt((residuals**2).mean())), slow(stamps_ns, residuals))
