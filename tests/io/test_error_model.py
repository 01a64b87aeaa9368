"""The error model that comes with SHARE: small, whole, and it expects more of a tracker that fares badly."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from share.errors import DataError
from share.evaluator.features import SHAPES, features
from share.evaluator.model import MOST_CM, Estimate, estimate
from share.evaluator.odometer import Fared, Lately
from share.io.network import SHIPPED, error_model
from share.types import Footing, TrackState


@pytest.fixture(scope="module")
def network():
    return error_model("shipped")


def told(network, found: int, believed: int, sigma_cm: float, state=TrackState.OK, surprise=0.3) -> Estimate:
    rng = np.random.default_rng(7)
    image = cv2.GaussianBlur(rng.integers(0, 256, (480, 640), np.uint8), (0, 0), 2)
    px = rng.uniform(0, 470, (found, 2)).astype(np.float32)
    footing = Footing(px, np.arange(found) < believed, np.full(found, 2.5), max(found, 30), 3 * found)
    frames = tuple(Fared(k * 66_666_667, True, state, found, believed, surprise) for k in range(75))
    return estimate(network, features(image, footing, Lately(frames, 2.0, 1.5, (sigma_cm,) * 12)))


def test_it_is_there_and_small(network):
    assert SHIPPED.stat().st_size <= 6e6
    assert "MIT" in SHIPPED.with_suffix(".md").read_text()
    assert {given.name for given in network.get_inputs()} == set(SHAPES)


def test_it_expects_more_where_the_tracker_fares_badly(network):
    well = told(network, 80, 78, 0.4)
    unsure = told(network, 80, 78, 4.0)
    blind = told(network, 6, 2, 15.0, TrackState.INERTIAL_ONLY, surprise=8.0)
    assert well.error_cm < 0.5 * unsure.error_cm < blind.error_cm
    assert 0.02 < well.error_cm < 1
    assert blind.error_cm > 3
    assert blind.high_cm <= MOST_CM  # more is not told


def test_what_it_expects_lies_in_its_interval(network):
    for one in (told(network, 80, 78, 0.4), told(network, 6, 2, 15.0, TrackState.INERTIAL_ONLY)):
        assert one.low_cm < one.error_cm <= one.high_cm


def test_a_file_that_is_no_network_is_named(tmp_path):
    path = tmp_path / "mine.onnx"
    path.write_bytes(b"not a network")
    with pytest.raises(DataError, match=r"mine\.onnx: is no network"):
        error_model(str(path))
