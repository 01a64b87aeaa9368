"""Inputs of the error model, on images and features whose numbers are known."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from share.odometry.error_model.history import FrameOutcome, RecentMotion
from share.odometry.error_model.inputs import (
    PICTURE_PX,
    SCALAR_NAMES,
    ErrorModelInput,
    error_model_input,
    point_distribution,
    scalar_features,
)
from share.types import U8, FeatureStatistics, TrackState

SIZE = (640, 480)
MOTION = RecentMotion((FrameOutcome(0, True, TrackState.OK, 50, 50, 0.0),), 1.0, 0.5, (0.3,))
GREY: U8 = np.full((240, 320), 128, np.uint8)


def statistics(px=(), inliers=None, depth=None, expected=0, known=0) -> FeatureStatistics:
    px = np.array(px, np.float32).reshape(-1, 2)
    inliers = np.ones(len(px), bool) if inliers is None else np.array(inliers, bool)
    depth = np.full(len(px), 2.0) if depth is None else np.array(depth, float)
    return FeatureStatistics(px, inliers, depth, expected, known)


def scalars(image: U8 = GREY, sigma_cm: float = 1.0, **points) -> dict[str, float]:
    return dict(
        zip(SCALAR_NAMES, scalar_features(image, statistics(**points), sigma_cm).tolist(), strict=True)
    )


def test_a_plain_wall_without_features_gives_zeros():
    assert (point_distribution(GREY, statistics(), SIZE) == 0).all()
    plain = scalars(sigma_cm=0.0)
    assert plain.pop("brightness") == pytest.approx(128 / 255)
    assert set(plain.values()) == {0.0}


def test_a_corner_counts_in_its_own_cell():
    image = GREY.copy()
    image[:, 170:] = 40  # cells 20 px wide: an edge within column 8
    image[130:, :] = 40  # and row 6
    strength = point_distribution(image, statistics(), SIZE)[0]
    assert np.argwhere(strength > 0.3).tolist() == [[6, 8]]
    assert strength.max() <= 1
    fainter = point_distribution(((image.astype(int) - 128) // 4 + 128).astype(np.uint8), statistics(), SIZE)[
        0
    ]
    assert 0 < fainter[6, 8] < strength[6, 8]


def test_features_count_in_their_cell_for_any_image_size():
    for size in (SIZE, (752, 480), (320, 240)):
        at = np.array([[0.5 / 16, 0.5 / 12], [0.6 / 16, 0.4 / 12], [15.5 / 16, 11.5 / 12]]) * size
        grid = point_distribution(GREY, statistics(at, depth=[1.0, 2.0, np.nan]), size)
        assert np.argwhere(grid[1]).tolist() == [[0, 0], [11, 15]]
        assert grid[1, 0, 0] == pytest.approx(2 / 4)
        assert grid[2, 0, 0] == pytest.approx((1 / 1 + 1 / 2) / 2 * 0.5)
        assert grid[2, 11, 15] == 0  # its depth is unknown


def test_outliers_do_not_count():
    grid = point_distribution(GREY, statistics([[10, 10], [11, 11]], inliers=[True, False]), SIZE)
    assert grid[1, 0, 0] == pytest.approx(1 / 4)


def test_channels_stay_between_0_and_1(rng):
    image = rng.integers(0, 256, (240, 320), np.uint8)
    px = rng.uniform(0, 479, (500, 2))
    grid = point_distribution(image, statistics(px, depth=rng.uniform(0.05, 12, 500)), SIZE)
    assert grid.min() >= 0
    assert grid.max() <= 1


def test_scalars_of_tracking():
    numbers = scalars(px=[[1, 1], [2, 2], [3, 3]], inliers=[1, 0, 1], expected=8, known=200, sigma_cm=1.0)
    assert numbers["keypoints"] == pytest.approx(math.log(9) / math.log(201))
    assert numbers["matches"] == pytest.approx(2 / 8)
    assert numbers["active map points"] == pytest.approx(1)
    assert numbers["tracking score"] == pytest.approx(0.5)  # 1 cm is in the middle of 0.1 mm to 1 m
    assert scalars(sigma_cm=1e-9)["tracking score"] == 0
    assert scalars(px=[[1, 1]], expected=0)["matches"] == 1


def test_scalars_of_the_image(rng):
    half = GREY.copy()
    half[:, ::2], half[:, 1::2] = 0, 255
    striped = scalars(half)
    assert striped["entropy"] == pytest.approx(1 / 8)
    assert striped["contrast"] == pytest.approx(127.5 / 128)
    noise = rng.integers(0, 256, (240, 320), np.uint8)
    assert scalars(noise)["entropy"] == pytest.approx(1, abs=1e-3)
    blurred = cv2.GaussianBlur(noise, (0, 0), 3)
    assert scalars(blurred)["laplacian variance"] < scalars(noise)["laplacian variance"] - 0.3


def test_the_input_is_made_for_any_camera(rng):
    for shape in ((480, 640), (480, 752), (240, 320)):
        image = rng.integers(0, 256, shape, np.uint8)
        made = error_model_input(image, statistics([[5, 5]], expected=1, known=1), MOTION)
        assert made.picture.shape == (PICTURE_PX, PICTURE_PX)
        assert abs(made.picture.mean() - image.mean()) < 1.5
        assert made.psd[1, 0, 0] == 0.25
        assert made.recent[0] == pytest.approx(made.scalars[SCALAR_NAMES.index("tracking score")])


def test_features_of_another_shape_are_refused():
    right = error_model_input(np.zeros((480, 640), np.uint8), statistics(), MOTION)
    with pytest.raises(ValueError, match="scalars: shape"):
        ErrorModelInput(right.picture, right.psd, right.scalars[:-1], right.recent)
