"""Calibration of simulated cameras: derivatives, estimates, covariances, choice of views."""

import cv2
import numpy as np
import pytest

from share.geometry import se3
from share.geometry.camera import Camera
from share.lab.calibrate import camera_bundle
from share.lab.calibrate.camera_bundle import calibrate_cameras
from share.lab.calibrate.camera_initialisation import (
    camera_from_parameters,
    has_enough_corners,
    intrinsics,
    parameter_names,
    project_with_jacobians,
    transform_with_jacobian,
)
from share.lab.calibrate.camera_verdict import CELL_GRID as COVER_GRID
from share.lab.calibrate.camera_verdict import (
    Coverage,
    choose_views,
    coverage,
    epipolar_distances,
    judge_cameras,
    median_epipolar_px,
)
from share.lab.calibrate.corner_observations import BoardView
from share.lab.calibrate.corners import Detection
from share.lab.calibrate.target import AprilGrid, CharucoBoard
from share.types import F64

SIZE = (752, 480)
LEFT = Camera(*SIZE, 458.6, 457.3, 367.2, 248.4, (-0.283, 0.074, 2e-4, 2e-5))
RIGHT = Camera(*SIZE, 457.6, 456.1, 379.9, 255.2, (-0.284, 0.075, -1e-4, -4e-5))
FIVE = Camera(*SIZE, 458.6, 457.3, 367.2, 248.4, (-0.315, 0.136, 1e-4, -1e-4, -0.032))  # the real EuRoC lens
FISHEYE = Camera(512, 512, 190.98, 190.97, 254.93, 256.9, (0.0035, 0.0007, -0.002, 0.0002), "equidistant")
GRID = AprilGrid()


def _mount() -> F64:
    return se3.exp(np.array([0.002, 0.014, -0.001, -0.11, 0.0004, -0.0008]))


def _poses(rng: np.random.Generator, count: int) -> F64:
    """T_cam0_target of boards that face the camera, tilted by up to 35 degrees, anywhere in the image."""
    facing = se3.exp(np.array([np.pi, 0, 0, 0, 0, 0]))
    lean = np.concatenate([rng.uniform(-0.6, 0.6, (count, 3)), np.zeros((count, 3))], axis=1)
    middle = np.append(GRID.extent.mean(axis=0), 0)
    T = facing @ se3.exp(lean)
    depth = rng.uniform(0.6, 1.3, count)
    at = np.column_stack(
        [rng.uniform(-0.5, 0.5, count) * depth, rng.uniform(-0.3, 0.3, count) * depth, depth]
    )
    T[:, :3, 3] = at - T[:, :3, :3] @ middle
    return T


def _views(
    rng: np.random.Generator,
    noise_px: float,
    count: int = 25,
    wrong: float = 0.0,
    pair: tuple[Camera, Camera] = (LEFT, RIGHT),
) -> list[BoardView]:
    out = []
    for k, T in enumerate(_poses(rng, count)):
        detections = []
        for camera, pose in zip(pair, (T, _mount() @ T), strict=True):
            px = camera.project_wide(se3.transform(pose, GRID.corners))
            ids = np.flatnonzero(camera.is_inside(px, 3.0))
            noisy = px[ids] + rng.normal(0, noise_px, (len(ids), 2))
            is_wrong = rng.random(len(ids)) < wrong
            noisy[is_wrong] += rng.uniform(-8, 8, (int(is_wrong.sum()), 2))
            detections.append(Detection(ids, noisy))
        out.append(BoardView(str(k), tuple(detections)))
    return out


