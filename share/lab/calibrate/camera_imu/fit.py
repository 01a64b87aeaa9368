"""Extrinsics and time offset of camera and IMU, by a batch fit of a continuous-time trajectory.

Method: Furgale, Rehder, Siegwart, *Unified temporal and spatial calibration for multi-sensor systems* (IROS
2013), with the splines of spline.py. The sigmas of corners and IMU are estimated from residuals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from share.errors import DataError
from share.geometry.camera import ImuNoise, Rig
from share.lab.calibrate.camera_imu.initialisation import (
    END_MARGIN_S,
    ClockAlignment,
    align_clocks,
    initial_poses,
    initial_state,
    refine_poses,
)
from share.lab.calibrate.camera_imu.normal_equations import Sigmas, on_curve_mask
from share.lab.calibrate.camera_imu.problem import CameraImuProblem
from share.lab.calibrate.camera_imu.state import SHIFT, CameraImuState
from share.lab.calibrate.corner_observations import BoardView, CornerObservations, corner_observations
from share.lab.calibrate.target import Target
from share.types import F64, I64, ImuBatch

_MAX_IMU_GAP_NS = 100_000_000  # in a longer gap the curve is not determined
_INITIAL_SIGMA_PX = 1.0
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class CameraImuFit:
    """Result of a fit.

    Two covariances (7, 7) of xi in T_imu_cam0 Exp(xi) and the time shift: `by_noise` of corners and IMU;
    `by_rig` of the uncertainty of intrinsics and T_cam1_cam0, None where that is unknown. `sigmas`: as
    estimated; `stated_sigmas`: by the IMU's file. `stamps_ns` (F,): of the frames, camera's clock.
    `corners`: residuals (C, 2) px of each camera; `gyro`, `accel` (N, 3): residuals. `imu`: the samples used.
    """

    state: CameraImuState
    by_noise: F64
    by_rig: F64 | None
    sigmas: Sigmas
    stated_sigmas: Sigmas
    stamps_ns: I64
    observations: CornerObservations
    imu: ImuBatch
    corners: tuple[F64, ...]
    gyro: F64
    accel: F64
    initial_alignment: ClockAlignment

    @property
    def T_imu_cam0(self) -> F64:
        return self.state.T_imu_cam0

    @property
    def shift_s(self) -> float:
        return self.state.shift_s

    @property
    def covariance(self) -> F64:
        """(7, 7): the sum of both. The rig was calibrated from other images, so they are independent."""
        return self.by_noise if self.by_rig is None else self.by_noise + self.by_rig

    @property
    def sigma_rotation(self) -> F64:
        """(3,) rad, about the IMU's axes."""
        return self.axis_sigmas(self.covariance)[:3]

    @property
    def sigma_position(self) -> F64:
        """(3,) m, of cam0 along the IMU's axes."""
        return self.axis_sigmas(self.covariance)[3:6]

    @property
    def sigma_shift(self) -> float:
        return float(self.axis_sigmas(self.covariance)[SHIFT])

    def axis_sigmas(self, covariance: F64) -> F64:
        """Return sigmas (7,) along the IMU's axes, rad, m, s, of a covariance (7, 7)."""
        turn = np.eye(7)
        turn[:3, :3] = turn[3:6, 3:6] = self.T_imu_cam0[:3, :3]
        return np.sqrt(np.diag(turn @ covariance @ turn.T))


def fit_camera_imu(
    stamps_ns: I64,
    views: Sequence[BoardView],
    target: Target,
    rig: Rig,
    imu: ImuBatch,
    noise: ImuNoise,
    within_s: float = 0.5,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    rig_covariance: F64 | None = None,
) -> CameraImuFit:
    """Fit views at stamps (F,), rising, and the IMU of one recording. Intrinsics and T_cam1_cam0 of `rig` are
    fixed.

    within_s: largest offset of the clocks. rig_covariance (P, P): of `rig`, in the order of
    `CameraBundleSolution`, if known. on_progress(done, total): rounds.

    Raises DataError where something is missing or not observable, CalibrationMismatchError where camera and
    IMU do not have one motion.
    """
    cameras = tuple(c for c in (rig.cam0, rig.cam1) if c is not None)[
        : len(views[0].detections) if views else 0
    ]
    mounts = [np.eye(4), np.eye(4) if rig.T_cam1_cam0 is None else rig.T_cam1_cam0]
    T, has_enough = initial_poses(views, target, cameras, mounts)
    observations = corner_observations(views, target, cameras, rig.T_cam1_cam0).take(has_enough)
    stamps_ns, T = stamps_ns[has_enough], refine_poses(observations, T[has_enough])
    alignment = align_clocks(stamps_ns, T, imu, within_s)
    state = initial_state(stamps_ns, T, imu, alignment)
    is_on_curve = on_curve_mask(state.curve, stamps_ns, state.shift_s, END_MARGIN_S)
    batch = CameraImuProblem(
        stamps_ns[is_on_curve], observations.take(is_on_curve), _samples_on_curve(imu, state), noise
    )
    stated = batch.stated_sigmas()
    sigmas = replace(stated, px=_INITIAL_SIGMA_PX)
    for done in range(_ROUNDS):
        on_progress(done, _ROUNDS)
        state = batch.optimise(state, sigmas)
        sigmas = batch.residual_sigmas(state, stated)
    on_progress(_ROUNDS, _ROUNDS)
    gyro, accel = batch.inertial_residuals(state)
    by_noise, by_rig = batch.covariance(state, sigmas), None
    if rig_covariance is not None:
        sensitivity = batch.rig_sensitivity(state, sigmas)
        by_rig = sensitivity @ rig_covariance @ sensitivity.T
    return CameraImuFit(
        state, by_noise, by_rig, sigmas, stated, batch.stamps_ns, batch.observations, batch.imu,
        batch.corner_residuals(state), gyro, accel, alignment,
    )  # fmt: skip


def _samples_on_curve(imu: ImuBatch, state: CameraImuState) -> ImuBatch:
    """Return the samples on the curve. Raises DataError for a gap among them."""
    used = imu.take(on_curve_mask(state.curve, imu.stamps_ns, 0.0, 0.0))
    longest = int(np.diff(used.stamps_ns).max(initial=0))
    if longest > _MAX_IMU_GAP_NS:
        raise DataError(f"IMU: no samples for {longest * 1e-9:.2f} s while the board was seen; record again")
    return used
