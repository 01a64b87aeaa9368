"""Corners of calibration targets, against Kalibr's grid and OpenCV's board."""

import re

import cv2
import numpy as np
import pytest

from share.lab.calibrate.target import AprilGrid, CharucoBoard


def test_aprilgrid_counts_tags_from_the_lower_left_and_corners_against_the_clock():
    grid = AprilGrid(rows=2, cols=3, tag_size=0.1, tag_spacing=0.2)
    corners = grid.corners.reshape(6, 4, 3)
    np.testing.assert_allclose(corners[0], [(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0), (0, 0.1, 0)])
    np.testing.assert_allclose(corners[1] - corners[0], np.tile((0.12, 0, 0), (4, 1)), atol=1e-15)
    np.testing.assert_allclose(corners[3] - corners[0], np.tile((0, 0.12, 0), (4, 1)), atol=1e-15)
    np.testing.assert_allclose(grid.extent, [(-0.02, -0.02), (0.36, 0.24)])


def test_charuco_corners_are_opencvs_with_y_up():
    ours = CharucoBoard(7, 5, 0.04, 0.03, "DICT_4X4_50")
    theirs = cv2.aruco.CharucoBoard(
        (7, 5), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    )
    x, y, z = np.asarray(theirs.getChessboardCorners()).T
    np.testing.assert_allclose(ours.corners, np.stack([x, 5 * 0.04 - y, -z], axis=1), atol=1e-7)
    middles = np.array([np.mean(marker, axis=0) for marker in theirs.getObjPoints()])
    np.testing.assert_allclose(
        ours.marker_squares + 0.02, np.stack([middles[:, 0], 0.2 - middles[:, 1]], axis=1), atol=1e-7
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AprilGrid(rows=0), "rows: 0 must be positive"),
        (lambda: AprilGrid(tag_size=float("nan")), "tag_size: nan must be positive"),
        (lambda: AprilGrid(tag_spacing=1.5), "tag_spacing: 1.5 must be below 1"),
        (lambda: AprilGrid(rows=30, cols=20), "30 x 20 tags: the family 36h11 has only 587"),
        (lambda: CharucoBoard(squares_x=1), "1 x 7 squares have no inner corner"),
        (lambda: CharucoBoard(marker=0.08), "marker: 0.08 m does not fit"),
        (lambda: CharucoBoard(dictionary="DICT_9X9"), "dictionary: 'DICT_9X9' is not known"),
        (lambda: CharucoBoard(20, 20, dictionary="DICT_5X5_100"), "DICT_5X5_100 is too small for 200"),
    ],
)
def test_an_impossible_target_is_refused(make, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make()
