"""Both lens models against OpenCV's and against finite differences; nothing folds back."""

import warnings

import cv2
import numpy as np
import pytest

from share.geometry.camera import Camera

EUROC = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76e-05))
FIVE = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.29, 0.09, 2e-4, 2e-5, -0.015))
TUMVI = Camera(
    512, 512, 190.98, 190.97, 254.93, 256.90, (0.00348, 0.000715, -0.00205, 0.000203), "equidistant"
)
NONE = np.zeros((3, 1))


def _everywhere(rng, most_deg, n=400):
    """Return points (n, 3) up to `deg` degrees off the axis."""
    angle, turn = np.radians(rng.uniform(0, most_deg, n)), rng.uniform(0, 2 * np.pi, n)
    ray = [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]
    return np.column_stack(ray) * rng.uniform(0.3, 20, (n, 1))


@pytest.mark.parametrize("camera", [EUROC, FIVE])
def test_radtan_is_opencvs(camera, rng):
    points = _everywhere(rng, 45)
    want, _ = cv2.projectPoints(points, NONE, NONE, camera.K, np.array(camera.distortion))
    assert np.abs(camera.project(points) - want.reshape(-1, 2)).max() < 1e-9


def test_equidistant_is_opencvs(rng):
    points = _everywhere(rng, 74)
    want, _ = cv2.fisheye.projectPoints(points[:, None], NONE, NONE, TUMVI.K, np.array(TUMVI.distortion))
    assert np.abs(TUMVI.project(points) - want[:, 0]).max() < 1e-9
    np.testing.assert_allclose(TUMVI.project_wide(points), TUMVI.project(points), atol=1e-9)


@pytest.mark.parametrize(("camera", "deg"), [(EUROC, 45), (FIVE, 45), (TUMVI, 74)])
def test_undistortion_inverts_distortion(camera, deg, rng):
    points = _everywhere(rng, deg)
    px = camera.project(points)
    assert np.abs(camera.normalise(px) - points[:, :2] / points[:, 2:]).max() < 1e-8
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.abs(camera.directions(px) - unit).max() < 1e-9


def test_directions_of_a_fisheye_go_behind_the_camera(rng):
    points = _everywhere(rng, 110)
    assert (points[:, 2] < 0).any()
    px = TUMVI.project_wide(points)
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.abs(TUMVI.directions(px) - unit).max() < 1e-9


@pytest.mark.parametrize(("camera", "deg"), [(EUROC, 45), (FIVE, 45), (TUMVI, 74)])
def test_jacobian_against_differences(camera, deg, rng):
    points, eps = _everywhere(rng, deg), 1e-6
    uv = points[:, :2] / points[:, 2:]
    J = camera.jacobian(uv)
    for axis, d in enumerate(np.eye(2) * eps):
        difference = (camera.distort(uv + d) - camera.distort(uv - d)) / (2 * eps)
        assert np.abs(J[..., axis] - difference).max() < 1e-5


@pytest.mark.parametrize(("camera", "deg"), [(EUROC, 45), (FIVE, 45), (TUMVI, 110)])
def test_derivatives_by_points_and_by_coefficients_against_differences(camera, deg, rng):
    points, eps, lens = _everywhere(rng, deg), 1e-6, camera.lens
    J, K = lens.point_jacobian(points), lens.coefficient_jacobian(points)
    for axis, d in enumerate(np.eye(3) * eps):
        difference = (lens.distort_points(points + d) - lens.distort_points(points - d)) / (2 * eps)
        assert np.abs(J[..., axis] - difference).max() < 1e-7
    for k, d in enumerate(np.eye(len(camera.distortion)) * eps):
        more, less = (type(lens)(tuple(lens.coefficients + s * d), lens.limit) for s in (1, -1))
        difference = (more.distort_points(points) - less.distort_points(points)) / (2 * eps)
        assert np.abs(K[..., k] - difference).max() < 1e-7


@pytest.mark.parametrize("camera", [EUROC, FIVE, TUMVI])
def test_derivatives_on_the_axis_are_finite(camera):
    middle = np.array([[0.0, 0, 2]])
    centre = np.array([[camera.cx, camera.cy]])
    np.testing.assert_allclose(camera.project(middle), centre)
    np.testing.assert_allclose(camera.normalise(centre), [[0, 0]], atol=1e-12)
    np.testing.assert_allclose(camera.directions(centre), [[0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(camera.jacobian(np.zeros((1, 2)))[0], np.diag([camera.fx, camera.fy]))
    J = camera.lens.point_jacobian(middle)[0]
    np.testing.assert_allclose(J, np.diag([0.5, 0.5, 0])[:2], atol=1e-12)
    assert np.isfinite(camera.lens.coefficient_jacobian(middle)).all()


def test_points_beyond_a_lenss_range_are_nan():
    """1 - 3 * 0.5 r^2 is 0 at 0.816: points further out would fold back into the image."""
    strong = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, (-0.5, 0.0, 0.0, 0.0))
    within, beyond = np.array([[0.8, 0.0]]), np.array([[0.9, 0.0]])
    assert np.isfinite(strong.distort(within)).all() and np.isnan(strong.distort(beyond)).all()
    np.testing.assert_allclose(strong.normalise(strong.distort(within)), within, atol=1e-6)
    assert np.isnan(strong.normalise(np.array([[639.0, 240.0]]))).all()  # 319 px; the most is 163
    short = Camera(640, 480, 200.0, 200.0, 320.0, 240.0, (-0.3, 0.0, 0.0, 0.0), "equidistant")
    angles = np.array([1.0, 1.1])  # 1 - 0.9 a^2 is 0 at 1.054
    points = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
    assert np.isfinite(short.project(points)).tolist() == [[True, True], [False, False]]
    assert np.isfinite(short.project_wide(points)).tolist() == [[True, True], [False, False]]


def test_normalised_coordinates_of_a_fisheye_end_at_75_degrees():
    angles = np.radians([74.9, 75.1, 89.0, 91.0])
    points = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
    px = TUMVI.project_wide(points)
    assert np.isfinite(px).all()
    known = [[True, True], *[[False, False]] * 3]
    assert np.isfinite(TUMVI.project(points)).tolist() == known
    assert np.isfinite(TUMVI.normalise(px)).tolist() == known


def test_field_of_view():
    assert np.degrees(TUMVI.field_of_view_rad) == pytest.approx([150.0, 150.0])
    narrow = Camera(320, 240, 190.98, 190.97, 160.0, 120.0, TUMVI.distortion, "equidistant")
    assert np.degrees(narrow.field_of_view_rad[0]) == pytest.approx(2 * np.degrees(160 / 190.98), abs=0.5)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("equidistant", (30.0, -30.0, 1e-3, 1e-3)),
        ("equidistant", (1.0, -0.3, 1e-3, -0.3)),
        ("radtan", (0.0, 0.0, -1.0, 1.0, 0.0)),
        ("radtan", (0.0, 0.0, 30.0, 0.0, 0.0)),
        ("radtan", (1e4, 1e4, 30.0, 1e4)),
    ],
)
def test_absurd_coefficients_give_no_wrong_ray(model, coefficients):
    """A result is right or NaN, without a warning."""
    camera = Camera(64, 48, 30.0, 30.0, 31.5, 23.5, coefficients, model)
    px = np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), axis=-1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        uv = camera.normalise(px)
        known = np.isfinite(uv).all(axis=-1)
        np.testing.assert_allclose(camera.distort(uv[known]), px[known], atol=1e-3)
