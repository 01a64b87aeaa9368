"""Prediction of corners from their neighbours, with outliers among them."""

import numpy as np

from share.lab.calibrate.corners import predict_from_neighbours
from share.lab.calibrate.target import AprilGrid
from share.types import F64

BOARD = AprilGrid().corners[:, :2]
H = np.array([[380.0, -60.0, 40.0], [45.0, -330.0, 400.0], [0.12, -0.2, 1.0]])


def corner_px() -> F64:
    at = np.column_stack([BOARD, np.ones(len(BOARD))]) @ H.T
    return at[:, :2] / at[:, 2:]


def test_without_errors_predictions_are_exact() -> None:
    np.testing.assert_allclose(predict_from_neighbours(BOARD, corner_px()), corner_px(), atol=1e-6)


def test_outliers_and_missing_neighbours_do_not_change_predictions(rng: np.random.Generator) -> None:
    """A sixth are wrong by pixels, a tenth are missing, the others have 0.1 px of noise."""
    px = corner_px() + rng.normal(0, 0.1, BOARD.shape)
    wrong = rng.random(len(px)) < 1 / 6
    px[wrong] += rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(3, 9, (wrong.sum(), 2))
    px[rng.random(len(px)) < 0.1] = np.nan
    off = np.linalg.norm(predict_from_neighbours(BOARD, px) - corner_px(), axis=1)
    assert np.median(off) < 0.15 and np.quantile(off, 0.97) < 0.6


def test_a_corner_is_not_used_for_its_own_prediction(rng: np.random.Generator) -> None:
    px = corner_px()
    px[70] += 5
    np.testing.assert_allclose(predict_from_neighbours(BOARD, px)[70], corner_px()[70], atol=1e-6)


def test_too_few_neighbours_give_no_prediction() -> None:
    px = np.full(BOARD.shape, np.nan)
    px[:6] = corner_px()[:6]
    assert np.isnan(predict_from_neighbours(BOARD, px)).all()
    assert predict_from_neighbours(np.empty((0, 2)), np.empty((0, 2))).shape == (0, 2)


def test_neighbours_on_one_line_raise_no_error() -> None:
    line = np.column_stack([np.arange(8.0), np.zeros(8)])
    assert predict_from_neighbours(line, 10 * line).shape == (8, 2)


def test_arbitrary_corners_raise_no_error(rng: np.random.Generator) -> None:
    """As with a wrong --target; also many at one place, or at whole pixels."""
    for px in (
        rng.uniform(0, 480, BOARD.shape),
        np.repeat(rng.uniform(0, 480, (36, 2)), 4, axis=0),
        np.full(BOARD.shape, 7.0),
        rng.integers(0, 4, BOARD.shape).astype(float),
        np.column_stack([np.arange(144.0), np.arange(144.0)]),
    ):
        assert predict_from_neighbours(BOARD, px).shape == px.shape
