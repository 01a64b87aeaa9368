"""The fit of a simulated motion capture with known mounting, tilt, delay and gaps."""

import numpy as np
import pytest
from helpers.mocap_sim import BODY, NOISE, START_NS, TILT, G, Motion, record_imu, record_mocap, stamps

from share.errors import CalibrationMismatchError, DataError
from share.geometry import se3
from share.lab.mocap.fit import MocapFit, fit_mocap
from share.lab.mocap.state import MocapFitOptions
from share.lab.mocap.trajectory import MocapTrajectory
from share.types import F64, ImuBatch

DELAY = 12_345_678  # ns
GAPS = ((8.0, 8.4), (12.0, 14.0))
WHITE = MocapFitOptions(sigma_rotation=np.radians(0.2), independent_hz=100.0, imu_inflation=1.0)


@pytest.fixture(scope="module")
def found() -> MocapFit:
    motion = Motion()
    mocap = record_mocap(motion, 30, DELAY, gaps=GAPS)
    return fit_mocap(record_imu(motion, 30), NOISE, mocap, WHITE)


def shared_error(fit: MocapFit, delay_ns: int = DELAY) -> F64:
    """Return the errors (9,): tilt, mounting (rotation, position), offset s."""
    body = se3.log(se3.inverse(fit.T_body_mocap) @ BODY)
    tilt = TILT - se3.so3_log(fit.R_mocap_world)[:2]
    return np.concatenate([tilt, body, [(delay_ns - fit.offset_ns) * 1e-9]])


def pose_error(fit: MocapFit, motion: Motion) -> F64:
    """Return the errors (N, 6) of the nodes, perturbed on the right."""
    truth = motion.pose((fit.stamps_ns - START_NS) * 1e-9)
    return se3.log(se3.inverse(fit.T_world_body) @ truth)


@pytest.mark.long
def test_tilt_mounting_and_delay_are_recovered(found: MocapFit) -> None:
    error = np.abs(shared_error(found))
    assert np.degrees(error[:5]).max() < 0.05
    assert error[5:8].max() < 1e-3
    assert error[8] < 0.2e-3


@pytest.mark.long
def test_the_path_is_better_than_the_mocap(found: MocapFit) -> None:
    error = pose_error(found, Motion())
    assert np.sqrt((error[:, 3:] ** 2).sum(1).mean()) < 1e-3  # the mocap's is 3.5 mm
    assert np.degrees(np.sqrt((error[:, :3] ** 2).sum(1).mean())) < 0.05
    assert found.residuals.position_mm == pytest.approx(2 * np.sqrt(3), rel=0.05)
    assert found.residuals.rotation_deg == pytest.approx(0.2 * np.sqrt(3), rel=0.05)


@pytest.mark.long
def test_velocities_and_tilt_are_recovered(found: MocapFit) -> None:
    t = (found.stamps_ns - START_NS) * 1e-9
    velocity = (Motion().pose(t + 1e-4) - Motion().pose(t - 1e-4))[:, :3, 3] / 2e-4
    assert np.abs(found.velocity - velocity).max() < 0.01
    assert found.tilt_deg == pytest.approx(np.degrees(np.linalg.norm(TILT)), abs=0.05)


@pytest.mark.long
def test_a_short_gap_is_bridged_and_a_long_one_is_reported(found: MocapFit) -> None:
    np.testing.assert_allclose((found.gaps - START_NS) * 1e-9, [(12.0, 14.0)], atol=0.02)
    inside = (found.stamps_ns > START_NS + 12_000_000_000) & (found.stamps_ns < START_NS + 14_000_000_000)
    sigma = np.sqrt(found.cov_poses[:, 3, 3])
    assert sigma[inside].max() > 1.5 * np.median(sigma[~inside])
    assert np.abs(pose_error(found, Motion())[inside, 3:]).max() < 0.01


@pytest.mark.long
def test_a_mocap_with_y_up_an_unrelated_clock_and_outliers() -> None:
    motion = Motion(3)
    flip = se3.exp(np.array([np.pi / 2, 0, 0, 0, 0, 0]))
    mocap = record_mocap(motion, 30, 5_000_000_000_000 + DELAY)
    T = flip @ mocap.T
    wrong = np.arange(37, len(T), 41)
    T[wrong] = T[wrong] @ se3.exp(np.array([0, 0, 2.0, 0.5, 0, 0]))
    found = fit_mocap(
        record_imu(motion, 30),
        NOISE,
        MocapTrajectory(mocap.stamps_ns, T),
        MocapFitOptions(within_s=None, imu_inflation=1.0),
    )
    error = shared_error(found, 5_000_000_000_000 + DELAY)
    assert np.degrees(np.abs(error[2:5])).max() < 0.05
    assert np.abs(error[5:8]).max() < 2e-3
    assert np.abs(error[8]) < 0.2e-3
    assert found.residuals.outlier_share == pytest.approx(len(wrong) / len(T), abs=0.002)
    assert found.up == "-y" and found.tilt_deg == pytest.approx(np.degrees(np.linalg.norm(TILT)), abs=0.02)


@pytest.mark.long
def test_clock_drift_is_estimated() -> None:
    motion = Motion(8)
    mocap = record_mocap(motion, 40, DELAY, drift=60e-6)
    found = fit_mocap(record_imu(motion, 40), NOISE, mocap, WHITE)
    assert found.drift_ppm == pytest.approx(60, abs=10)
    assert abs(shared_error(found)[8]) < 0.2e-3


