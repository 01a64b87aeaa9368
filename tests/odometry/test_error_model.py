"""The shipped error model is small and valid, and expects larger errors where tracking is poor."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.onnx_bytes import FLOAT, field, ints, model, node, number, small_error_model, tensor, value_info
from helpers.special_files import KINDS, special

from share.errors import DataError, ShareError
from share.odometry.error_model.history import FrameOutcome, RecentMotion
from share.odometry.error_model.inputs import INPUT_SHAPES, error_model_input
from share.odometry.error_model.network import (
    MAX_ERROR_CM,
    SHIPPED_MODEL,
    ErrorEstimate,
    backbone_features,
    estimate_error,
    open_error_model,
    open_network,
    read_model,
)
from share.types import FeatureStatistics, TrackState


@pytest.fixture(scope="module")
def network():
    return open_error_model("shipped")


def estimate(
    network, found: int, inlier_count: int, sigma_cm: float, state=TrackState.OK, nis=0.3
) -> ErrorEstimate:
    rng = np.random.default_rng(7)
    image = cv2.GaussianBlur(rng.integers(0, 256, (480, 640), np.uint8), (0, 0), 2)
    px = rng.uniform(0, 470, (found, 2)).astype(np.float32)
    statistics = FeatureStatistics(
        px, np.arange(found) < inlier_count, np.full(found, 2.5), max(found, 30), 3 * found
    )
    frames = tuple(FrameOutcome(k * 66_666_667, True, state, found, inlier_count, nis) for k in range(75))
    return estimate_error(
        network, error_model_input(image, statistics, RecentMotion(frames, 2.0, 1.5, (sigma_cm,) * 12))
    )


def test_the_shipped_model_is_small(network):
    assert SHIPPED_MODEL.stat().st_size <= 6e6
    assert "MIT" in SHIPPED_MODEL.with_suffix(".md").read_text()
    assert {given.name for given in network.get_inputs()} == set(INPUT_SHAPES)


def test_a_larger_error_is_expected_where_tracking_is_poor(network):
    well = estimate(network, 80, 78, 0.4)
    unsure = estimate(network, 80, 78, 4.0)
    blind = estimate(network, 6, 2, 15.0, TrackState.INERTIAL_ONLY, nis=8.0)
    assert well.error_cm < 0.5 * unsure.error_cm < blind.error_cm
    assert 0.02 < well.error_cm < 1
    assert blind.error_cm > 3
    assert blind.high_cm <= MAX_ERROR_CM  # more is not estimate


def test_the_expected_error_lies_in_its_interval(network):
    for one in (estimate(network, 80, 78, 0.4), estimate(network, 6, 2, 15.0, TrackState.INERTIAL_ONLY)):
        assert one.low_cm < one.error_cm <= one.high_cm


def test_the_message_names_a_file_that_is_no_network(tmp_path):
    path = tmp_path / "mine.onnx"
    path.write_bytes(b"not a network")
    with pytest.raises(DataError, match=r"mine\.onnx: not a usable ONNX network"):
        open_error_model(str(path))


# ------------------------------------------------------------------ files from anywhere


def small(path: Path, **given: Any) -> Path:
    path.write_bytes(small_error_model(**given))
    return path


def test_a_minimal_network_is_accepted(tmp_path):
    assert estimate(open_error_model(str(small(tmp_path / "a.onnx"))), 80, 78, 0.4).error_cm == pytest.approx(
        1.0
    )


@pytest.mark.parametrize("says", [(np.inf, 0, 0), (np.nan, 0, 0), (0, -np.inf, 0), (1e38, -1e38, 1e38)])
def test_an_output_that_is_not_finite_is_refused(tmp_path, says):
    network = open_error_model(str(small(tmp_path / "a.onnx", says=says)))
    if np.isfinite(says).all():
        assert estimate(network, 80, 78, 0.4).error_cm == MAX_ERROR_CM
        return
    with pytest.raises(DataError, match="output for a keyframe is not finite"):
        estimate(network, 80, 78, 0.4)


BRANCH = field(1, "body") + field(6, field(1, node("Identity", ["x"], "y"))) + field(20, 5)
EXTERNAL = field(13, field(1, "location") + field(2, "../../../etc/passwd")) + field(14, 1)
LAYERS = {
    "a loop": ([node("Loop", ["n"], "y", BRANCH)], [], "one of its layers holds a graph"),
    "a loop without a body": ([node("Loop", ["n"], "y")], [], "'Loop' is not allowed in an error model"),
    "a size out of nothing": (
        [node("ConstantOfShape", ["big"], "y")],
        [ints("big", [10**12])],
        "'ConstantOfShape'",
    ),
    "of another domain": ([node("Relu", ["scalars"], "y", domain="evil")], [], "'evil.Relu'"),
    "weights elsewhere": ([], [tensor("w", [1], (), EXTERNAL)], "its weights are in other files"),
    "weights elsewhere, in a layer": (
        [node("Constant", [], "y", field(1, "value") + field(5, tensor("w", [1], (), EXTERNAL)))],
        [],
        "its weights are in other files",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LAYERS)
def test_operators_that_no_error_model_needs_are_refused(tmp_path, name):
    more, weights, says = LAYERS[name]
    with pytest.raises(DataError, match=says) as error:
        open_error_model(str(small(tmp_path / "a.onnx", more=more, weights=weights)))
    assert "\n" not in str(error.value)


def test_memory_of_a_network_is_bounded(tmp_path):
    """Two of 60,000 numbers, added row to column, are 14 GB."""
    more = [
        node("ReduceMean", ["scalars"], "mean"),
        node("Add", ["mean", "row"], "a"),
        node("Add", ["a", "column"], "b"),
        node("ReduceMax", ["b"], "most", number("keepdims", 0)),
        node("Add", ["said", "most"], "log_error"),
    ]

    def made(long: int) -> str:
        weights = [tensor("row", [1, long], [0.0] * long), tensor("column", [long, 1], [0.0] * long)]
        return str(small(tmp_path / f"{long}.onnx", more=more, weights=weights, first="said"))

    assert open_error_model(made(60))
    with pytest.raises(DataError, match=r"not an error model: .*Add"):
        open_error_model(made(60_000))


def test_a_truncated_or_other_file_is_refused(tmp_path):
    whole = small(tmp_path / "a.onnx").read_bytes()
    for k in (0, 1, 5, 100, len(whole) // 2, len(whole) - 1):
        (tmp_path / "b.onnx").write_bytes(whole[:k])
        with pytest.raises(DataError, match="not a"):
            open_error_model(str(tmp_path / "b.onnx"))
    (tmp_path / "c.onnx").write_bytes(
        model([node("Relu", ["x"], "y")], [], [value_info("x", FLOAT, [1])], [value_info("y", FLOAT, [1])])
    )
    with pytest.raises(DataError, match="not an error model: its inputs are x, expected"):
        open_error_model(str(tmp_path / "c.onnx"))
    with pytest.raises(DataError, match="has no backbone"):
        backbone_features(open_network((tmp_path / "c.onnx").read_bytes()), np.zeros((2, 128, 128), np.uint8))


@pytest.mark.parametrize("kind", [*KINDS, "huge"])
def test_a_model_that_is_no_regular_file_is_refused(tmp_path, kind):
    path = tmp_path / "a.onnx"
    if kind == "huge":
        with path.open("wb") as file:
            file.truncate(10**12)
    else:
        special(path, kind)
    began = time.process_time()
    with pytest.raises(ShareError, match=r"not a regular file|the limit for this kind is"):
        read_model(path)
    assert time.process_time() - began < 5