@pytest.mark.parametrize("camera", [LEFT, FIVE, FISHEYE], ids=["radtan", "with k3", "equidistant"])
def test_the_derivatives_of_a_projection_equal_finite_differences(camera: Camera) -> None:
    T, points = _poses(np.random.default_rng(0), 1)[0], GRID.corners[::7]
    points = points[np.isfinite(camera.project(se3.transform(T, points))).all(axis=1)]
    assert len(points) > 10
    at, by_pose = transform_with_jacobian(T, points)
    px, by_intrinsics, by_points = project_with_jacobians(camera, at)
    np.testing.assert_allclose(px, camera.project(at), atol=1e-9)
    h, count = 1e-6, len(parameter_names(camera))
    for k in range(count):
        step = np.eye(count)[k] * h
        high, low = (
            camera_from_parameters(intrinsics(camera) + s * step, camera).project(at) for s in (1, -1)
        )
        np.testing.assert_allclose(by_intrinsics[:, :, k], (high - low) / (2 * h), rtol=1e-5, atol=1e-5)
    for k in range(6):
        xi = np.eye(6)[k] * h
        high, low = (camera.project(se3.transform(T @ se3.exp(s * xi), points)) for s in (1, -1))
        predicted = (by_points @ by_pose)[:, :, k]
        np.testing.assert_allclose(predicted, (high - low) / (2 * h), rtol=1e-5, atol=1e-4)


@pytest.mark.long
def test_without_noise_a_stereo_pair_is_found_exactly(rng: np.random.Generator) -> None:
    solution = calibrate_cameras(_views(rng, 0.0), GRID, SIZE)
    for found, truth in zip(solution.state.cameras, (LEFT, RIGHT), strict=True):
        np.testing.assert_allclose(intrinsics(found), intrinsics(truth), rtol=1e-6, atol=1e-6)
    assert np.linalg.norm(se3.log(se3.inverse(_mount()) @ solution.state.T_cam1_cam0)) < 1e-7


def test_k3_is_estimated_where_it_is_significant(rng: np.random.Generator) -> None:
    def one_camera(pair: tuple[Camera, Camera]) -> camera_bundle.CameraBundleState:
        views = [BoardView(view.name, view.detections[:1]) for view in _views(rng, 0.1, 12, pair=pair)]
        solution = calibrate_cameras(views, GRID, SIZE)
        off = (intrinsics(solution.state.cameras[0]) - intrinsics(pair[0])) / solution.sigmas
        assert np.abs(off).max() < 4.5
        return solution.state

    assert len(one_camera((FIVE, FIVE)).cameras[0].distortion) == 5
    assert len(one_camera((LEFT, RIGHT)).cameras[0].distortion) == 4


@pytest.mark.long
def test_a_fisheye_pair_is_found(rng: np.random.Generator) -> None:
    """Also with boards so near that they reach beyond 75 degrees, outside a tracker's field of view."""
    views = []
    for k, T in enumerate(_poses(rng, 12)):
        T[:3, 3] *= 0.4
        detections = []
        for pose in (T, _mount() @ T):
            px = FISHEYE.project_wide(se3.transform(pose, GRID.corners))
            ids = np.flatnonzero(FISHEYE.is_inside(np.nan_to_num(px, nan=-1.0), 3.0))
            detections.append(Detection(ids, px[ids] + rng.normal(0, 0.1, (len(ids), 2))))
        views.append(BoardView(str(k), tuple(detections)))
    every = np.concatenate([one.px for view in views for one in view.detections])
    assert np.isnan(FISHEYE.normalise(every)).any()
    found = calibrate_cameras(views, GRID, (512, 512), "equidistant")
    for camera, part in zip(found.state.cameras, found.state.intrinsic_slices, strict=True):
        assert camera.model == "equidistant"
        assert np.abs((intrinsics(camera) - intrinsics(FISHEYE)) / found.sigmas[part]).max() < 4.5
    assert found.sigma_px == pytest.approx(0.1, rel=0.1)
    assert np.linalg.norm(se3.log(se3.inverse(_mount()) @ found.state.T_cam1_cam0)) < 1e-3
    state = found.state
    assert median_epipolar_px(*state.cameras, state.T_cam1_cam0, views) < 0.2


