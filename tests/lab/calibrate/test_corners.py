"""Robust statistics of corner residuals."""

import numpy as np

from share.lab.calibrate.corners import count_outliers, inlier_mask, model_radius


def test_the_radius_beyond_which_the_lens_model_does_not_fit(rng: np.random.Generator) -> None:
    px = rng.uniform(0, 800, (3000, 2))
    centre = np.array([400.0, 390.0])
    away = np.linalg.norm(px - centre, axis=1)
    kept = (away < 480) | (rng.random(3000) < 0.2)
    kept &= rng.random(3000) > 0.01  # scattered outliers
    found = model_radius(px, centre, kept)
    assert found is not None and 470 < found < 490


def test_scattered_outliers_give_no_radius(rng: np.random.Generator) -> None:
    px = rng.uniform(0, 800, (3000, 2))
    assert model_radius(px, np.array([400.0, 390.0]), rng.random(3000) > 0.04) is None
    assert model_radius(px, np.array([400.0, 390.0]), np.ones(3000, bool)) is None


def test_distant_corners_are_not_outliers_beside_more_precise_near_ones(
    rng: np.random.Generator,
) -> None:
    r = np.concatenate([rng.normal(0, 0.03, (800, 2)), rng.normal(0, 0.1, (200, 2)), np.full((7, 2), 2.0)])
    assert (~inlier_mask(r, 0.03)).sum() > 40
    assert count_outliers(r, 0.03, 0.5) == 7
