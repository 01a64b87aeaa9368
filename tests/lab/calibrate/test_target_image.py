"""Images of targets: exact fractions of texels, and readable by detectors."""

import json

import cv2
import numpy as np
import pytest

from share.geometry.camera import Camera
from share.lab.calibrate.target import AprilGrid, CharucoBoard, Target
from share.lab.calibrate.target_sheet import black_rectangles, darkness_image

TARGETS = [AprilGrid(), AprilGrid(3, 5, 0.055, 0.28), CharucoBoard(), CharucoBoard(8, 6, 0.05, 0.035)]
EUROC = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76e-05))
FROM_OPENCV = [1, 0, 3, 2]  # OpenCV's order of a tag's corners in ours: its tags stand on their heads


def drawn(target: Target, texel: float, margin: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    """Return a gray image and the pixels (N, 2) of the corners."""
    low, high = target.extent[0] - margin, target.extent[1] + margin
    width, height = ((high - low) / texel).astype(int)
    xs, ys = low[0] + np.arange(width + 1) * texel, high[1] - np.arange(height + 1) * texel
    picture = (225 - 200 * darkness_image(black_rectangles(target), xs, ys)).round().astype(np.uint8)
    x, y, _ = target.corners.T
    return picture, np.stack([(x - xs[0]) / texel - 0.5, (ys[0] - y) / texel - 0.5], axis=1)


def tags(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return corner ids (N,) and pixels (N, 2) of an AprilGrid by OpenCV."""
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits = 2
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    found, ids, _ = cv2.aruco.ArucoDetector(family, options).detectMarkers(image)
    corners = np.reshape(found, (-1, 4, 2))[:, FROM_OPENCV].reshape(-1, 2)
    return (4 * np.ravel(ids)[:, None] + np.arange(4)).ravel(), corners


@pytest.mark.parametrize("target", TARGETS)
def test_rectangles_do_not_overlap(target):
    low, high = target.extent
    xs, ys = np.linspace(low[0], high[0], 301), np.linspace(high[1], low[1], 301)
    dark = darkness_image(black_rectangles(target), xs, ys)
    assert dark.min() > -1e-9
    assert dark.max() < 1 + 1e-9
    x0, y0, x1, y1 = black_rectangles(target).T
    np.testing.assert_allclose(dark.mean() * np.prod(high - low), ((x1 - x0) * (y1 - y0)).sum())


def test_an_edge_is_exact_to_a_hundredth_of_a_texel():
    rectangle = np.array([[0.0123, -1, 1, 1]])
    dark = darkness_image(rectangle, np.linspace(0, 0.05, 51), np.array([0.001, 0.0]))[0]
    assert 50 - dark.sum() == pytest.approx(12.3, abs=1e-9)


def test_opencv_reads_our_aprilgrid():
    target = AprilGrid()
    picture, true = drawn(target, 0.0008)
    ids, corners = tags(picture)
    assert sorted(ids) == list(range(144))
    assert np.abs(corners - true[ids]).max() < 0.1


@pytest.mark.parametrize("target", [CharucoBoard(), CharucoBoard(8, 6, 0.05, 0.035, "DICT_4X4_50")])
def test_opencv_reads_our_charuco_board(target):
    picture, true = drawn(target, 0.0008)
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    size = (target.squares_x, target.squares_y)
    board = cv2.aruco.CharucoBoard(size, target.square, target.marker, family)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(picture)
    assert sorted(np.ravel(ids)) == list(range(len(true)))
    assert np.abs(np.reshape(corners, (-1, 2)) - true[np.ravel(ids)]).max() < 0.01


def test_corners_of_a_real_board_have_our_ids_and_places(shared_data):
    folder = shared_data / "real" / "euroc_aprilgrid"
    frames = json.loads((folder / "detected_corners.json").read_text())["value0"]
    frame = next(f["value"] for f in frames if f["key"] == {"first": 11, "second": 0})
    real = np.array([[p["value0"], p["value1"]] for p in frame["value0"]])
    real_ids = np.array(frame["value1"])
    seen = EUROC.normalise(real) * EUROC.focal
    plane = AprilGrid().corners[real_ids, :2]
    H, _ = cv2.findHomography(plane, seen, cv2.LMEDS)
    error = np.linalg.norm(cv2.perspectiveTransform(plane[None], H)[0] - seen, axis=1)
    assert np.median(error) < 0.4  # with corners in another order it is a tag's 30 px
    assert np.linalg.det(H[:2, :2]) < 0  # y is up on the board and down in the image
    image = cv2.imread(str(folder / "11_0.jpg"), cv2.IMREAD_GRAYSCALE)
    ids, ours = tags(image)
    known = np.isin(ids, real_ids)
    there = real[[int(np.flatnonzero(real_ids == k)[0]) for k in ids[known]]]
    assert known.sum() >= 80
    refined = cv2.cornerSubPix(image, ours[known, None].copy(), (4, 4), (-1, -1), (3, 60, 1e-3))[:, 0]
    assert np.median(np.linalg.norm(refined - there, axis=1)) < 0.05
