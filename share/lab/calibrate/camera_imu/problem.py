"""Least squares over a whole recording by Levenberg-Marquardt, its residuals and covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.errors import CalibrationMismatchError, DataError
from share.geometry.camera import ImuNoise
from share.lab.calibrate.camera_imu import normal_equations
from share.lab.calibrate.camera_imu.arrow_solver import (
    ArrowSystem,
    arrow_system,
    border_steps,
    gather_gradient,
    solve_arrow,
)
from share.lab.calibrate.camera_imu.corner_observations import CornerObservations, corner_residuals
from share.lab.calibrate.camera_imu.initialisation import BIAS_NODE_S
from share.lab.calibrate.camera_imu.normal_equations import Sigmas
from share.lab.calibrate.camera_imu.state import SHARED, CameraImuState
from share.lab.calibrate.corners import MIN_SIGMA_PX, robust_sigma
from share.types import F64, I64, ImuBatch

_BIAS_SIGMA = np.repeat([0.2, 1.0], 3)  # rad/s, m/s^2: larger than any IMU's
_MIN_WALK = 1e-7
_MAX_ITERATIONS = 30
_MIN_RELATIVE_DECREASE = 1e-7  # of the cost: converged below
_SLOW_WINDOW_NS = 200_000_000  # means over this show errors that are not white


@dataclass(frozen=True, eq=False)
class CameraImuProblem:
    """Corners, the IMU samples meanwhile, and the IMU's stated noise."""

    observations: CornerObservations
    imu: ImuBatch
    noise: ImuNoise

    def stated_sigmas(self) -> Sigmas:
        """Return the sigmas of samples by the stated noise density and the sample rate."""
        root = float(np.sqrt(1e9 / np.median(np.diff(self.imu.stamps_ns))))
        return Sigmas(MIN_SIGMA_PX, self.noise.gyro_density * root, self.noise.accel_density * root)

    def optimise(self, state: CameraImuState, sigmas: Sigmas) -> CameraImuState:
        """Minimise the cost. Raises CalibrationMismatchError where it does not converge."""
        damping, (system, cost) = 1e-5, self._linear_system(state, sigmas)
        if not np.isfinite(cost):
            raise CalibrationMismatchError(
                "camera and IMU: the board would lie behind a camera; is --target the board shown?"
            )
        for _ in range(_MAX_ITERATIONS):
            knots, border, _ = _solve_or_raise(system, damping)
            trial = state.updated(knots, border)
            trial_system, trial_cost = self._linear_system(trial, sigmas)
            if not trial_cost < cost:
                if damping > 1e6 or trial_cost - cost < _MIN_RELATIVE_DECREASE * cost:
                    return state
                damping *= 10
                continue
            has_converged = cost - trial_cost < _MIN_RELATIVE_DECREASE * cost
            state, system, cost, damping = trial, trial_system, trial_cost, max(damping / 10, 1e-12)
            if has_converged:
                return state
        raise CalibrationMismatchError(
            f"camera and IMU: no solution after {_MAX_ITERATIONS} steps; "
            "are --target, --camera and --imu of this rig?"
        )

    def _linear_system(self, state: CameraImuState, sigmas: Sigmas) -> tuple[ArrowSystem, float]:
        segments = normal_equations.segment_normals(state, self.observations, self.imu, sigmas)
        system = arrow_system(segments, state)
        return system, segments.cost + self._add_bias_factors(state, system)

    def _add_bias_factors(self, state: CameraImuState, system: ArrowSystem) -> float:
        """Add the biases' factors, a weak prior on the first node and random walks between nodes; return
        their cost."""
        walk = np.repeat([self.noise.gyro_walk, self.noise.accel_walk], 3)
        weight = 1 / (np.maximum(walk, _MIN_WALK) ** 2 * BIAS_NODE_S)
        g = system.g_border[SHARED:].reshape(-1, 6)  # a view
        steps = np.diff(state.biases, axis=0)
        diagonal = np.zeros_like(state.biases)
        diagonal[0] += _BIAS_SIGMA**-2
        diagonal[1:] += weight
        diagonal[:-1] += weight
        columns = np.arange(SHARED, SHARED + state.biases.size)
        system.corner[columns, columns] += diagonal.reshape(-1)
        cross = np.tile(weight, len(steps))
        system.corner[columns[:-6], columns[6:]] -= cross
        system.corner[columns[6:], columns[:-6]] -= cross
        g[1:] -= weight * steps
        g[:-1] += weight * steps
        g[0] -= state.biases[0] / _BIAS_SIGMA**2
        return float(((state.biases[0] / _BIAS_SIGMA) ** 2).sum() + (weight * steps**2).sum()) / 2

    def residual_sigmas(self, state: CameraImuState, stated: Sigmas) -> Sigmas:
        """Return sigmas estimated from residuals; of the IMU at least the stated ones."""
        px = robust_sigma(np.concatenate(self.corner_residuals(state)))
        gyro, accel = (conservative_rms(self.imu.stamps_ns, part) for part in self.inertial_residuals(state))
        return Sigmas(px, max(gyro, stated.gyro), max(accel, stated.accel))

    def corner_residuals(self, state: CameraImuState) -> tuple[F64, ...]:
        """Return residuals (C, 2) px of each camera, measured minus predicted."""
        T = normal_equations.camera_poses(state, self.observations.stamps_ns)
        return tuple(
            corner_residuals(self.observations, cam, T)[0] for cam in range(len(self.observations.cameras))
        )

    def inertial_residuals(self, state: CameraImuState) -> tuple[F64, F64]:
        """Return residuals of gyro, accel (N, 3), measured minus predicted."""
        residuals = normal_equations.inertial_residuals(state, self.imu)[0]
        return residuals[:, :3], residuals[:, 3:]

    def covariance(self, state: CameraImuState, sigmas: Sigmas) -> F64:
        """Return the covariance (7, 7) of extrinsics and time shift for exact intrinsics and T_cam1_cam0."""
        return _solve_or_raise(self._linear_system(state, sigmas)[0], 0.0)[2][:7, :7]

    def rig_sensitivity(self, state: CameraImuState, sigmas: Sigmas) -> F64:
        """Return (7, P): derivatives of extrinsics and time shift by the rig's parameters, in the order of
        `CameraBundleSolution`."""
        gradients = normal_equations.rig_gradients(state, self.observations, sigmas)
        return -border_steps(self._linear_system(state, sigmas)[0], *gather_gradient(gradients, state))[:7]


def _solve_or_raise(system: ArrowSystem, damping: float) -> tuple[F64, F64, F64]:
    try:
        return solve_arrow(system, damping)
    except np.linalg.LinAlgError:
        raise DataError(
            "camera and IMU: the recording does not determine the motion; move and turn more"
        ) from None


def low_frequency_rms(stamps_ns: I64, residuals: F64) -> float:
    """Return the rms of means over 0.2 s of residuals (N, 3), times the root of the number in each.

    Equal to their rms if they are white; larger where scale, axes or the board are not as assumed.
    """
    window = (stamps_ns - stamps_ns[0]) // _SLOW_WINDOW_NS
    count = np.maximum(np.bincount(window), 1)
    sums = np.stack([np.bincount(window, column) for column in residuals.T])
    return float(np.sqrt((sums**2 / count).mean()))


def conservative_rms(stamps_ns: I64, residuals: F64) -> float:
    """Return the larger of the rms and of `low_frequency_rms`."""
    return max(float(np.sqrt((residuals**2).mean())), low_frequency_rms(stamps_ns, residuals))
