"""The four baseline error models that the paper compares its network with.

Each is a function that trains on some keyframes, stops early by others, and returns a predictor of the error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from share.array_table import ArrayTable
from share.lab.train.keyframe_table import MIN_CM, KeyframeTable
from share.lab.train.network import BestWeights
from share.types import F32, F64

TREES = 70
_BLOCKS = (2, 4)  # rows and columns of blocks of each PSD channel: 24 numbers for the forest
_EPOCHS = 100
_PATIENCE = 12
_BATCH = 256
_CNN_EPOCHS, _CNN_PATIENCE = 24, 5  # trains on pictures, so an epoch takes long
_CONTRAST_EPOCHS, _TEMPERATURE = 6, 0.1


@dataclass(frozen=True, eq=False)
class KeyframeRows(ArrayTable):
    """Keyframes with the backbone's features, deep_features (N, 1280)."""

    table: KeyframeTable
    deep_features: F32


Predictor = Callable[[KeyframeRows], F64]
ShowProgress = Callable[[str], None]  # progress, as text for the user
# of training rows, validation rows and seed
Baseline = Callable[[KeyframeRows, KeyframeRows, int, ShowProgress], Predictor]


def linear(
    training: KeyframeRows, validation: KeyframeRows, seed: int, on_progress: ShowProgress
) -> Predictor:
    """Least squares on the eight scalars."""
    from sklearn.linear_model import LinearRegression

    model = LinearRegression().fit(training.table.scalars, training.table.error_cm)
    return lambda rows: np.maximum(model.predict(rows.table.scalars), MIN_CM)


def forest(
    training: KeyframeRows, validation: KeyframeRows, seed: int, on_progress: ShowProgress
) -> Predictor:
    """Random forest on 1312 numbers: 1280 backbone features, 24 of the PSD, 8 scalars."""
    from sklearn.ensemble import RandomForestRegressor

    model = RandomForestRegressor(TREES, min_samples_leaf=3, max_features=0.3, random_state=seed, n_jobs=2)
    model.fit(forest_inputs(training), training.table.error_cm)
    model.n_jobs = 1  # a pool costs more than it gains for one keyframe
    return lambda rows: np.maximum(model.predict(forest_inputs(rows)), MIN_CM)


def perceptron(
    training: KeyframeRows, validation: KeyframeRows, seed: int, on_progress: ShowProgress
) -> Predictor:
    """Two layers on the backbone's features, so it sees the picture alone."""
    torch.manual_seed(seed)
    mean, deviation = (
        training.deep_features.mean(axis=0),
        np.maximum(training.deep_features.std(axis=0), 1e-3),
    )

    def inputs(rows: KeyframeRows) -> Tensor:
        return torch.from_numpy((rows.deep_features - mean) / deviation)

    net = nn.Sequential(nn.Dropout(0.3), nn.Linear(1280, 128), nn.ReLU(), nn.Linear(128, 1))
    _train(
        net, (inputs(training), training), (inputs(validation), validation), _EPOCHS, _PATIENCE, on_progress
    )
    return lambda rows: _predict(net, inputs(rows))


def contrastive(
    training: KeyframeRows, validation: KeyframeRows, seed: int, on_progress: ShowProgress
) -> Predictor:
    """A small CNN on the picture, trained to embed pictures of similar error close to each other (supervised
    contrastive regression, Zha et al. 2023), then to predict the error."""
    torch.manual_seed(seed)
    encoder, output_layer = _encoder(), nn.Linear(96, 1)
    net = nn.Sequential(encoder, output_layer)
    x, y = _half_size_pictures(training), torch.from_numpy(training.table.log_error)
    optimiser = torch.optim.AdamW(encoder.parameters(), 1e-3, weight_decay=0.01)
    for epoch in range(_CONTRAST_EPOCHS):
        on_progress(f"contrast, epoch {epoch + 1} of {_CONTRAST_EPOCHS}")
        for batch_rows in torch.randperm(len(x)).split(_BATCH):
            optimiser.zero_grad()
            contrastive_loss(functional.normalize(encoder(x[batch_rows]), dim=1), y[batch_rows]).backward()
            optimiser.step()
    _train(
        net,
        (x, training),
        (_half_size_pictures(validation), validation),
        _CNN_EPOCHS,
        _CNN_PATIENCE,
        on_progress,
    )
    return lambda rows: _predict(net, _half_size_pictures(rows))


