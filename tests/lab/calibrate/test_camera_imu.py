"""Camera-IMU calibration on a simulated motion in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.camera_imu_sim import (
    GRAVITY,
    NOISE,
    SHIFT_S,
    START_NS,
    T_IMU_CAM0,
    TARGET,
    Dance,
    Recorded,
    record,
)

from share.errors import CalibrationMismatchError, DataError
from share.geometry import se3
from share.lab.calibrate.camera_imu import normal_equations
from share.lab.calibrate.camera_imu.fit import CameraImuFit, fit_camera_imu
from share.lab.calibrate.camera_imu.initialisation import align_clocks
from share.lab.calibrate.camera_imu.problem import CameraImuProblem
from share.lab.calibrate.camera_imu.spline import EXTRA_KNOTS, ORDER, Curve
from share.lab.calibrate.camera_imu.state import KNOTS, LOCAL_COLUMNS, SHARED, CameraImuState, node_count
from share.lab.calibrate.camera_imu.verdict import compare_mountings, judge_camera_imu
from share.lab.calibrate.camera_initialisation import camera_from_parameters, intrinsics
from share.lab.calibrate.corner_observations import corner_observations
from share.lab.least_squares import ArrowFactor
from share.types import F64

SIGMAS = normal_equations.Sigmas(0.1, 3e-3, 2e-2, huber=1e6)


def calibrated(run: Recorded, rig_covariance: F64 | None = None) -> CameraImuFit:
    return fit_camera_imu(
        run.stamps_ns, run.views, TARGET, run.rig, run.imu, NOISE, rig_covariance=rig_covariance
    )  # fmt: skip


def error(found: CameraImuFit) -> F64:
    """(7,): xi rad, m, and s."""
    xi = se3.log(se3.inverse(found.T_imu_cam0) @ T_IMU_CAM0)
    return np.append(xi, SHIFT_S - found.shift_s)


@pytest.fixture(scope="module")
def dance() -> Recorded:
    return record(Dance(1), 12.0, hz=6.0)


@pytest.fixture(scope="module")
def found(dance: Recorded) -> CameraImuFit:
    return calibrated(dance)


@pytest.fixture
def state(rng: np.random.Generator) -> CameraImuState:
    """A state near the truth, with a knot every 100 ms and a bias node every 0.7 s."""
    at = (np.arange(15 + EXTRA_KNOTS) - 2) * 0.1
    T = Dance(3).body(at) @ se3.exp(rng.normal(0, 0.02, (len(at), 6)))
    curve = Curve(START_NS, 0.1, T[:, :3, :3], T[:, :3, 3])
    biases = rng.normal(0, 0.1, (node_count(15, 7), 6))
    return CameraImuState(curve, biases, 7, T_IMU_CAM0 @ se3.exp(rng.normal(0, 0.02, 6)), 0.01, GRAVITY + 0.1)


def _columns(state: CameraImuState, segment: int, local: F64) -> tuple[F64, F64]:
    """Return a step of one segment's local columns as steps of the knots and of the border."""
    knots, border = np.zeros((len(state.curve.p), 6)), np.zeros(SHARED + state.biases.size)
    knots[segment : segment + ORDER] = local[:KNOTS].reshape(ORDER, 6)
    border[:SHARED] = local[KNOTS : KNOTS + SHARED]
    first = SHARED + 6 * (segment // state.per_node)
    border[first : first + 12] = local[KNOTS + SHARED :]
    return knots, border


def test_derivatives_of_imu_residuals_equal_finite_differences(state: CameraImuState) -> None:
    run = record(Dance(3), 1.5)
    one = run.imu.take(np.array([143]))
    _, J, segment = normal_equations.inertial_residuals(state, one)
    for column in range(LOCAL_COLUMNS):
        step = np.eye(LOCAL_COLUMNS)[column] * 1e-6
        low, high = (
            normal_equations.inertial_residuals(
                state.updated(*_columns(state, int(segment[0]), s * step)), one
            )[0]
            for s in (-1, 1)
        )
        np.testing.assert_allclose(J[0, :, column], (low - high)[0] / 2e-6, rtol=1e-4, atol=1e-4)


def test_derivatives_of_poses_equal_finite_differences(state: CameraImuState) -> None:
    stamps = np.array([START_NS + 831_000_000])
    T, J, segment = normal_equations.pose_derivatives(state, stamps)
    for column in range(LOCAL_COLUMNS):
        step = np.eye(LOCAL_COLUMNS)[column] * 1e-6
        low, high = (
            normal_equations.camera_poses(state.updated(*_columns(state, int(segment[0]), s * step)), stamps)
            for s in (-1, 1)
        )
        by_column = se3.log(low @ se3.inverse(high))[0] / 2e-6
        np.testing.assert_allclose(J[0, :, column], by_column, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(T, se3.inverse(normal_equations.camera_poses(state, stamps)))


def test_the_gradient_is_that_of_the_cost(state: CameraImuState) -> None:
    """By differences of the cost in three random directions."""
    run = record(Dance(3), 1.5, wrong=0.1)
    observations = corner_observations(run.views, TARGET, (run.rig.cam0, run.rig.cam1), run.rig.T_cam1_cam0)
    sigmas = replace(SIGMAS, huber=30.0)
    system = normal_equations.arrow_system(
        normal_equations.segment_normals(state, run.stamps_ns, observations, run.imu, sigmas), state
    )
    rng = np.random.default_rng(5)
    for _ in range(3):
        knots, border = rng.normal(size=(len(state.curve.p), 6)), rng.normal(size=system.g_border.shape)
        low, high = (
            normal_equations.segment_normals(
                state.updated(s * knots, s * border), run.stamps_ns, observations, run.imu, sigmas
            ).cost
            for s in (-1e-6, 1e-6)
        )
        down = (system.g_nodes * knots).sum() + system.g_border @ border
        assert (low - high) / 2e-6 == pytest.approx(down, rel=1e-4)


def test_the_arrow_system_has_the_solution_of_the_dense_one(state: CameraImuState) -> None:
    run = record(Dance(3), 1.5)
    observations = corner_observations(run.views, TARGET, (run.rig.cam0, run.rig.cam1), run.rig.T_cam1_cam0)
    one = normal_equations.segment_normals(state, run.stamps_ns, observations, run.imu, SIGMAS)
    size = 6 * len(state.curve.p)
    H, g = np.zeros((size + SHARED + state.biases.size,) * 2), np.zeros(size + SHARED + state.biases.size)
    for k in range(state.curve.segments):
        first = size + SHARED + 6 * (k // state.per_node)
        own = np.concatenate([6 * k + np.arange(KNOTS), size + np.arange(SHARED), first + np.arange(12)])
        H[np.ix_(own, own)] += one.H[k]
        g[own] += one.g[k]
    system = normal_equations.arrow_system(one, state)
    prior = 1e3 * np.eye(SHARED + state.biases.size)
    factor = ArrowFactor(replace(system, corner=system.corner + prior))
    knots, border = factor.solve(system.g_nodes, system.g_border)
    H[size:, size:] += prior
    np.testing.assert_allclose(np.append(knots, border), np.linalg.solve(H, g), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        factor.border_covariance, np.linalg.inv(H)[size:, size:], rtol=1e-5, atol=1e-12
    )


def test_without_noise_the_estimate_is_exact() -> None:
    found = calibrated(record(Dance(2), 6.0, noise_px=0.0, hz=12.0, imu=None))
    off = error(found)
    assert np.degrees(np.linalg.norm(off[:3])) < 1e-3
    assert np.linalg.norm(off[3:6]) < 5e-5
    assert abs(off[6]) < 5e-6
    np.testing.assert_allclose(found.state.gravity, GRAVITY, atol=5e-3)


@pytest.mark.long
def test_with_noise_the_error_is_within_its_covariance_and_the_verdict_passes(found: CameraImuFit) -> None:
    off = error(found)
    assert np.degrees(np.linalg.norm(off[:3])) < 0.1
    assert np.linalg.norm(off[3:6]) < 2e-3
    assert abs(off[6]) < 2e-4
    assert off @ np.linalg.solve(found.covariance, off) < 24.3  # chi-square of 7: 0.1 %
    assert found.sigmas.px == pytest.approx(0.1, rel=0.03)
    verdict = judge_camera_imu(found)
    assert verdict.passed, verdict.reasons
    assert verdict.gyro_noise_ratio == pytest.approx(
        1, abs=0.15
    ) and verdict.accel_noise_ratio == pytest.approx(1, abs=0.15)


@pytest.mark.long
def test_outlier_corners_hardly_change_the_estimate(found: CameraImuFit) -> None:
    spoiled = calibrated(record(Dance(1), 12.0, hz=6.0, wrong=0.03))
    off = error(spoiled)
    assert np.degrees(np.linalg.norm(off[:3])) < 0.1 and np.linalg.norm(off[3:6]) < 2e-3
    assert judge_camera_imu(spoiled).outlier_corners[0] > 100 > judge_camera_imu(found).outlier_corners[0]


@pytest.mark.long
def test_an_imu_noisier_than_stated_makes_sigmas_larger_and_fails(
    dance: Recorded, found: CameraImuFit
) -> None:
    run = record(Dance(1), 12.0, hz=6.0, imu=replace(NOISE, gyro_density=4.8e-3, accel_density=1.5e-2))
    noisy = calibrated(run)
    assert noisy.sigma_shift > 3 * found.sigma_shift
    assert noisy.sigmas.gyro == pytest.approx(20 * noisy.stated_sigmas.gyro, rel=0.2)
    assert any("gyroscope: residuals" in reason for reason in judge_camera_imu(noisy).reasons)


@pytest.mark.long
def test_a_scale_error_of_the_gyro_enlarges_the_sigmas(dance: Recorded, found: CameraImuFit) -> None:
    """By half a percent: far below the noise of a sample, far above that of long means."""
    imu = replace(dance.imu, gyro=dance.imu.gyro * np.array([1.005, 0.996, 1.003]))
    scaled = calibrated(replace(dance, imu=imu))
    assert judge_camera_imu(scaled).gyro_noise_ratio > 3 > 1.1 > judge_camera_imu(found).gyro_noise_ratio
    assert scaled.sigma_shift > 1.5 * found.sigma_shift
    off = error(scaled)
    assert np.degrees(np.linalg.norm(off[:3])) < 0.1 and np.linalg.norm(off[3:6]) < 2e-3


def test_too_little_rotation_about_one_axis_fails() -> None:
    verdict = judge_camera_imu(calibrated(record(Dance(1, axes=(1, 0.05, 1)), 8.0, hz=8.0)))
    assert any("nod, roll and look around" in reason for reason in verdict.reasons)


def test_rotation_about_one_axis_alone_is_refused() -> None:
    with pytest.raises(DataError, match="nod, roll and look around"):
        calibrated(record(Dance(1, axes=(1, 0, 0)), 8.0))


def test_the_imu_of_another_recording_is_refused(dance: Recorded) -> None:
    with pytest.raises(CalibrationMismatchError, match="match at no time offset"):
        calibrated(replace(dance, imu=record(Dance(8), 12.0, hz=6.0).imu))


def test_a_gap_in_the_imu_is_refused(dance: Recorded) -> None:
    t = (dance.imu.stamps_ns - START_NS) * 1e-9
    with pytest.raises(DataError, match=r"no samples for 0\.\d+ s"):
        calibrated(replace(dance, imu=dance.imu.take((t < 5) | (t > 5.3))))


def test_too_few_images_are_refused(dance: Recorded) -> None:
    with pytest.raises(DataError, match="pairs of successive images"):
        calibrated(replace(dance, stamps_ns=dance.stamps_ns[:20], views=dance.views[:20]))


@pytest.mark.parametrize("late_s", [-0.42, 0.0, 0.37])
def test_clocks_are_aligned_over_the_search_range(late_s: float) -> None:
    run = record(Dance(4), 12.0)
    T = Dance(4).camera((run.stamps_ns - START_NS) * 1e-9 + SHIFT_S)
    late = run.stamps_ns + round(late_s * 1e9)
    alignment = align_clocks(late, T, run.imu, 0.5)
    assert alignment.shift_s == pytest.approx(SHIFT_S - late_s, abs=2e-3)
    assert np.degrees(se3.rotation_angle(alignment.R_imu_cam0.T @ T_IMU_CAM0[:3, :3])) < 1


def test_an_inverted_extrinsic_is_distinguished_from_a_wrong_one() -> None:
    assert compare_mountings(T_IMU_CAM0, se3.inverse(T_IMU_CAM0)).inverted
    straight = compare_mountings(T_IMU_CAM0, T_IMU_CAM0 @ se3.exp(np.array([0.002, 0, 0, 0.001, 0, 0])))
    assert not straight.inverted and not straight.is_far
    wrong = compare_mountings(T_IMU_CAM0, se3.exp(np.array([0.4, 0, 0, 0.3, 0, 0])))
    assert not wrong.inverted and wrong.is_far
    d435i = se3.from_rt(np.eye(3), np.array([-0.00552, 0.0051, 0.01174]))  # turned by nothing
    assert (
        compare_mountings(d435i, se3.inverse(d435i)).inverted and not compare_mountings(d435i, d435i).inverted
    )


RIG_SIGMAS = np.array([0.2, 0.2, 0.4, 0.4, 1e-3, 1e-3, 1e-4, 1e-4] * 2 + [2e-4] * 3 + [1e-4] * 3)


def with_moved_cameras(run: Recorded, step: F64) -> Recorded:
    """The recording with cameras that are wrong by `step` (22,)."""
    rig = run.rig
    assert rig.cam1 is not None and rig.T_cam1_cam0 is not None
    cam0, cam1 = (
        camera_from_parameters(intrinsics(camera) + part, camera)
        for camera, part in ((rig.cam0, step[:8]), (rig.cam1, step[8:16]))
    )
    return replace(
        run, rig=replace(rig, cam0=cam0, cam1=cam1, T_cam1_cam0=rig.T_cam1_cam0 @ se3.exp(step[16:]))
    )


@pytest.mark.long
def test_the_effect_of_wrong_cameras_is_that_of_the_sensitivity(dance: Recorded, found: CameraImuFit) -> None:
    step = RIG_SIGMAS * np.random.default_rng(3).choice([-0.1, 0.1], len(RIG_SIGMAS))
    other = calibrated(with_moved_cameras(dance, step))
    batch = CameraImuProblem(found.stamps_ns, found.observations, found.imu, NOISE)
    moved = np.append(
        se3.log(se3.inverse(found.T_imu_cam0) @ other.T_imu_cam0), other.shift_s - found.shift_s
    )
    predicted = batch.rig_sensitivity(found.state, found.sigmas) @ step
    np.testing.assert_allclose(moved, predicted, atol=0.05 * np.abs(predicted[:3]).max())
    assert np.abs(predicted[3:6]).max() > 2e-5  # m: large enough to compare
    np.testing.assert_allclose(moved[3:6], predicted[3:6], atol=0.05 * np.abs(predicted[3:6]).max())


@pytest.mark.slow
def test_nees_with_uncertain_cameras_is_consistent() -> None:
    """Chi-square of 16 x 7: its 0.1 % quantiles."""
    nees, naive = [], []
    for seed in range(200, 216):
        step = np.random.default_rng(seed).normal(0, RIG_SIGMAS)
        run = with_moved_cameras(record(Dance(seed), 12.0, hz=8.0), step)
        found = calibrated(run, np.diag(RIG_SIGMAS**2))
        off = error(found)
        nees.append(off @ np.linalg.solve(found.covariance, off))
        naive.append(off @ np.linalg.solve(found.by_noise, off))
    assert 71 < sum(nees) < 163, nees
    assert sum(naive) > 2 * 163, naive  # too small if the cameras were taken as exact


@pytest.mark.slow
def test_nees_is_consistent() -> None:
    """Normalised estimation error squared of 24 recordings: chi-square of 24 x 7, its 0.1 % quantiles."""
    nees = []
    for seed in range(100, 124):
        found = calibrated(record(Dance(seed), 15.0))
        off = error(found)
        nees.append(off @ np.linalg.solve(found.covariance, off))
    assert 117 < sum(nees) < 229, nees
