"""Alignment of device and motion capture: unique offsets, gaps in the truth, a common level world; simulated
motions in closed form."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from helpers.mocap_sim import BODY, NOISE, START_NS, TILT, Motion, record_imu, record_mocap

from share.errors import CalibrationMismatchError, DataError
from share.files.yaml_file import read_yaml
from share.geometry import se3
from share.lab.calibrate.imu_table import read_imu
from share.lab.mocap.align import MIN_LEAD, align_device, common_level
from share.lab.mocap.files import read_mocap
from share.lab.mocap.offset import find_offset
from share.lab.mocap.state import MocapFitOptions
from share.lab.mocap.trajectory import MocapTrajectory
from share.recordings.calibration import imu_noise
from share.types import F64

AWAY_NS = 1_599_999_000_000_000_000 + 123_456  # the mocap's clock begins at about 1000 s
ANYWHERE = MocapFitOptions(within_s=None)


@dataclass(frozen=True, eq=False)
class Pacing(Motion):
    """Periodic motion of exactly 2 s."""

    def pose(self, t: F64) -> F64:
        w = np.pi * t
        turn = np.stack([0.5 * np.sin(w), 0.4 * np.sin(w + 1), 0.9 * np.sin(w + 2)], axis=1)
        return se3.from_rt(se3.so3_exp(turn), 0.3 * turn)


@pytest.fixture(scope="module")
def done():
    """20 s, with mocap gaps of 0.3 s and 1.5 s."""
    motion, hidden = Motion(3), ((6.0, 6.3), (12.0, 13.5))
    mocap = record_mocap(motion, 20, AWAY_NS, gaps=hidden, drift=3e-5)
    return motion, align_device(record_imu(motion, 20), NOISE, mocap, ANYWHERE)


def test_the_offset_of_unrelated_clocks_is_found_within_0_3_ms(done) -> None:
    _, found = done
    assert abs(found.offset_ns - AWAY_NS) < 0.3e6
    assert found.peak.correlation > 0.95 and found.peak.lead > 2 * MIN_LEAD


def test_the_truth_is_the_path_of_the_body_in_the_level_world(done) -> None:
    motion, found = done
    T = found.truth(found.fit.R_mocap_world)
    true = motion.pose((found.stamps_ns - START_NS) * 1e-9)
    error = se3.log(se3.inverse(true) @ T)
    assert np.sqrt((error[:, 3:] ** 2).sum(1).mean()) < 0.003
    assert np.degrees(np.sqrt((error[:, :3] ** 2).sum(1).mean())) < 0.1


def test_a_long_gap_has_no_truth_and_a_short_one_is_bridged(done) -> None:
    _, found = done
    t = (found.stamps_ns - START_NS) * 1e-9
    holes = np.flatnonzero(np.diff(t) > 0.011)
    assert len(holes) == 1
    assert t[holes[0]] == pytest.approx(12.0, abs=0.03) and t[holes[0] + 1] == pytest.approx(13.5, abs=0.03)
    assert found.seconds == pytest.approx(20 - 0.6 - 1.5, abs=0.1)


@pytest.mark.slow
@pytest.mark.long
def test_there_is_no_truth_in_a_gap_that_breaks_the_path() -> None:
    """12 s: too long to integrate the IMU across."""
    motion = Motion(3)
    found = align_device(
        record_imu(motion, 40), NOISE, record_mocap(motion, 40, AWAY_NS, gaps=((14, 26),)), ANYWHERE
    )
    t = (found.stamps_ns - START_NS) * 1e-9
    assert not ((t > 14.05) & (t < 25.95)).any() and found.seconds == pytest.approx(40 - 0.6 - 12, abs=0.3)
    off = found.truth(found.fit.R_mocap_world)[:, :3, 3] - motion.pose(t)[:, :3, 3]
    assert np.linalg.norm(off, axis=1).max() < 0.008


@pytest.mark.parametrize(
    ("turn", "up"), [((-np.pi / 2, 0, 0), "y"), ((0, 0.5 * np.pi, 0), "x"), ((np.pi, 0, 0), "-z")]
)
def test_the_motion_captures_z_need_not_be_up(turn: tuple[float, ...], up: str) -> None:
    motion = Motion(3)
    mocap = record_mocap(motion, 12, AWAY_NS)
    lying = mocap.rotated(se3.so3_exp(np.array(turn)))
    found = align_device(record_imu(motion, 12), NOISE, lying, ANYWHERE)
    assert found.fit.up == up
    assert found.fit.tilt_deg == pytest.approx(np.degrees(np.linalg.norm(TILT)), abs=0.05)
    height = found.truth(common_level([found.fit]))[:, 2, 3]
    true = motion.pose((found.stamps_ns - START_NS) * 1e-9)[:, 2, 3]
    assert np.abs(height - true).max() < 0.01


@pytest.mark.long
def test_a_periodic_motion_is_refused() -> None:
    imu, mocap = record_imu(Pacing(), 40), record_mocap(Pacing(), 40, AWAY_NS)
    part = mocap.between(int(mocap.stamps_ns[0]) + 12 * 10**9, int(mocap.stamps_ns[0]) + 24 * 10**9)
    with pytest.raises(CalibrationMismatchError, match="is not unique"):
        align_device(imu, NOISE, part, ANYWHERE)
    near = part.shifted(AWAY_NS)  # unique within half a period
    assert abs(align_device(imu, NOISE, near, replace(ANYWHERE, within_s=0.4)).offset_ns) < 1e6


YEARS_NS = 56 * 365 * 86_400 * 10**9


def test_a_clock_that_was_set_is_refused_before_the_search() -> None:
    """A device whose clock jumps by decades half way."""
    imu, mocap = record_imu(Motion(3), 12), record_mocap(Motion(3), 12, AWAY_NS)
    stamps = imu.stamps_ns + np.where(np.arange(len(imu)) < 1200, -YEARS_NS // 2, YEARS_NS // 2)
    with pytest.raises(DataError, match=r"IMU: no samples from 5\.995 to 1766016006"):
        align_device(replace(imu, stamps_ns=stamps), NOISE, mocap, ANYWHERE)


def test_a_stray_stamp_of_the_motion_capture_is_refused() -> None:
    mocap = record_mocap(Motion(3), 12)
    stamps = mocap.stamps_ns.copy()
    stamps[0] = 0
    with pytest.raises(DataError, match=r"stamps jump by 1600000000 s at sample 2, from 0 to .*; cut there"):
        MocapTrajectory(stamps, mocap.T)
    hours = np.arange(5 * 3600 * 10, dtype=np.int64) * 100_000_000  # five at 10 Hz
    rarely = np.concatenate([hours[:400], hours[-400:]])  # visible at the start and at the end
    MocapTrajectory(rarely, np.tile(np.eye(4), (len(rarely), 1, 1)))


def test_another_motion_is_refused() -> None:
    with pytest.raises(DataError):
        align_device(record_imu(Motion(3), 20), NOISE, record_mocap(Motion(4), 20, AWAY_NS), ANYWHERE)


def test_a_longer_recording_has_a_larger_lead() -> None:
    leads = []
    for seconds in (8, 16, 32):
        imu, mocap = record_imu(Motion(3), seconds), record_mocap(Motion(3), seconds, AWAY_NS)
        leads.append(find_offset(imu, mocap, None).lead)
    assert leads[0] < leads[1] < leads[2]


def test_a_robot_that_only_yaws_is_fitted_with_a_known_mounting() -> None:
    motion = Motion(5, planar=True)
    imu, mocap = record_imu(motion, 20), record_mocap(motion, 20, AWAY_NS)
    with pytest.raises(DataError, match="about one axis only"):
        align_device(imu, NOISE, mocap, ANYWHERE)
    known = replace(ANYWHERE, T_body_mocap=BODY, guess_sigma=(np.radians(0.1), 0.002))
    found = align_device(imu, NOISE, mocap, known)
    assert abs(found.offset_ns - AWAY_NS) < 0.5e6
    off = found.truth(found.fit.R_mocap_world)[:, :3, 3]
    off = off - motion.pose((found.stamps_ns - START_NS) * 1e-9)[:, :3, 3]
    assert np.sqrt((off**2).sum(1).mean()) < 0.005


def test_the_common_level_is_the_mean_weighted_by_information(done) -> None:
    """Two fits of equal covariance count the same; one without information does not count."""
    _, found = done

    def tilted(x: float, y: float, sigma: float):
        cov = found.fit.cov_shared.copy()
        cov[:2, :2] = sigma**2 * np.eye(2)
        return replace(found.fit, R_mocap_world=se3.so3_exp(np.array([x, y, 0.0])), cov_shared=cov)

    a, b, c = tilted(0.010, 0.002, 1e-3), tilted(0.014, -0.002, 1e-3), tilted(0.5, 0.5, 1e3)
    np.testing.assert_allclose(se3.so3_log(common_level([a, b, c])), [0.012, 0.0, 0.0], atol=1e-6)
    down = se3.so3_exp(np.array([np.pi, 0, 0]))  # turned over, the two lie on both sides of half a turn
    over = [replace(fit, R_mocap_world=down @ fit.R_mocap_world) for fit in (a, b, c)]
    np.testing.assert_allclose(common_level(over)[:, 2], down @ common_level([a, b, c])[:, 2], atol=1e-9)
    assert np.linalg.norm(se3.so3_log(common_level([found.fit]))[:2] - TILT) < np.radians(0.05)


def test_positions_that_lag_behind_rotations_give_a_warning(done) -> None:
    """Positions 20 ms later than rotations, as after a filter."""
    mocap = record_mocap(Motion(3), 14, AWAY_NS)
    assert done[1].warnings == []
    t = mocap.stamps_ns[100:-100]
    T = mocap.interpolate(t - 20_000_000)
    T[:, :3, :3] = mocap.interpolate(t)[:, :3, :3]
    found = align_device(record_imu(Motion(3), 14), NOISE, MocapTrajectory(t, T), ANYWHERE)
    assert any("be wrong by as much" in doubt for doubt in found.warnings)


@pytest.mark.slow
def test_three_recordings_of_one_device_agree_on_its_clock(shared_data) -> None:
    """TUM-VI's clocks are nearly one; shifted by 44 years, the offset is found."""
    tumvi, offsets = shared_data / "motion" / "tumvi", []
    noise = imu_noise(read_yaml(tumvi / "calib" / "kalibr_imu_chain.yaml").section("imu0"), "update_rate")
    for room in ("room1", "room2", "room3"):
        mocap = read_mocap(tumvi / room / "groundtruth.csv").shifted(-1_403_636_000_123_456_789)
        options = replace(ANYWHERE, sigma_position=0.0005)
        found = align_device(read_imu(str(tumvi / room / "imu0.csv")).imu, noise, mocap, options)
        assert found.peak.lead > 100 and found.warnings == []
        offsets.append((found.offset_ns - 1_403_636_000_123_456_789) * 1e-6)
    assert max(np.abs(offsets)) < 1.0 and max(offsets) - min(offsets) < 0.4
