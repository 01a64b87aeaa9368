"""Trained heads: standardisation folded in, intervals calibrated, distance from the training data, file."""

from __future__ import annotations

import numpy as np
import pytest

from share.errors import DataError
from share.lab.train.trained_heads import (
    TrainedHeads,
    conformal_margin,
    fold_standardisation,
    mahalanobis_scale,
    read_trained,
    write_trained,
)


def test_standardisation_is_folded_into_the_next_layer(rng):
    W, b = rng.standard_normal((5, 3)).astype(np.float32), rng.standard_normal(5).astype(np.float32)
    mean, deviation = rng.standard_normal(3).astype(np.float32), rng.uniform(0.1, 3, 3).astype(np.float32)
    x = rng.standard_normal((20, 3)).astype(np.float32)
    new = fold_standardisation({"a.weight": W, "a.bias": b, "other": b}, "a", mean, deviation)
    assert x @ new["a.weight"].T + new["a.bias"] == pytest.approx((x - mean) / deviation @ W.T + b, abs=1e-4)
    assert new["other"] is b


def test_the_margin_gives_intervals_their_stated_coverage(rng):
    """90 % of new errors of the same distribution, however wide the intervals were."""
    for scale in (0.3, 1.0, 3.0):
        y = rng.standard_normal((2, 20_000))
        intervals = np.tile([0.0, -scale, scale], (y.shape[1], 1))
        wider = conformal_margin(intervals, y[0])
        assert np.mean(np.abs(y[1]) <= scale + wider) == pytest.approx(0.9, abs=0.01)


def test_the_margin_of_few_errors_is_the_largest():
    """With nine errors: nothing smaller covers nine of ten."""
    y = np.arange(9.0)
    assert conformal_margin(np.zeros((9, 3)), y) == 8


def test_inputs_like_the_training_data_are_near(rng):
    mixing = rng.standard_normal((96, 96))
    training, calibrated, new = (rng.standard_normal((4000, 96)) @ mixing for _ in range(3))
    mean, whitening = mahalanobis_scale(training, calibrated)
    away = np.linalg.norm((new - mean) @ whitening, axis=1)
    assert np.mean(away > 1) == pytest.approx(0.01, abs=0.006)
    strange = np.linalg.norm((3 * new - mean) @ whitening, axis=1)
    assert np.mean(strange > 1) > 0.99


def test_written_heads_are_read(tmp_path, rng):
    weights = {"a.weight": rng.standard_normal((2, 3)).astype(np.float32)}
    heads = [weights, {"a.weight": 2 * weights["a.weight"]}]
    whole = TrainedHeads(
        heads, 0.25, np.zeros(96, np.float32), np.eye(96, dtype=np.float32), {"version": "1"}
    )
    write_trained(tmp_path / "fit.npz", whole)
    found = read_trained(tmp_path / "fit.npz")
    assert found.margin == 0.25
    assert found.about == {"version": "1"}
    assert [list(one) for one in found.heads] == [["a.weight"], ["a.weight"]]
    assert (found.heads[0]["a.weight"] == weights["a.weight"]).all()
    assert (found.heads[1]["a.weight"] == 2 * weights["a.weight"]).all()
    (tmp_path / "fit.npz").write_bytes(b"no")
    with pytest.raises(DataError, match=r"fit\.npz: not a file of `share train fit`, or damaged"):
        read_trained(tmp_path / "fit.npz")
