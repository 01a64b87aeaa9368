"""Fits that converge to a wrong solution: swapped markers, mirrored worlds, wrong scales, larger noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from helpers.mocap_sim import BODY, NOISE, START_NS, Motion, record_imu, record_mocap
from numpy.typing import ArrayLike

from share.errors import CalibrationMismatchError
from share.geometry import se3
from share.lab.mocap.align import AlignedDevice, align_device
from share.lab.mocap.state import MocapFitOptions
from share.lab.mocap.trajectory import MocapTrajectory
from share.lab.mocap.verdict import shared_sigmas
from share.types import F64

SECONDS, NEAR = 16.0, MocapFitOptions(within_s=1.0)
SWAP = se3.exp(np.array([0.6, -1.0, 0.8, 0.04, 0.03, -0.05]))


def swapped(mocap: MocapTrajectory, start: float, end: float) -> MocapTrajectory:
    """Return poses with swapped markers from `start` to `end` s."""
    t = (mocap.stamps_ns - START_NS) * 1e-9
    T = mocap.T.copy()
    T[(t >= start) & (t < end)] @= SWAP
    return MocapTrajectory(mocap.stamps_ns, T)


def mirrored(mocap: MocapTrajectory, axis: int, rotations: bool) -> MocapTrajectory:
    """Return poses with a mirrored axis, as after a wrong export."""
    flip, T = np.diag(1.0 - 2.0 * (np.arange(3) == axis)), mocap.T.copy()
    T[:, :3, 3] = T[:, :3, 3] @ flip
    if rotations:
        T[:, :3, :3] = flip @ T[:, :3, :3] @ flip
    return MocapTrajectory(mocap.stamps_ns, T)


def scaled(mocap: MocapTrajectory, by: ArrayLike) -> MocapTrajectory:
    T = mocap.T.copy()
    T[:, :3, 3] *= by
    return MocapTrajectory(mocap.stamps_ns, T)


def found_in(mocap: MocapTrajectory, options: MocapFitOptions = NEAR) -> AlignedDevice:
    return align_device(record_imu(Motion(3), SECONDS), NOISE, mocap, options)


@pytest.mark.slow
@pytest.mark.parametrize("span", [(11.5, 40.0), (0.0, 4.5), (6.0, 10.0)])
def test_swapped_markers_are_outliers_and_give_no_truth(span) -> None:
    found = found_in(swapped(record_mocap(Motion(3), SECONDS), *span))
    error = se3.log(se3.inverse(BODY) @ found.fit.T_body_mocap)
    assert (np.abs(error) < 4 * shared_sigmas(found.fit)[2:8]).all()
    t = (found.stamps_ns - START_NS) * 1e-9
    assert not ((t > span[0] + 0.05) & (t < span[1] - 0.05)).any()
    off = found.truth(found.fit.R_mocap_world)[:, :3, 3] - Motion(3).pose(t)[:, :3, 3]
    assert np.linalg.norm(off, axis=1).max() < 0.012
    assert any("poses are outliers and not used" in text for text in found.warnings)


def test_markers_swapped_for_long_are_refused() -> None:
    with pytest.raises(
        CalibrationMismatchError, match=r"4[0-9] % of the mocap's poses are outliers; were markers"
    ):
        found_in(swapped(record_mocap(Motion(3), SECONDS), 5.0, 12.0))


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("rotations", [False, True])
def test_a_mirrored_world_is_refused(axis: int, rotations: bool) -> None:
    with pytest.raises(CalibrationMismatchError):
        found_in(mirrored(record_mocap(Motion(3), SECONDS), axis, rotations))


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.8, 1.2])
def test_a_wrong_scale_is_refused(scale: float) -> None:
    with pytest.raises(CalibrationMismatchError, match="mocap and IMU"):
        found_in(scaled(record_mocap(Motion(3), SECONDS), scale))


def test_a_small_scale_error_gives_a_warning() -> None:
    coarse = replace(NEAR, sigma_position=0.004)
    warnings = found_in(scaled(record_mocap(Motion(3), SECONDS), 1.035), coarse).warnings
    assert any("longer than the accelerometer's; calibrate" in text for text in warnings)


@dataclass(frozen=True, eq=False)
class Level(Motion):
    """Almost no vertical motion."""

    def pose(self, t: F64) -> F64:
        T = super().pose(t)
        T[:, 2, 3] *= 0.05
        return T


@pytest.mark.slow
def test_a_mirrored_axis_with_little_motion_is_refused() -> None:
    """The fit converges, with errors of centimetres."""
    coarse = replace(NEAR, sigma_position=0.01)
    imu, mocap = record_imu(Level(3), SECONDS), record_mocap(Level(3), SECONDS)
    align_device(imu, NOISE, mocap, coarse)
    with pytest.raises(
        CalibrationMismatchError, match=r"along its z .* moves opposite .* is an axis mirrored"
    ):
        align_device(imu, NOISE, mirrored(mocap, 2, rotations=False), coarse)


def test_the_scale_of_each_axis_is_found_within_its_sigma() -> None:
    """In a world with another axis up: the axes are the file's."""
    mocap = record_mocap(Motion(3), SECONDS).rotated(se3.so3_exp(np.array([-np.pi / 2, 0, 0])))
    fit = found_in(scaled(mocap, (1.03, 0.98, 1.0))).fit
    assert fit.scale_error_sigma.max() < 0.005
    np.testing.assert_array_less(np.abs(fit.scale_error - (0.03, -0.02, 0.0)), 4 * fit.scale_error_sigma)


@pytest.mark.slow
def test_noise_above_the_stated_gives_a_hint() -> None:
    mocap = record_mocap(Motion(3), SECONDS, sigma=(0.008, np.radians(0.2)))
    with pytest.raises(
        CalibrationMismatchError, match=r"1[34]\.[0-9] mm rms residual, 3\.[0-9]+ times .* --sigma-mm"
    ):
        found_in(mocap)
    found = found_in(mocap, replace(NEAR, sigma_position=0.004))
    assert any("times the stated noise" in text for text in found.warnings)
    found = found_in(mocap, replace(NEAR, sigma_position=0.008))
    assert found.fit.residuals.position_sigmas == pytest.approx(1.0, abs=0.05)
    assert not any("stated noise" in text for text in found.warnings)


def test_a_thousand_poses_a_second_are_thinned() -> None:
    mocap = record_mocap(Motion(3), 10, hz=1000)
    found = found_in(mocap)
    assert 2000 < found.fit.residuals.samples < 2500
    assert abs(found.offset_ns) < 0.5e6
    usual = record_mocap(Motion(3), 10, hz=240)
    assert usual.thinned(4_000_000) is usual


def test_a_wrong_given_mounting_is_refused() -> None:
    """Wrong by five degrees, or seven centimetres, along axes that yaw determines."""
    motion = Motion(5, planar=True)
    imu, mocap = record_imu(motion, SECONDS), record_mocap(motion, SECONDS)
    known = replace(NEAR, guess_sigma=(np.radians(0.2), 0.004))
    assert align_device(imu, NOISE, mocap, replace(known, T_body_mocap=BODY)).fit.mounting_prior_sigmas < 2
    for wrong in ((0.0, 0.09, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.05, 0.05)):
        with pytest.raises(CalibrationMismatchError, match=r"the given mounting \(--mounting\)"):
            align_device(imu, NOISE, mocap, replace(known, T_body_mocap=BODY @ se3.exp(np.array(wrong))))
