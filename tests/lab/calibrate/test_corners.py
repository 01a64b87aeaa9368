"""What residuals of corners say."""

import numpy as np

from share.lab.calibrate.corners import count_outliers, inlier_mask, model_radius


def test_where_a_lens_is_no_longer_of_its_model(rng: np.random.Generator) -> None:
    px = rng.uniform(0, 800, (3000, 2))
    centre = np.array([400.0, 390.0])
    away = np.linalg.norm(px - centre, axis=1)
    kept = (away < 480) | (rng.random(3000) < 0.2)
    kept &= rng.random(3000) > 0.01  # some are found wrongly anywhere
    found = model_radius(px, centre, kept)
    assert found is not None and 470 < found < 490


def test_corners_found_wrongly_here_and_there_are_no_lens(rng: np.random.Generator) -> None:
    px = rng.uniform(0, 800, (3000, 2))
    assert model_radius(px, np.array([400.0, 390.0]), rng.random(3000) > 0.04) is None
    assert model_radius(px, np.array([400.0, 390.0]), np.ones(3000, bool)) is None


def test_corners_of_a_board_far_away_are_not_lost_by_being_worse_than_near_ones(
    rng: np.random.Generator,
) -> None:
    r = np.concatenate([rng.normal(0, 0.03, (800, 2)), rng.normal(0, 0.1, (200, 2)), np.full((7, 2), 2.0)])
    assert (~inlier_mask(r, 0.03)).sum() > 40
    assert count_outliers(r, 0.03, 0.5) == 7
