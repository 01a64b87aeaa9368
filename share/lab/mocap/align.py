"""A device's IMU and a motion capture that know nothing of each other's clock: offset, fit, and the truth.

First the offset, wherever it is, and only if no other would do nearly as well; then the batch fit from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from share.errors import MisfitError
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.mocap.fit import Fit, fit
from share.lab.mocap.mocap import Mocap, check_imu
from share.lab.mocap.offset import Peak, find_offset
from share.lab.mocap.path import FittedPath
from share.lab.mocap.start import standing, tilt_of
from share.lab.mocap.state import FitOptions
from share.lab.mocap.verdict import check_fit, doubts
from share.types import F64, I64, ImuBatch

LEAST_LEAD = 10.0  # e^10 to one; recordings that do not belong together come to 0.4, 10 s that do to 15
_MOST_MOVED_NS = 4_000_000  # turning alone is right to 0.5 ms for people, 2.3 ms for robots
_STEP_NS = 10_000_000  # of the truth: straight lines between are off by 0.1 mm at 8 m/s^2


@dataclass(frozen=True, eq=False)
class Aligned:
    """A device and what a motion capture saw of it. peak: the offset as it was found; mocap: by its own
    clock; fit: of the IMU and the mocap moved by the peak's offset."""

    imu: ImuBatch
    mocap: Mocap
    peak: Peak
    fit: Fit

    @property
    def offset_ns(self) -> int:
        """IMU's clock minus mocap's, in the middle of the fit."""
        return self.peak.offset_ns + self.fit.offset_ns

    @cached_property
    def stamps_ns(self) -> I64:
        """(N,), IMU clock: where somebody vouches for the path. None in a gap."""
        first, last = int(self.fit.stamps_ns[0]), int(self.fit.stamps_ns[-1])
        stamps = np.arange(first, last + 1, _STEP_NS)
        for start, end in self.fit.gaps:  # at an end of the path nobody saw the gap's far side
            before, after = (stamps <= start) & (start > first), (stamps >= end) & (end < last)
            stamps = stamps[before | after]
        return stamps

    @property
    def seconds(self) -> float:
        """For how long the path is vouched for."""
        return len(self.stamps_ns) * _STEP_NS * 1e-9

    @property
    def doubts(self) -> list[str]:
        """What is not as it should be, each in a line."""
        moved, out = self.fit.offset_ns, doubts(self.fit)
        if abs(moved) > _MOST_MOVED_NS:
            out.append(
                f"the fit puts the clocks {moved * 1e-6:+.1f} ms from where the turning alone does, and may "
                "be wrong by that; are the motion capture's poses raw, neither smoothed nor an estimate?"
            )
        return out

    def truth(self, R_mocap_world: F64) -> F64:
        """T_world_body (N, 4, 4) at `stamps_ns`, in the world that R_mocap_world (3, 3) levels."""
        R = R_mocap_world.T @ self.fit.R_mocap_world
        T_world_fit = se3.compose(R, np.zeros(3))
        return T_world_fit @ FittedPath(self.fit, self.imu).moving(self.stamps_ns)[0]


def align(imu: ImuBatch, noise: ImuNoise, mocap: Mocap, options: FitOptions) -> Aligned:
    """Raises DataError as `fit` does, MisfitError also where more than one offset would do."""
    check_imu(imu)  # before the search: where a clock was set that would go through years, in steps of 10 ms
    peak = find_offset(imu, mocap, options.within_s)
    if peak.lead < LEAST_LEAD:
        raise MisfitError(
            "which time of the motion capture is which of the IMU is not clear: two offsets explain the "
            f"turning nearly alike (correlations {peak.correlation:.3f} and {peak.rival:.3f}, lead "
            f"{peak.lead:.1f}, needed {LEAST_LEAD:.0f}); is that this device's "
            "body? Record longer, turn irregularly, or say how near the clocks are"
        )
    moved = mocap.shifted(peak.offset_ns)
    found = fit(imu, noise, moved, replace(options, within_s=0.0))
    check_fit(found)
    return Aligned(imu, mocap, peak, found)


def level(fits: Sequence[Fit]) -> F64:
    """R_mocap_world (3, 3) of all: their tilts' mean, each by the information that its fit has of it."""
    ups = np.array([fit.R_mocap_world[:, 2] for fit in fits])
    turn = standing(ups.sum(0))
    tilts = np.array([tilt_of(turn @ up) for up in ups])
    known = np.array([np.linalg.inv(fit.cov_shared[:2, :2]) for fit in fits])
    tilt = np.linalg.solve(known.sum(0), np.einsum("nij,nj->i", known, tilts))
    return np.asarray(turn.T @ se3.so3_exp(np.append(tilt, 0.0)), np.float64)