def test_with_equal_weights_the_solution_is_opencvs(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(camera_bundle, "HUBER_SIGMAS", 1e6)  # OpenCV has no robust loss
    views = [BoardView(v.name, v.detections[:1]) for v in _views(rng, 0.2)]
    solution = calibrate_cameras(views, GRID, SIZE)
    boards = [GRID.corners[v.detections[0].ids].astype(np.float32) for v in views]
    pixels = [v.detections[0].px.astype(np.float32) for v in views]
    _, K, bent, _, _ = cv2.calibrateCamera(
        boards, pixels, SIZE, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3, criteria=(3, 200, 1e-12)
    )
    theirs = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(bent)[:4]]
    difference = intrinsics(solution.state.cameras[0]) - theirs
    assert np.abs(difference / solution.sigmas).max() < 0.01


@pytest.mark.slow
def test_nees_is_consistent() -> None:
    nees = []
    for seed in range(12):
        solution = calibrate_cameras(_views(np.random.default_rng(seed), 0.2, count=15), GRID, SIZE)
        error = np.concatenate(
            [
                intrinsics(f) - intrinsics(t)
                for f, t in zip(solution.state.cameras, (LEFT, RIGHT), strict=True)
            ]
        )
        nees.append(error @ np.linalg.solve(solution.independent[:16, :16], error))
        assert solution.sigma_px == pytest.approx(0.2, rel=0.05)
    assert 110 < sum(nees) < 280  # chi-square of 12 x 16 = 192: its 1e-5 quantiles are about 117 and 285


@pytest.mark.long
def test_sigmas_include_a_board_that_bends_anew_in_each_view() -> None:
    """By a millimetre: the corners of a view have correlated errors."""
    low, high = GRID.extent
    across, up = ((GRID.corners[:, :2] - low) / (high - low) * 2 - 1).T
    z, naive = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        views = []
        for k, T in enumerate(_poses(rng, 15)):
            bent = GRID.corners.copy()
            bent[:, 2] = np.stack([across**2, up**2, across * up], axis=1) @ rng.normal(0, 1e-3, 3)
            px = LEFT.project(se3.transform(T, bent))
            ids = np.flatnonzero(LEFT.is_inside(px, 3.0))
            views.append(BoardView(str(k), (Detection(ids, px[ids] + rng.normal(0, 0.1, (len(ids), 2))),)))
        solution = calibrate_cameras(views, GRID, SIZE)
        error = intrinsics(solution.state.cameras[0]) - intrinsics(LEFT)
        z.append(error / solution.sigmas)
        naive.append(error / np.sqrt(np.diag(solution.independent)))
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.5
    assert np.sqrt(np.mean(np.square(naive))) > 2.5


def test_outlier_corners_hardly_change_the_estimate(rng: np.random.Generator) -> None:
    solution = calibrate_cameras(_views(rng, 0.1, wrong=0.03), GRID, SIZE)
    assert solution.state.cameras[0].fx == pytest.approx(LEFT.fx, rel=1e-3)
    assert solution.state.cameras[1].cx == pytest.approx(RIGHT.cx, abs=0.5)


def test_epipolar_distances_show_a_moved_camera(rng: np.random.Generator) -> None:
    """0.2 px of noise on both corners, across the line: a median of 0.6745 sqrt(2) 0.2, and up to half as
    much again where the lens draws together what lies outside. Then a pitch, and a camera that is late."""
    views = _views(rng, 0.2, wrong=0.03)
    assert np.abs(epipolar_distances(LEFT, RIGHT, _mount(), _views(rng, 0.0))).max() < 1e-6
    assert 1.0 < median_epipolar_px(LEFT, RIGHT, _mount(), views) / (0.6745 * np.sqrt(2) * 0.2) < 1.3
    pitched = se3.exp(np.array([0.002, 0, 0, 0, 0, 0])) @ _mount()
    assert median_epipolar_px(LEFT, RIGHT, pitched, views) == pytest.approx(0.002 * RIGHT.fy, rel=0.15)
    lower = np.array([0.0, 3.0])
    late = [
        BoardView(v.name, (v.detections[0], Detection(v.detections[1].ids, v.detections[1].px + lower)))
        for v in views
    ]
    solution = calibrate_cameras(views, GRID, SIZE)
    covers = [Coverage(np.full(COVER_GRID, 5), np.zeros((20, 2)), np.linspace(0.5, 1.0, 20))] * 2
    assert judge_cameras(solution, covers, views).passed
    (reason,) = judge_cameras(solution, covers, late).reasons
    assert reason.startswith("stereo pair: median distance of corners from their epipolar lines is 3.")


