"""Measurements of a fisheye lens are in its image plane, where all pixels have the same size."""

import numpy as np

from share.geometry.camera import Camera
from share.odometry import feature_matching
from share.odometry.feature_matching import Prediction

LENS = (0.00348, 0.000715, -0.00205, 0.000203)
FISHEYE = Camera(512, 512, 190.0, 190.0, 254.93, 256.90, LENS, "equidistant")


def test_a_pixel_has_the_same_size_everywhere():
    px = np.array([[255.0, 257], [255 + 240, 257], [100, 400]])
    one = FISHEYE.to_image_plane(FISHEYE.normalise(px + np.array([1.0, 0]))) - FISHEYE.to_image_plane(
        FISHEYE.normalise(px)
    )
    np.testing.assert_allclose(190.0 * one, [[1, 0]] * 3, atol=1e-6)
    plain = Camera(640, 480, 400.0, 400.0, 320.0, 240.0)
    assert plain.to_image_plane(px) is px


def test_derivatives_of_predictions_in_the_image_plane(rng):
    uv, eps = rng.uniform(-2, 2, (6, 2)), 1e-6
    by_rho, mine = rng.normal(size=(6, 2)), np.array([True, True, True, True, False, False])
    by_pose = rng.normal(size=(6, 2, 6))
    seen = feature_matching.in_image_plane(Prediction(uv, by_pose, -by_pose, by_rho), FISHEYE, mine)
    high, low = (FISHEYE.distort(uv + s * eps * by_rho) for s in (1, -1))
    np.testing.assert_allclose(seen.H_rho[mine], ((high - low) / (2 * eps * 190.0))[mine], atol=1e-6)
    for k in range(6):
        high, low = (FISHEYE.distort(uv + s * eps * by_pose[:, :, k]) for s in (1, -1))
        np.testing.assert_allclose(seen.H_pose[mine, :, k], ((high - low) / (380.0 * eps))[mine], atol=1e-6)
    np.testing.assert_allclose(seen.H_extrinsic, -seen.H_pose)
    np.testing.assert_allclose(seen.uv[mine], (FISHEYE.distort(uv[mine]) - (254.93, 256.90)) / 190.0)
    for name in ("uv", "H_pose", "H_extrinsic", "H_rho"):  # the others' are as they were
        theirs = getattr(Prediction(uv, by_pose, -by_pose, by_rho), name)[~mine]
        np.testing.assert_array_equal(getattr(seen, name)[~mine], theirs)
