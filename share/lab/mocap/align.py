"""A device's IMU and a motion capture that know nothing of each other's clock: offset, fit, and the truth.

First the offset, wherever it is, and only if no other would do nearly as well; then the batch fit from there.
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

MIN_LEAD = 10.0  # e^10 to one; recordings that do not belong together come to 0.4, 10 s that do to 15
_MAX_OFFSET_CHANGE_NS = 4_000_000  # turning alone is right to 0.5 ms for people, 2.3 ms for robots
_TRUTH_STEP_NS = 10_000_000  # of the truth: straight lines between are off by 0.1 mm at 8 m/s^2


@dataclass(frozen=True, eq=False)
class AlignedDevice:
    """A device and what a motion capture saw of it. peak: the offset as it was found; mocap: by its own
    clock; fit: of the IMU and the mocap moved by the peak's offset."""

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
        """(N,), IMU clock: where somebody vouches for the path. None in a gap."""
        first, last = int(self.fit.stamps_ns[0]), int(self.fit.stamps_ns[-1])
        stamps = np.arange(first, last + 1, _TRUTH_STEP_NS)
        for start, end in self.fit.gaps:  # at an end of the path nobody saw the gap's far side
            before, after = (stamps <= start) & (start > first), (stamps >= end) & (end < last)
            stamps = stamps[before | after]
        return stamps

    @property
    def seconds(self) -> float:
        """For how long the path is vouched for."""
        return len(self.stamps_ns) * _TRUTH_STEP_NS * 1e-9

    @property
    def warnings(self) -> list[str]:
        """What is not as it should be, each in a line."""
        offset_change, out = self.fit.offset_ns, fit_warnings(self.fit)
        if abs(offset_change) > _MAX_OFFSET_CHANGE_NS:
            out.append(
                f"the fit puts the clocks "
                f"{offset_change * 1e-6:+.1f} "
                f"ms from where the turning alone does, and may "
                "be wrong by that; are the motion capture's poses raw, neither smoothed nor an estimate?"
            )
        return out

    def truth(self, R_mocap_world: F64) -> F64:
        """T_world_body (N, 4, 4) at `stamps_ns`, in the world that R_mocap_world (3, 3) levels."""
        R = R_mocap_world.T @ self.fit.R_mocap_world
        T_world_fit = se3.from_rt(R, np.zeros(3))
        return T_world_fit @ FittedPath(self.fit, self.imu).pose_and_velocity(self.stamps_ns)[0]


def align_device(
    imu: ImuBatch, noise: ImuNoise, mocap: MocapTrajectory, options: MocapFitOptions
) -> AlignedDevice:
    """Raises DataError as `fit_mocap` does, MisfitError also where more than one offset would do."""
    check_imu(imu)  # before the search: where a clock was set that would go through years, in steps of 10 ms
    peak = find_offset(imu, mocap, options.within_s)
    if peak.lead < MIN_LEAD:
        raise CalibrationMismatchError(
            "which time of the motion capture is which of the IMU is not clear: two offsets explain the "
            f"turning nearly alike (correlations "
            f"{peak.correlation:.3f} "
            f"and {peak.next_correlation:.3f}, lead "
            f"{peak.lead:.1f}, needed {MIN_LEAD:.0f}); is that this device's "
            "body? Record longer, turn irregularly, or say how near the clocks are"
        )
    shifted = mocap.shifted(peak.offset_ns)
    result = fit_mocap(imu, noise, shifted, replace(options, within_s=0.0))
    check_fit(result)
    return AlignedDevice(imu, mocap, peak, result)


def common_level(fits: Sequence[MocapFit]) -> F64:
    """R_mocap_world (3, 3) of all: their tilts' mean, each by the information that its fit has of it."""
    ups = np.array([fit.R_mocap_world[:, 2] for fit in fits])
    up_rotation = nearest_axis_rotation(ups.sum(0))
    tilts = np.array([tilt_from_up(up_rotation @ up) for up in ups])
    information = np.array([np.linalg.inv(fit.cov_shared[:2, :2]) for fit in fits])
    tilt = np.linalg.solve(information.sum(0), np.einsum("nij,nj->i", information, tilts))
    return np.asarray(up_rotation.T @ se3.so3_exp(np.append(tilt, 0.0)), np.float64)
