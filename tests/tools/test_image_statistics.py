"""Corner statistics of images with a known number of corners."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.experiments import experiment

from share.lab.emulate.world.noise import cloud

statistics = experiment("image_statistics")
HEIGHT, WIDTH = statistics.HEIGHT, statistics.WIDTH


def squares(count: int) -> np.ndarray:
    image = np.full((HEIGHT, WIDTH), 60, np.uint8)
    for k in range(count):
        x, y = 20 + 40 * (k % 15), 20 + 40 * (k // 15)
        cv2.rectangle(image, (x, y), (x + 15, y + 15), 190, -1)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), np.uint8)  # FAST leaves out ties


def test_corners_of_squares_are_counted() -> None:
    found = statistics.image_statistics(squares(15))
    assert found.fast == 60 and found.gftt == 60  # four each
    assert found.cells == 8 / 64  # one row of cells
    assert (
        statistics.image_statistics(squares(0)).fast == 0
        and statistics.image_statistics(squares(0)).cells == 0
    )


def test_brightness() -> None:
    image = np.full((HEIGHT, WIDTH), 50, np.uint8)
    image[:, 320:] = 150
    found = statistics.image_statistics(image)
    assert (found.mean, found.p5, found.p95, found.sharpness) == (100, 50, 150, 0)


def test_the_slope_of_noise_is_found() -> None:
    rng = np.random.default_rng(1)
    for slope in (0.8, 1.4):
        noise = 128 + 25 * cloud(rng, slope, size=1024)[:HEIGHT, :WIDTH]
        assert statistics.spectrum_slope(noise.clip(0, 255).astype(np.uint8)) == pytest.approx(
            slope, abs=0.12
        )


def test_only_images_of_one_size_compare() -> None:
    with pytest.raises(ValueError, match=r"expected \(480, 640\)"):
        statistics.image_statistics(np.zeros((480, 752), np.uint8))
    wide = np.arange(752, dtype=np.uint8)[None].repeat(480, 0)
    assert np.array_equal(statistics.resize_to_standard(wide), wide[:, 56:696])
    assert statistics.resize_to_standard(np.zeros((960, 1280), np.uint8)).shape == (480, 640)
    assert statistics.mean_statistics([squares(0), squares(30)]).fast == 60
