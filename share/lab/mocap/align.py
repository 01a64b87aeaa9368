"""Align a device's IMU with a motion capture in an unknown clock: time offset, fit, and ground truth.

First the time offset by correlation, over any range and only if it is unique; then the batch fit from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from share.errors import CalibrationMismatchError
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.mocap.fit import MocapFit, fit_mocap
from share.lab.mocap.initialisation import nearest_axis_rotation, tilt_from_up
from share.lab.mocap.offset import OffsetPeak, find_offset
from share.lab.mocap.path import FittedPath
from share.lab.mocap.state import MocapFitOptions
from share.lab.mocap.trajectory import MocapTrajectory, check_imu
from share.lab.mocap.verdict import check_fit, fit_warnings
from share.types import F64, I64, ImuBatch

MIN_LEAD = 10.0  # log likelihood ratio; unrelated recordings reach 0.4, 10 s of related ones 15
_MAX_OFFSET_CHANGE_NS = 4_000_000  # correlation alone is right to 0.5 ms for people, 2.3 ms for robots
_TRUTH_STEP_NS = 10_000_000  # linear interpolation between errs by 0.1 mm at 8 m/s^2


@dataclass(frozen=True, eq=False)
class AlignedDevice:
    """A device and its motion capture. peak: the offset found by correlation. mocap: in its own clock.
    fit: of the IMU and the mocap shifted by the peak's offset."""

    imu: ImuBatch
    mocap: MocapTrajectory
    peak: OffsetPeak
    fit: MocapFit

    @property
    def offset_ns(self) -> int:
        """IMU's clock minus mocap's, in the middle of the fit."""
        return self.peak.offset_ns + self.fit.offset_ns

    @cached_property
    def stamps_ns(self) -> I64:
        """(N,), IMU clock: stamps of the truth, none in a gap."""
        first, last = int(self.fit.stamps_ns[0]), int(self.fit.stamps_ns[-1])
        stamps = np.arange(first, last + 1, _TRUTH_STEP_NS)
        for start, end in self.fit.gaps:  # a gap at an end of the path has one side only
            before, after = (stamps <= start) & (start > first), (stamps >= end) & (end < last)
            stamps = stamps[before | after]
        return stamps

    @property
    def seconds(self) -> float:
        """Duration of the truth without gaps."""
        return len(self.stamps_ns) * _TRUTH_STEP_NS * 1e-9

    @property
    def warnings(self) -> list[str]:
        """Warnings about the fit, a line each."""
        offset_change, out = self.fit.offset_ns, fit_warnings(self.fit)
        if abs(offset_change) > _MAX_OFFSET_CHANGE_NS:
            out.append(
                f"the fit's time offset differs by {offset_change * 1e-6:+.1f} ms from that by rotation "
                "alone, and may be wrong by as much; are the motion capture's poses raw, neither smoothed "
                "nor estimated?"
            )
        return out

    def truth(self, R_mocap_world: F64) -> F64:
        """Return T_world_body (N, 4, 4) at `stamps_ns`, in the world that R_mocap_world (3, 3) levels."""
        R = R_mocap_world.T @ self.fit.R_mocap_world
        T_world_fit = se3.from_rt(R, np.zeros(3))
        return T_world_fit @ FittedPath(self.fit, self.imu).pose_and_velocity(self.stamps_ns)[0]


def align_device(
    imu: ImuBatch, noise: ImuNoise, mocap: MocapTrajectory, options: MocapFitOptions
) -> AlignedDevice:
    """Align one device. Raises as `fit_mocap`, and CalibrationMismatchError where more than one offset is
    plausible."""
    check_imu(imu)  # before the search: across a clock step it would cover years, in steps of 10 ms
    peak = find_offset(imu, mocap, options.within_s)
    if peak.lead < MIN_LEAD:
        raise CalibrationMismatchError(
            "the time offset of motion capture and IMU is not unique: two offsets explain the rotation "
            f"nearly equally well (correlations {peak.correlation:.3f} and {peak.next_correlation:.3f}, lead "
            f"{peak.lead:.1f}, {MIN_LEAD:.0f} needed); is the body this device's? Record longer, turn "
            "irregularly, or limit the offset of the clocks"
        )
    shifted = mocap.shifted(peak.offset_ns)
    result = fit_mocap(imu, noise, shifted, replace(options, within_s=0.0))
    check_fit(result)
    return AlignedDevice(imu, mocap, peak, result)


def common_level(fits: Sequence[MocapFit]) -> F64:
    """Return R_mocap_world (3, 3) of all: the mean of their tilts, weighted by each fit's information."""
    ups = np.array([fit.R_mocap_world[:, 2] for fit in fits])
    up_rotation = nearest_axis_rotation(ups.sum(0))
    tilts = np.array([tilt_from_up(up_rotation @ up) for up in ups])
    information = np.array([np.linalg.inv(fit.cov_shared[:2, :2]) for fit in fits])
    tilt = np.linalg.solve(information.sum(0), np.einsum("nij,nj->i", information, tilts))
    return np.asarray(up_rotation.T @ se3.so3_exp(np.append(tilt, 0.0)), np.float64)