@pytest.mark.long
def test_a_broken_chain_continues_in_the_same_frame() -> None:
    motion = Motion(4)
    mocap = record_mocap(
        motion, 45, DELAY, gaps=((13.0, 24.0), (24.5, 35.0))
    )  # half a second is too short to fit
    found = fit_mocap(record_imu(motion, 45), NOISE, mocap, WHITE)
    assert found.is_break.sum() == 1
    assert np.abs(shared_error(found))[5:8].max() < 1e-3
    assert np.abs(pose_error(found, motion)[:, 3:]).max() < 0.006


def test_a_body_that_only_yaws_needs_a_given_mounting() -> None:
    motion = Motion(5, planar=True)
    imu, mocap = record_imu(motion, 15), record_mocap(motion, 15)
    with pytest.raises(DataError, match="one axis"):
        fit_mocap(imu, NOISE, mocap)
    guess = BODY @ se3.exp(np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.01]))
    found = fit_mocap(imu, NOISE, mocap, MocapFitOptions(T_body_mocap=guess, guess_sigma=(0.03, 0.02)))
    error = se3.log(se3.inverse(found.T_body_mocap) @ BODY)
    lever = BODY[:3, :3] @ error[3:]  # yaw determines the horizontal part; the height stays the given one
    assert np.abs(lever[:2]).max() < 3e-3
    height = np.sqrt((BODY[:3, :3] @ found.cov_shared[5:8, 5:8] @ BODY[:3, :3].T)[2, 2])
    assert height > 0.01


def test_without_noise_the_fit_is_exact() -> None:
    """The remaining error is that of midpoint integration."""
    motion = Motion(6)
    mocap = record_mocap(motion, 12, DELAY, sigma=(0.0, 0.0))
    found = fit_mocap(record_imu(motion, 12, None), NOISE, mocap, MocapFitOptions(imu_inflation=1.0))
    error = np.abs(shared_error(found))
    assert np.degrees(error[:5]).max() < 2e-3
    assert error[5:8].max() < 2e-4
    assert error[8] < 5e-6


@pytest.mark.slow
def test_nees_is_consistent() -> None:
    shared, poses = [], []
    for seed in range(12):
        motion = Motion(seed)
        found = fit_mocap(
            record_imu(motion, 30, NOISE, seed), NOISE, record_mocap(motion, 30, DELAY, seed=seed), WHITE
        )
        error, path = shared_error(found), pose_error(found, motion)
        error = np.append(error, -found.drift_ppm * 1e-6)
        shared.append(error @ np.linalg.solve(found.cov_shared, error))
        poses.append(np.einsum("ni,nij,nj->n", path, np.linalg.inv(found.cov_poses), path).mean())
    assert (
        10 * 0.6 < np.mean(shared) < 10 * 1.4
    )  # 95 % band of the mean of 12: 7.6 .. 12.7, widened for Cauchy
    assert 6 * 0.6 < np.mean(poses) < 6 * 1.4


def still(seconds: float) -> ImuBatch:
    t = stamps(seconds, 200)
    return ImuBatch(t, np.zeros((len(t), 3)), np.tile((0.0, 0.0, G), (len(t), 1)))


def bad(name: str) -> tuple[ImuBatch, MocapTrajectory]:
    motion = Motion()
    imu, mocap = record_imu(motion, 8), record_mocap(motion, 8)
    t = imu.stamps_ns.copy()
    if name == "order":
        t[[50, 51]] = t[[51, 50]]
        return ImuBatch(t, imu.gyro, imu.accel), mocap
    if name == "gap":
        keep = (t < t[400]) | (t > t[480])
        return ImuBatch(t[keep], imu.gyro[keep], imu.accel[keep]), mocap
    if name == "short":
        return ImuBatch(t[:300], imu.gyro[:300], imu.accel[:300]), mocap
    if name == "apart":
        return ImuBatch(t + 3_600_000_000_000, imu.gyro, imu.accel), mocap
    if name == "millimetres":
        T = mocap.T.copy()
        T[:, :3, 3] *= 1000
        return imu, MocapTrajectory(mocap.stamps_ns, T)
    if name == "other body":
        return record_imu(Motion(77), 8), mocap
    return still(8), mocap


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("order", "IMU: stamp .* is not later"),
        ("gap", "IMU: no samples from"),
        ("short", "overlap by 1.* s"),
        ("apart", "match at no time offset .*clocks"),
        ("millimetres", "one (motion|body)"),
        ("other body", "match at no time offset"),
        ("still", "match at no time offset"),
    ],
)
def test_bad_input_is_refused(name: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        fit_mocap(*_swap(bad(name)))


def _swap(pair: tuple[ImuBatch, MocapTrajectory]) -> tuple[ImuBatch, object, MocapTrajectory]:
    return pair[0], NOISE, pair[1]


def test_invalid_poses_are_refused() -> None:
    T = np.tile(np.eye(4), (5, 1, 1))
    t = np.arange(5) * 10_000_000
    lost = T.copy()
    lost[2, 0, 3] = np.nan
    with pytest.raises(DataError, match="not finite"):
        MocapTrajectory(t, lost)
    with pytest.raises(DataError, match="pose 2 of 5"):
        MocapTrajectory(t, T * np.array([1, 0, 1, 1, 1])[:, None, None])
    with pytest.raises(DataError, match="not later"):
        MocapTrajectory(t[::-1].copy(), T)
    with pytest.raises(DataError, match="0 poses"):
        MocapTrajectory(t[:0], T[:0])
    assert issubclass(CalibrationMismatchError, DataError)
