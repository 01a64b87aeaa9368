"""The ONNX model gives the outputs of the network in torch."""

from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="make train-test brings it")
onnx = pytest.importorskip("onnx", reason="make train-test brings it")

from helpers.made_features import made_features  # noqa: E402
from helpers.tiny_backbone import tiny_backbone  # noqa: E402

from share.lab.train.network import Heads, backbone_id, loss, with_heads  # noqa: E402  # noqa: E402
from share.lab.train.trained_heads import TrainedHeads  # noqa: E402
from share.odometry.error_model.inputs import ErrorModelInput  # noqa: E402
from share.odometry.error_model.network import (  # noqa: E402
    backbone_features,
    estimate_error,
    open_network,
)


@pytest.fixture
def heads() -> Heads:
    torch.manual_seed(3)
    return Heads(3).eval()


def fitted(heads: Heads, margin: float = 0.2, reach: float = 4.0) -> TrainedHeads:
    weights = [{name: value.numpy() for name, value in one.state_dict().items()} for one in heads.each]
    return TrainedHeads(
        weights, margin, np.zeros(96, np.float32), np.eye(96, dtype=np.float32) / reach, {"version": "x"}
    )


def keyframes(rng, n: int = 7) -> list[ErrorModelInput]:
    return [made_features(rng) for _ in range(n)]


@pytest.mark.long
def test_the_model_gives_the_mean_of_the_heads(heads, rng):
    network = open_network(with_heads(tiny_backbone(), fitted(heads)))
    for one in keyframes(rng):
        deep = torch.from_numpy(backbone_features(network, one.picture[None]))
        numbers = np.concatenate([one.scalars, one.recent])
        with torch.no_grad():
            inputs = deep, torch.from_numpy(one.psd[None].copy()), torch.from_numpy(numbers[None])
            expected, low, high = heads(*inputs).mean(dim=0)[0].tolist()
            joined = heads.join(*inputs)[0].numpy()
        estimate = estimate_error(network, one)
        assert math.log(estimate.error_cm) == pytest.approx(expected, abs=1e-4)
        assert estimate.embedding == pytest.approx(joined[:64], abs=1e-4)
        is_unfamiliar = np.linalg.norm(joined) > 4
        assert estimate.out_of_distribution == is_unfamiliar
        wider = 2 if is_unfamiliar else 1
        lower = expected - wider * (expected - low + 0.2)
        assert math.log(estimate.low_cm) == pytest.approx(lower, abs=1e-4)
        assert math.log(estimate.high_cm) == pytest.approx(
            expected + wider * (high - expected + 0.2), abs=1e-4
        )


@pytest.mark.long
def test_new_heads_replace_the_old_ones(heads, rng):
    first = with_heads(tiny_backbone(), fitted(heads))
    torch.manual_seed(4)
    other = fitted(Heads(1).eval())
    again = with_heads(first, other)
    assert again == with_heads(tiny_backbone(), other)
    assert backbone_id(first) == backbone_id(again) == backbone_id(tiny_backbone())
    (one,) = keyframes(rng, 1)
    estimate = [estimate_error(open_network(model), one).error_cm for model in (first, again)]
    assert estimate[0] != estimate[1]


def test_an_interval_shrinks_to_zero_width_at_most(heads, rng):
    network = open_network(with_heads(tiny_backbone(), fitted(heads, margin=-50.0, reach=1e6)))
    (one,) = keyframes(rng, 1)
    estimate = estimate_error(network, one)
    assert estimate.low_cm == pytest.approx(estimate.error_cm) == estimate.high_cm


@pytest.mark.long
def test_the_loss_is_least_at_the_mean_and_the_quantiles(rng):
    y = torch.from_numpy(rng.lognormal(0.0, 0.8, 20_000))
    estimate = torch.tensor([0.0, -0.5, 0.5], requires_grad=True)
    optimiser = torch.optim.LBFGS([estimate], max_iter=200, line_search_fn="strong_wolfe")

    def closure():
        optimiser.zero_grad()
        value = loss(estimate.expand(len(y), 3), torch.log(y))
        value.backward()
        return value

    optimiser.step(closure)
    expected, low, high = estimate.tolist()
    assert math.exp(expected) == pytest.approx(float(y.mean()), rel=0.01)
    assert math.exp(low) == pytest.approx(float(y.quantile(0.05)), rel=0.03)
    assert math.exp(high) == pytest.approx(float(y.quantile(0.95)), rel=0.03)