BASELINES: dict[str, Baseline] = {
    "linear regression": linear,
    "random forest": forest,
    "MLP head": perceptron,
    "contrastive CNN": contrastive,
}


def forest_inputs(rows: KeyframeRows) -> F32:
    """Return (N, 1312): backbone features, block means of the PSD, scalars."""
    psd = rows.table.psd
    n, channels, down, across = psd.shape
    blocks = psd.reshape(n, channels, _BLOCKS[0], down // _BLOCKS[0], _BLOCKS[1], across // _BLOCKS[1])
    spread = blocks.mean(axis=(3, 5)).reshape(n, -1)
    return np.concatenate([rows.deep_features, spread, rows.table.scalars], axis=1)


def _half_size_pictures(rows: KeyframeRows) -> Tensor:
    """Return the pictures at half their size, (N, 1, 64, 64), in -1 .. 1."""
    x = torch.from_numpy(rows.table.picture).to(torch.float32)[:, None] / 127.5 - 1
    return functional.avg_pool2d(x, 2)


def _encoder() -> nn.Module:
    layers: list[nn.Module] = []
    for before, after in ((1, 16), (16, 32), (32, 64), (64, 96)):
        layers += [nn.Conv2d(before, after, 3, 2, 1), nn.BatchNorm2d(after), nn.ReLU()]
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten())


def contrastive_loss(z: Tensor, y: Tensor) -> Tensor:
    """Return the loss of embeddings z (B, D) of unit length with errors y (B,): each pair is contrasted with
    all samples at least as far from its anchor in y (Zha et al. 2023).

    Sorted by falling distance from the anchor, the contrast set of a pair is a prefix, so a cumulative sum
    takes B^2 log B where the direct sum takes B^3.
    """
    others = ~torch.eye(len(z), dtype=torch.bool)
    similarity = (z @ z.T / _TEMPERATURE)[others].view(len(z), -1)
    distance = (y[:, None] - y[None]).abs()[others].view(len(z), -1)
    distance, order = distance.sort(dim=1, descending=True)
    similarity = similarity.gather(1, order)
    last = torch.searchsorted(-distance, -distance, right=True) - 1
    denominators = similarity.logcumsumexp(dim=1).gather(1, last)
    return (denominators - similarity).mean()


def _train(
    net: nn.Module,
    training: tuple[Tensor, KeyframeRows],
    validation: tuple[Tensor, KeyframeRows],
    epochs: int,
    patience: int,
    on_progress: ShowProgress,
) -> None:
    """Train `net` by the Poisson deviance, as the error model; keep the weights that do best on
    `validation`."""
    optimiser = torch.optim.AdamW(net.parameters(), 1e-3, weight_decay=0.05)
    x, y = training[0], torch.from_numpy(training[1].table.error_cm)
    validation_inputs, validation_errors = validation[0], torch.from_numpy(validation[1].table.error_cm)
    best = BestWeights(net)
    for epoch in range(epochs):
        on_progress(f"epoch {epoch + 1} of {epochs} at most")
        net.train()
        for batch_rows in torch.randperm(len(x)).split(_BATCH):
            optimiser.zero_grad()
            _poisson_deviance(net(x[batch_rows])[:, 0], y[batch_rows]).backward()
            optimiser.step()
        net.eval()
        with torch.no_grad():
            validation_loss = float(
                _poisson_deviance(
                    torch.cat([net(some)[:, 0] for some in validation_inputs.split(_BATCH)]),
                    validation_errors,
                )
            )
        best.update(validation_loss)
        if best.epochs_since >= patience:
            break
    best.restore()


def _poisson_deviance(log_predicted: Tensor, error_cm: Tensor) -> Tensor:
    return (torch.exp(log_predicted) - error_cm * log_predicted).mean()


def _predict(net: nn.Module, x: Tensor) -> F64:
    with torch.no_grad():
        return np.concatenate([torch.exp(net(some)[:, 0]).numpy() for some in x.split(_BATCH)]).astype(float)
