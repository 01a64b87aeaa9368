"""What else could estimate the error of a keyframe: the four that the paper compares its network with.

Each is a function: taught on some keyframes, stopped by others, it says what error it expects of new ones;
meanwhile how far it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from share.columns import Columns
from share.lab.train.table import Table
from share.types import F32, F64

TREES = 70
_BLOCKS = (2, 4)  # down and across, of each channel of a PSD: 24 numbers for the forest
_LEAST_CM = 0.01
_EPOCHS, _PATIENCE, _BATCH = 100, 12, 256
_CNN_EPOCHS, _CNN_PATIENCE = 24, 5  # each takes long: it sees pictures, where the others see what is known
_CONTRAST_EPOCHS, _TEMPERATURE = 6, 0.1


@dataclass(frozen=True, eq=False)
class Rows(Columns):
    """Keyframes, and deep (N, 1280) of each by the backbone."""

    table: Table
    deep: F32


Tell = Callable[[Rows], F64]
Say = Callable[[str], None]  # how far it is, for a person
Rival = Callable[[Rows, Rows, int, Say], Tell]  # learnt from, stopped by, seed


def linear(learn: Rows, stop: Rows, seed: int, say: Say) -> Tell:
    """Least squares on the eight scalars."""
    from sklearn.linear_model import LinearRegression

    model = LinearRegression().fit(learn.table.scalars, learn.table.error_cm)
    return lambda rows: np.maximum(model.predict(rows.table.scalars), _LEAST_CM)


def forest(learn: Rows, stop: Rows, seed: int, say: Say) -> Tell:
    """70 trees on 1312 numbers: 1280 of the backbone, 24 of the PSD, 8 scalars."""
    from sklearn.ensemble import RandomForestRegressor

    model = RandomForestRegressor(TREES, min_samples_leaf=3, max_features=0.3, random_state=seed, n_jobs=2)
    model.fit(_numbers(learn), learn.table.error_cm)
    model.n_jobs = 1  # one keyframe at a time is not worth a pool
    return lambda rows: np.maximum(model.predict(_numbers(rows)), _LEAST_CM)


def perceptron(learn: Rows, stop: Rows, seed: int, say: Say) -> Tell:
    """A head of two layers on the backbone, which sees the picture and nothing else."""
    torch.manual_seed(seed)
    mean, deviation = learn.deep.mean(axis=0), np.maximum(learn.deep.std(axis=0), 1e-3)

    def inputs(rows: Rows) -> Tensor:
        return torch.from_numpy((rows.deep - mean) / deviation)

    net = nn.Sequential(nn.Dropout(0.3), nn.Linear(1280, 128), nn.ReLU(), nn.Linear(128, 1))
    _teach(net, (inputs(learn), learn), (inputs(stop), stop), _EPOCHS, _PATIENCE, say)
    return lambda rows: _told(net, inputs(rows))


def contrastive(learn: Rows, stop: Rows, seed: int, say: Say) -> Tell:
    """A small CNN of its own on the picture: first taught to put pictures of like errors side by side
    (supervised contrast, the nearer in error the more alike; Zha et al. 2023), then to tell the error."""
    torch.manual_seed(seed)
    encoder, tell = _encoder(), nn.Linear(96, 1)
    net = nn.Sequential(encoder, tell)
    x, y = _pictures(learn), torch.from_numpy(learn.table.log_error)
    optimiser = torch.optim.AdamW(encoder.parameters(), 1e-3, weight_decay=0.01)
    for epoch in range(_CONTRAST_EPOCHS):
        say(f"contrast, epoch {epoch + 1} of {_CONTRAST_EPOCHS}")
        for which in torch.randperm(len(x)).split(_BATCH):
            optimiser.zero_grad()
            _contrast(functional.normalize(encoder(x[which]), dim=1), y[which]).backward()
            optimiser.step()
    _teach(net, (x, learn), (_pictures(stop), stop), _CNN_EPOCHS, _CNN_PATIENCE, say)
    return lambda rows: _told(net, _pictures(rows))


RIVALS: dict[str, Rival] = {
    "linear regression": linear,
    "random forest": forest,
    "MLP head": perceptron,
    "contrastive CNN": contrastive,
}


def _numbers(rows: Rows) -> F32:
    """(N, 1312)."""
    psd = rows.table.psd
    n, channels, down, across = psd.shape
    blocks = psd.reshape(n, channels, _BLOCKS[0], down // _BLOCKS[0], _BLOCKS[1], across // _BLOCKS[1])
    spread = blocks.mean(axis=(3, 5)).reshape(n, -1)
    return np.concatenate([rows.deep, spread, rows.table.scalars], axis=1)


def _pictures(rows: Rows) -> Tensor:
    """Half as large: (N, 1, 64, 64)."""
    x = torch.from_numpy(rows.table.picture).to(torch.float32)[:, None] / 127.5 - 1
    return functional.avg_pool2d(x, 2)


def _encoder() -> nn.Module:
    layers: list[nn.Module] = []
    for before, after in ((1, 16), (16, 32), (32, 64), (64, 96)):
        layers += [nn.Conv2d(before, after, 3, 2, 1), nn.BatchNorm2d(after), nn.ReLU()]
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten())


def _contrast(z: Tensor, y: Tensor) -> Tensor:
    """z (B, D) of length 1, y (B,): of each pair, against all that are as far from the first in y or further.

    Of anchor i, all others in falling order of that: then those against which j stands are the ones up to j,
    and to the last that is as far as j. So it takes B^2 log B, where the sum as it is written takes B^3.
    """
    others = ~torch.eye(len(z), dtype=torch.bool)
    alike = (z @ z.T / _TEMPERATURE)[others].view(len(z), -1)
    apart = (y[:, None] - y[None]).abs()[others].view(len(z), -1)
    apart, order = apart.sort(dim=1, descending=True)
    alike = alike.gather(1, order)
    last = torch.searchsorted(-apart, -apart, right=True) - 1
    against = alike.logcumsumexp(dim=1).gather(1, last)
    return (against - alike).mean()


def _teach(
    net: nn.Module,
    learn: tuple[Tensor, Rows],
    stop: tuple[Tensor, Rows],
    epochs: int,
    patience: int,
    say: Say,
) -> None:
    """By the Poisson deviance, as ours, until it gets no better where it stops."""
    optimiser = torch.optim.AdamW(net.parameters(), 1e-3, weight_decay=0.05)
    x, y = learn[0], torch.from_numpy(learn[1].table.error_cm)
    seen, wanted = stop[0], torch.from_numpy(stop[1].table.error_cm)
    best, kept, since = float("inf"), _copy(net), 0
    for epoch in range(epochs):
        say(f"epoch {epoch + 1} of {epochs} at most")
        net.train()
        for which in torch.randperm(len(x)).split(_BATCH):
            optimiser.zero_grad()
            _deviance(net(x[which])[:, 0], y[which]).backward()
            optimiser.step()
        net.eval()
        with torch.no_grad():
            now = float(_deviance(torch.cat([net(some)[:, 0] for some in seen.split(_BATCH)]), wanted))
        since += 1
        if now < best:
            best, kept, since = now, _copy(net), 0
        if since >= patience:
            break
    net.load_state_dict(kept)
    net.eval()


def _deviance(log_told: Tensor, error_cm: Tensor) -> Tensor:
    return (torch.exp(log_told) - error_cm * log_told).mean()


def _told(net: nn.Module, x: Tensor) -> F64:
    with torch.no_grad():
        return np.concatenate([torch.exp(net(some)[:, 0]).numpy() for some in x.split(_BATCH)]).astype(float)


def _copy(net: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in net.state_dict().items()}
