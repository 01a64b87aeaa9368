"""Camera and IMU on one curve: where the cameras sit on the IMU, and how far their clocks are apart.

Method: Furgale, Rehder, Siegwart, *Unified temporal and spatial calibration for multi-sensor systems* (IROS
2013), with splines as in spline.py. Levenberg-Marquardt; the spread that corners are weighed by is found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from share.errors import DataError
from share.geometry.camera import ImuNoise, Rig
from share.lab.calibrate.camera_bundle import View
from share.lab.calibrate.camera_imu.batch import Batch
from share.lab.calibrate.camera_imu.normal import Sigmas, covers
from share.lab.calibrate.camera_imu.sights import Sights, sights
from share.lab.calibrate.camera_imu.start import (
    EDGE_S,
    Alignment,
    align,
    first_poses,
    first_state,
    refined_poses,
)
from share.lab.calibrate.camera_imu.state import SHIFT, State
from share.lab.calibrate.target import Target
from share.types import F64, I64, ImuBatch

_HOLE_NS = 100_000_000  # longer without an IMU sample, and the curve goes its own way
_FIRST_PX = 1.0
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Fit:
    """What was found. Of T_imu_cam0 Exp(xi) and the shift two covariances (7, 7): by_noise of corners and
    IMU; by_rig of what intrinsics and T_cam1_cam0 may be off, None where nobody told that. sigmas: what
    residuals were judged by; stated: as the IMU's file has them. of each camera corners (C, 2) px and their
    frames (C,); gyro, accel (N, 3): residuals. stamps_ns: of pictures, camera's clock; imu: samples used."""

    state: State
    by_noise: F64
    by_rig: F64 | None
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
    def covariance(self) -> F64:
        """(7, 7): both together. Other pictures told the rig, so they are independent."""
        return self.by_noise if self.by_rig is None else self.by_noise + self.by_rig

    @property
    def sigma_rotation(self) -> F64:
        """(3,) rad, about the IMU's axes."""
        return self.sigmas_of(self.covariance)[:3]

    @property
    def sigma_position(self) -> F64:
        """(3,) m, of cam0 along the IMU's axes."""
        return self.sigmas_of(self.covariance)[3:6]

    @property
    def sigma_shift(self) -> float:
        return float(self.sigmas_of(self.covariance)[SHIFT])

    def sigmas_of(self, covariance: F64) -> F64:
        """(7,) rad, m, s, along the IMU's axes, of one of the covariances (7, 7)."""
        turn = np.eye(7)
        turn[:3, :3] = turn[3:6, 3:6] = self.T_imu_cam0[:3, :3]
        return np.sqrt(np.diag(turn @ covariance @ turn.T))


def fit(
    stamps_ns: I64,
    views: Sequence[View],
    target: Target,
    rig: Rig,
    imu: ImuBatch,
    noise: ImuNoise,
    within_s: float = 0.5,
    told: Callable[[int, int], None] = lambda done, total: None,
    rig_covariance: F64 | None = None,
) -> Fit:
    """From views at stamps (F,) rising and the IMU of one recording; intrinsics and T_cam1_cam0 are `rig`'s,
    with a covariance (P, P) in the order of `bundle.Solution` where it is known. told: rounds done, of how
    many.

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
    batch = Batch(corners.take(inside), _during(imu, state), noise)
    stated = batch.stated()
    sigmas = replace(stated, px=_FIRST_PX)
    for done in range(_ROUNDS):
        told(done, _ROUNDS)
        state = batch.descend(state, sigmas)
        sigmas = batch.spread(state, stated)
    told(_ROUNDS, _ROUNDS)
    gyro, accel = batch.inertial(state)
    by_noise, by_rig = batch.covariance(state, sigmas), None
    if rig_covariance is not None:
        follows = batch.by_rig(state, sigmas)
        by_rig = follows @ rig_covariance @ follows.T
    return Fit(
        state, by_noise, by_rig, sigmas, stated, batch.sights, batch.imu, batch.corners(state), gyro, accel,
        found,
    )  # fmt: skip


def _during(imu: ImuBatch, state: State) -> ImuBatch:
    """Samples on the curve. Raises DataError for a hole among them."""
    used = imu.take(covers(state.curve, imu.stamps_ns, 0.0, 0.0))
    longest = int(np.diff(used.stamps_ns).max(initial=0))
    if longest > _HOLE_NS:
        raise DataError(f"IMU: nothing for {longest * 1e-9:.2f} s while the board was seen; record it again")
    return used
