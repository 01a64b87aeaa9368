"""Detection of corners in exact images of boards."""

import numpy as np
import pytest

from share.lab.calibrate.corners import detector
from share.lab.calibrate.target import AprilGrid, CharucoBoard, Target
from share.lab.calibrate.target_sheet import black_rectangles, darkness_image
from share.types import F64, U8

_TEXEL = 0.002  # m: tags of 44 px
_MARGIN = 0.04


def _image(target: Target) -> tuple[U8, F64]:
    """Return an image of the board seen from the front, and the pixels (N, 2) of its corners."""
    low, high = target.extent[0] - _MARGIN, target.extent[1] + _MARGIN
    columns, rows = np.round((high - low) / _TEXEL).astype(int)
    xs = low[0] + _TEXEL * np.arange(columns + 1)
    ys = high[1] - _TEXEL * np.arange(rows + 1)
    image = np.round(220 - 190 * darkness_image(black_rectangles(target), xs, ys)).astype(np.uint8)
    px = (target.corners[:, :2] - (low[0], high[1])) / (_TEXEL, -_TEXEL) - 0.5
    return image, px


@pytest.mark.parametrize("target", [AprilGrid(4, 5), CharucoBoard()])
def test_every_corner_is_detected_at_its_place(target: Target) -> None:
    image, truth = _image(target)
    found = detector(target)(image)
    np.testing.assert_array_equal(found.ids, np.arange(len(truth)))
    assert np.abs(found.px - truth).max() < 0.15


@pytest.mark.parametrize("target", [AprilGrid(4, 5), CharucoBoard()])
def test_corners_of_half_a_board_keep_their_ids(target: Target) -> None:
    image, truth = _image(target)
    half = image.shape[1] // 2
    found = detector(target)(np.ascontiguousarray(image[:, :half]))
    assert 0.3 * len(truth) < len(found) < 0.6 * len(truth)
    assert np.abs(found.px - truth[found.ids]).max() < 0.15


def test_tags_of_another_board_are_ignored() -> None:
    image, _ = _image(AprilGrid(4, 5))
    assert detector(AprilGrid(2, 5))(image).ids.max() < 40


def test_an_image_without_a_board_has_no_corners(rng: np.random.Generator) -> None:
    assert len(detector(AprilGrid())(rng.integers(0, 255, (200, 300), np.uint8))) == 0