def test_a_board_that_is_never_tilted_is_refused(rng: np.random.Generator) -> None:
    facing = se3.exp(np.array([np.pi, 0, 0, 0, 0, 0]))
    views = []
    for k in range(15):
        T = facing.copy()
        T[:3, 3] = (-0.35, 0.3, 0.9 + 0.001 * k)
        px = LEFT.project(se3.transform(T, GRID.corners)) + rng.normal(0, 0.1, (144, 2))
        views.append(BoardView(str(k), (Detection(np.arange(144), px),)))
    with pytest.raises(ValueError, match="tilt the board"):
        calibrate_cameras(views, GRID, SIZE)


def test_too_few_views_are_refused(rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="3 views of the target; at least 4 are needed"):
        calibrate_cameras(_views(rng, 0.1, count=3), GRID, SIZE)


def test_chosen_views_cover_more_of_the_image_than_the_first(rng: np.random.Generator) -> None:
    views = _views(rng, 0.1, count=60)
    one = [BoardView(v.name, v.detections[:1]) for v in views]
    chosen = choose_views(one, GRID, SIZE, 8)
    assert len(chosen) == 8

    def reached(numbers: list[int]) -> float:
        poses = np.stack([np.eye(4)] * len(numbers))
        return coverage([one[k].detections[0].px for k in numbers], poses, GRID, SIZE).share

    assert reached(chosen) >= reached(list(range(8)))


def test_few_of_nearly_equal_views_are_chosen(rng: np.random.Generator) -> None:
    """Each view comes ten times in a row."""
    views = [
        BoardView(f"{v.name}-{k}", v.detections[:1]) for v in _views(rng, 0.1, count=20) for k in range(10)
    ]
    chosen = choose_views(views, GRID, SIZE, 20)
    assert len(chosen) == 20 and len({k // 10 for k in chosen}) >= 19


def test_gaps_of_the_coverage_are_described() -> None:
    facing = se3.exp(np.array([[np.pi, 0, 0, 0, 0, 0.8]]))
    gaps = coverage([np.array([[300.0, 200.0]])], facing, GRID, SIZE).gaps
    assert "no view reaches the image's upper right corner" in gaps
    assert "all views are from one distance: move nearer and farther" in gaps


@pytest.mark.parametrize(("ids", "enough"), [(range(8), False), (range(9), False), (range(10), True)])
def test_corners_on_a_line_do_not_determine_a_homography(ids: range, enough: bool) -> None:
    board = CharucoBoard().corners[list(ids), :2]  # 8 corners a row
    assert has_enough_corners(board) == enough


def test_views_with_one_row_of_corners_are_not_chosen(rng: np.random.Generator) -> None:
    board, views = CharucoBoard(), []
    for k, T in enumerate(_poses(rng, 12)):
        px = LEFT.project(se3.transform(T, board.corners))
        ids = np.arange(8) if k == 5 else np.flatnonzero(LEFT.is_inside(px, 3.0))
        views.append(BoardView(str(k), (Detection(ids, px[ids]),)))
    assert 5 not in choose_views(views, board, SIZE, 12)
    usable = [view for view in views if view.name != "5"]
    solution = calibrate_cameras(usable, board, SIZE)
    np.testing.assert_allclose(intrinsics(solution.state.cameras[0]), intrinsics(LEFT), rtol=1e-5, atol=1e-5)


def test_an_empty_view_adds_no_coverage() -> None:
    poses = se3.exp(np.array([[np.pi, 0, 0, 0, 0, 0.8], [np.pi, 0.9, 0, 0, 0, 1.6]]))
    covered = coverage([np.array([[300.0, 200.0]]), np.empty((0, 2))], poses, GRID, SIZE)
    assert len(covered.distances) == len(covered.tilts) == 1
    assert "all views are from one distance: move nearer and farther" in covered.gaps
