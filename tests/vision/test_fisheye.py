"""The used part of a fisheye lens's image, and its disparity."""

import cv2
import numpy as np
import pytest

from share.geometry import se3
from share.geometry.camera import Camera, Rig, rays
from share.vision import corners
from share.vision.corners import field_mask
from share.vision.depth import disparity_per_rho
from share.vision.orb import detect_orb

FISHEYE = Camera(256, 256, 95.0, 95.0, 127.0, 128.0, (0.0035, 0.0007, -0.002, 0.0002), "equidistant")
PLAIN = Camera(256, 256, 95.0, 95.0, 127.0, 128.0)
T_CAM1_CAM0 = se3.from_rt(np.eye(3), np.array([-0.1, 0.0, 0.0]))


def _noise():
    image = np.random.default_rng(0).integers(0, 256, (256, 256), np.uint8)
    return cv2.GaussianBlur(image, (5, 5), 1.0)


def test_corners_and_orb_stay_within_the_mask():
    mask, image, nobody = field_mask(FISHEYE, 60.0), _noise(), np.zeros((0, 2), np.float32)
    for px in (
        corners.detect(image, nobody, 300, 4.0, mask),
        corners.strongest(image, nobody, 300, 4.0, mask=mask),
        detect_orb(image, 300, mask=mask)[0],
    ):
        assert len(px) > 100
        off = np.degrees(np.arctan(np.linalg.norm(FISHEYE.normalise(px.astype(float)), axis=1)))
        assert off.max() < 61.5  # refined by a pixel


def test_an_unbounded_lens_needs_no_mask():
    assert field_mask(PLAIN) is None
    assert (field_mask(FISHEYE) > 0).mean() > (field_mask(FISHEYE, 60.0) > 0).mean() > 0.3


@pytest.mark.long
def test_a_lens_that_ends_within_the_image_is_masked_beyond():
    """As the real EuRoC lens with k3: its radial polynomial falls beyond 55 degrees."""
    lens = Camera(752, 480, 460.3, 459.0, 367.2, 248.4, (-0.315, 0.136, 1e-4, -1e-4, -0.0325))
    mask = field_mask(lens)
    y, x = np.nonzero(mask == 0)
    assert 0 < len(x) < 0.05 * mask.size
    assert np.hypot(x - lens.cx, y - lens.cy).min() > 400
    beyond = np.column_stack([x, y]).astype(float)
    assert not lens.has_normalised(beyond).any() and lens.has_normalised(np.array([[376.0, 240.0]])).all()


def test_disparity_per_inverse_depth_agrees_with_projection():
    rig = Rig(FISHEYE, np.eye(4), FISHEYE, T_CAM1_CAM0)
    uv, rho, eps = np.array([[0.0, 0], [1.5, 0.2], [-2.5, 0], [0.3, -2.5]]), np.full(4, 0.5), 1e-5
    seen = [
        rig.cam1.project(rays(uv) @ T_CAM1_CAM0[:3, :3].T + r * T_CAM1_CAM0[:3, 3])
        for r in (0.5 - eps, 0.5 + eps)
    ]
    moved = np.linalg.norm(seen[1] - seen[0], axis=1) / (2 * eps)
    np.testing.assert_allclose(disparity_per_rho(rig, uv, rho), moved, rtol=1e-4)
    assert moved[0] > 5 * moved[2]  # along the baseline, at 68 degrees
    plain = Rig(PLAIN, np.eye(4), PLAIN, T_CAM1_CAM0)
    np.testing.assert_allclose(disparity_per_rho(plain, uv, rho), 9.5)
