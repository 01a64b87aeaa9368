"""Saddles of brightness are distinguished from other corners."""

import cv2
import numpy as np

from share.lab.calibrate.corners import refine_corners, saddle_mask
from share.types import F64, U8

RADII = np.full(3, 5)


def fields(dark: list[tuple[slice, slice]]) -> U8:
    """120 x 120, dark fields on bright paper, slanted and blurred; (59.5, 59.5) is the fixed point."""
    image = np.full((120, 120), 220, np.uint8)
    for rows, columns in dark:
        image[rows, columns] = 30
    askew = np.array([[1.0, 0.35, -0.35 * 59.5], [0.1, 0.8, 59.5 * (1 - 0.1 - 0.8)]])
    return np.asarray(cv2.GaussianBlur(cv2.warpAffine(image, askew, (120, 120)), (5, 5), 1.0), np.uint8)


LOW, HIGH = slice(30, 60), slice(60, 90)
NEAR: F64 = np.array([[60.5, 59.0], [59.0, 60.2], [58.9, 58.8]])


def test_a_slanted_saddle_is_recognised() -> None:
    image = fields([(LOW, LOW), (HIGH, HIGH)])
    found = refine_corners(image, NEAR, RADII)
    np.testing.assert_allclose(found, np.full((3, 2), 59.5), atol=0.1)
    assert saddle_mask(image, found, RADII).all()


def test_the_corner_of_one_dark_field_is_no_saddle() -> None:
    """`refine_corners` converges on it too."""
    image = fields([(LOW, LOW)])
    found = refine_corners(image, NEAR, RADII)
    np.testing.assert_allclose(found, np.full((3, 2), 59.5), atol=0.8)
    assert not saddle_mask(image, found, RADII).any()


def test_a_saddle_under_uneven_light_is_recognised() -> None:
    shade = np.linspace(0.5, 1.0, 120)
    image = (fields([(LOW, LOW), (HIGH, HIGH)]) * shade).astype(np.uint8)
    assert saddle_mask(image, np.full((1, 2), 59.5), RADII[:1]).all()


def test_corners_that_are_not_found_are_no_saddles() -> None:
    image = fields([])
    assert not saddle_mask(image, np.array([[np.nan, np.nan], [50.0, 50.0]]), RADII[:2]).any()
    assert saddle_mask(image, np.empty((0, 2)), RADII[:0]).shape == (0,)
