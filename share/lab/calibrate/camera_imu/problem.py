"""Least squares over a whole recording, its residuals and covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from share.errors import CalibrationMismatchError, DataError
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.calibrate.camera_imu import normal_equations
from share.lab.calibrate.camera_imu.initialisation import BIAS_NODE_S
from share.lab.calibrate.camera_imu.normal_equations import Sigmas
from share.lab.calibrate.camera_imu.state import SHARED, CameraImuState
from share.lab.calibrate.corner_observations import CornerObservations
from share.lab.calibrate.corners import MIN_SIGMA_PX, robust_sigma
from share.lab.least_squares import ArrowFactor, ArrowSystem, minimise
from share.types import F64, I64, ImuBatch

BIAS_SIGMA = np.repeat([0.2, 1.0], 3)  # rad/s, m/s^2: larger than any IMU's; holds unobservable biases only
_MIN_WALK = 1e-7
_MAX_STEPS = 30
_CONVERGED = 1e-7  # relative decrease of the cost
_SLOW_WINDOW_NS = 200_000_000  # means over this show errors that are not white


@dataclass(frozen=True, eq=False)
class CameraImuProblem:
    """Corners in frames at stamps_ns (F,), camera's clock, the IMU samples meanwhile, and the IMU's stated
    noise."""

    stamps_ns: I64
    observations: CornerObservations
    imu: ImuBatch
    noise: ImuNoise

    def stated_sigmas(self) -> Sigmas:
        """Return the sigmas of samples by the stated noise density and the sample rate."""
        root = float(np.sqrt(1e9 / np.median(np.diff(self.imu.stamps_ns))))
        return Sigmas(MIN_SIGMA_PX, self.noise.gyro_density * root, self.noise.accel_density * root)

    def optimise(self, state: CameraImuState, sigmas: Sigmas) -> CameraImuState:
        """Minimise the cost. Raises CalibrationMismatchError where it does not converge, DataError where the
        recording does not determine the motion."""
        try:
            minimum = minimise(
                state, partial(self._linear_system, sigmas=sigmas), _updated_state, _MAX_STEPS, _CONVERGED
            )
        except np.linalg.LinAlgError:
            raise _undetermined() from None
        except ValueError:
            raise CalibrationMismatchError(
                "camera and IMU: the board would lie behind a camera; is --target the board shown?"
            ) from None
        if not minimum.converged:
            raise CalibrationMismatchError(
                f"camera and IMU: no solution after {_MAX_STEPS} steps; "
                "are --target, --camera and --imu of this rig?"
            )
        return minimum.state

    def _linear_system(self, state: CameraImuState, sigmas: Sigmas) -> tuple[ArrowSystem, float]:
        segments = normal_equations.segment_normals(
            state, self.stamps_ns, self.observations, self.imu, sigmas
        )
        system = normal_equations.arrow_system(segments, state)
        return system, segments.cost + self._add_bias_factors(state, system)

    def _add_bias_factors(self, state: CameraImuState, system: ArrowSystem) -> float:
        """Add the biases' factors, a weak prior on the first node and random walks between nodes; return
        their cost."""
        walk = np.repeat([self.noise.gyro_walk, self.noise.accel_walk], 3)
        weight = 1 / (np.maximum(walk, _MIN_WALK) ** 2 * BIAS_NODE_S)
        g = system.g_border[SHARED:].reshape(-1, 6)  # a view
        steps = np.diff(state.biases, axis=0)
        diagonal = np.zeros_like(state.biases)
        diagonal[0] += BIAS_SIGMA**-2
        diagonal[1:] += weight
        diagonal[:-1] += weight
        columns = np.arange(SHARED, SHARED + state.biases.size)
        system.corner[columns, columns] += diagonal.reshape(-1)
        cross = np.tile(weight, len(steps))
        system.corner[columns[:-6], columns[6:]] -= cross
        system.corner[columns[6:], columns[:-6]] -= cross
        g[1:] -= weight * steps
        g[:-1] += weight * steps
        g[0] -= state.biases[0] / BIAS_SIGMA**2
        return float(((state.biases[0] / BIAS_SIGMA) ** 2).sum() + (weight * steps**2).sum()) / 2

    def residual_sigmas(self, state: CameraImuState, stated: Sigmas) -> Sigmas:
        """Return sigmas estimated from residuals; of the IMU at least the stated ones."""
        px = robust_sigma(np.concatenate(self.corner_residuals(state)))
        gyro, accel = (conservative_rms(self.imu.stamps_ns, part) for part in self.inertial_residuals(state))
        return Sigmas(px, max(gyro, stated.gyro), max(accel, stated.accel))

    def corner_residuals(self, state: CameraImuState) -> tuple[F64, ...]:
        """Return residuals (C, 2) px of each camera, measured minus predicted."""
        T_target_cam0 = normal_equations.camera_poses(state, self.stamps_ns)
        return self.observations.residuals(se3.inverse(T_target_cam0))

    def inertial_residuals(self, state: CameraImuState) -> tuple[F64, F64]:
        """Return residuals of gyro, accel (N, 3), measured minus predicted."""
        residuals = normal_equations.inertial_residuals(state, self.imu)[0]
        return residuals[:, :3], residuals[:, 3:]

    def covariance(self, state: CameraImuState, sigmas: Sigmas) -> F64:
        """Return the covariance (7, 7) of extrinsics and time shift for exact intrinsics and T_cam1_cam0."""
        return self._factor(state, sigmas).border_covariance[:7, :7]

    def rig_sensitivity(self, state: CameraImuState, sigmas: Sigmas) -> F64:
        """Return (7, P): derivatives of extrinsics and time shift by the rig's parameters, in the order of
        `CameraBundleSolution`."""
        gradients = normal_equations.rig_gradients(state, self.stamps_ns, self.observations, sigmas)
        knots_and_border = normal_equations.gather_gradient(gradients, state)
        return -self._factor(state, sigmas).solve(*knots_and_border)[1][:7]

    def _factor(self, state: CameraImuState, sigmas: Sigmas) -> ArrowFactor:
        try:
            return ArrowFactor(self._linear_system(state, sigmas)[0])
        except np.linalg.LinAlgError:
            raise _undetermined() from None


def _updated_state(state: CameraImuState, system: ArrowSystem, damping: float) -> CameraImuState:
    return state.updated(*system.solve(damping))


def _undetermined() -> DataError:
    return DataError("camera and IMU: the recording does not determine the motion; move and turn more")


def conservative_rms(stamps_ns: I64, residuals: F64) -> float:
    """Return the larger of the rms of residuals (N, 3) and of the rms of their means over 0.2 s, times the
    root of the number in each.

    Both are equal if the residuals are white; the second is larger where scale, axes or the board are not as
    assumed.
    """
    window = (stamps_ns - stamps_ns[0]) // _SLOW_WINDOW_NS
    count = np.maximum(np.bincount(window), 1)
    sums = np.stack([np.bincount(window, column) for column in residuals.T])
    return float(np.sqrt(max((residuals**2).mean(), (sums**2 / count).mean())))
