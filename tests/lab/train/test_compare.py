"""Scores of error models against known errors, and the inputs and loss of baselines."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("torch", reason="make train-test brings it")
pytest.importorskip("onnx", reason="make train-test brings it")
pytest.importorskip("sklearn", reason="make train-test brings it")

from share.lab.train.baselines import KeyframeRows, contrastive_loss, forest_inputs
from share.lab.train.compare import score_network, score_predictions
from share.lab.train.keyframe_table import KeyframeTable
from share.lab.train.score import score_table
from share.odometry.error_model.inputs import INPUT_SHAPES, input_dtype

ERROR_CM = np.array([0.1, 0.2, 0.4, 0.8], np.float32)


def rows(error_cm=ERROR_CM) -> KeyframeRows:
    n = len(error_cm)
    table_of = KeyframeTable(
        np.zeros(n, np.int64),
        error_cm,
        *(np.zeros((n, *shape), input_dtype(name)) for name, shape in INPUT_SHAPES.items()),
    )
    return KeyframeRows(table_of, np.zeros((n, 1280), np.float32))


def test_a_perfect_prediction_has_no_error():
    perfect = score_predictions("x", ERROR_CM.astype(float), ERROR_CM)
    assert (perfect.rmse_cm, perfect.mae_cm, perfect.qoe_error) == (0, 0, 0)
    assert perfect.rank == pytest.approx(1)


def test_errors_are_scored_by_size_and_by_rank():
    off = score_predictions("x", ERROR_CM[::-1].astype(float), ERROR_CM)
    assert off.rank == pytest.approx(-1)
    assert off.rmse_cm == pytest.approx(math.sqrt((0.7**2 + 0.2**2 + 0.2**2 + 0.7**2) / 4), rel=1e-6)
    assert off.mae_cm == pytest.approx(0.45, rel=1e-6)
    assert 0 < off.qoe_error < 1
    assert score_predictions("x", np.full(4, 0.3), ERROR_CM).rank == 0  # a constant has no rank


def test_a_network_is_scored_one_keyframe_at_a_time():
    class Network:
        calls = 0

        def get_inputs(self):
            return []

        def run(self, names, inputs):
            assert inputs["picture"].shape == (1, 128, 128)
            self.calls += 1
            log = math.log(0.2)
            return [np.array([[log, log - 0.8, log + 0.8]]), np.zeros((1, 64)), np.array([0.5])]

    network = Network()
    score = score_network("ours", network, rows())
    assert network.calls == 4
    assert score.coverage == 0.75  # 0.8 cm is more than 0.2 e^0.8
    assert "| ours | " in score_table([score])
    assert "75 %" in score_table([score])


def test_the_forest_has_1312_inputs_in_order():
    one = rows()
    one.table.psd[0, 1, 7, 5] = 24.0  # in the lower half, the second of four across: of 24 cells
    numbers = forest_inputs(one)
    assert numbers.shape == (4, 1312)
    assert numbers[0, 1280 + 8 + 4 + 1] == 1
    assert numbers[0].sum() == 1


def test_contrastive_loss_is_lower_where_similar_errors_are_close():
    import torch

    y = torch.tensor([0.0, 0.1, 5.0, 5.1])
    together = torch.nn.functional.normalize(
        torch.tensor([[1.0, 0.0], [1.0, 0.1], [-1.0, 0.0], [-1.0, 0.1]]), dim=1
    )
    apart = together[[0, 2, 1, 3]]
    assert contrastive_loss(together, y) < contrastive_loss(apart, y)


def test_contrastive_loss_is_equation_1_of_zha():
    """Zha et al. 2023, over all triples; clipped errors are equal."""
    import torch

    rng = torch.Generator().manual_seed(0)
    z = torch.nn.functional.normalize(torch.randn(12, 5, generator=rng), dim=1)
    y = torch.rand(12, generator=rng).clamp(max=0.6)
    assert len(y.unique()) < 12
    alike, terms = z @ z.T / 0.1, []
    for i in range(12):
        for j in set(range(12)) - {i}:
            against = [k for k in range(12) if k != i and abs(y[i] - y[k]) >= abs(y[i] - y[j])]
            terms.append(torch.logsumexp(alike[i, against], 0) - alike[i, j])
    assert contrastive_loss(z, y) == pytest.approx(float(torch.stack(terms).mean()), rel=1e-5)
