"""The heads of the error model in torch, and their loss.

Three branches are joined: backbone features of the picture, the distribution of feature points (PSD), and
scalars. Source: SHARE, IMWUT 10(3) 97, 2026; scalars of the last seconds are added here
(docs/understand/error-model.md).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from share.odometry.error_model.inputs import RECENT_NAMES, SCALAR_NAMES

DEEP_SIZE, EMBEDDING_SIZE, JOINED_SIZE = 1280, 64, 96
NUMBERS_SIZE = len(SCALAR_NAMES) + len(RECENT_NAMES)
LOW_QUANTILE, HIGH_QUANTILE = 0.05, 0.95


class Head(nn.Module):  # type: ignore[misc]
    """Map deep (N, 1280), psd (N, 3, 12, 16) and numbers (N, 22: scalars, recent) to the log error in cm (N,
    3): expected, low, high.

    A linear skip connection leads from numbers to the expected log error: many are logarithms of factors of
    the error, so it extrapolates beyond the training data.
    """

    def __init__(self, dropout: float = 0.0) -> None:
        super().__init__()
        self.dropout = nn.Dropout(dropout)
        self.visual = nn.Sequential(
            nn.Linear(DEEP_SIZE, EMBEDDING_SIZE), nn.ReLU(), nn.LayerNorm(EMBEDDING_SIZE)
        )
        self.spread = nn.Sequential(
            nn.Conv2d(3, 8, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(8, 16, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d(1),
            nn.Flatten(),
        )
        self.numbers = nn.Sequential(nn.Linear(NUMBERS_SIZE, 16), nn.ReLU())
        self.joined = nn.Sequential(nn.Linear(JOINED_SIZE, 48), nn.ReLU(), nn.Linear(48, 3))
        self.straight = nn.Linear(NUMBERS_SIZE, 1)

    def join(self, deep: Tensor, psd: Tensor, numbers: Tensor) -> Tensor:
        """Return the joined branches (N, 96)."""
        branches = (self.visual(self.dropout(deep)), self.spread(psd), self.numbers(numbers))
        return torch.cat(branches, dim=1)

    def forward(self, deep: Tensor, psd: Tensor, numbers: Tensor) -> Tensor:
        expected, below, above = self.joined(self.join(deep, psd, numbers)).unbind(dim=1)
        expected = expected + self.straight(numbers)[:, 0]
        low, high = expected - functional.softplus(below), expected + functional.softplus(above)
        return torch.stack([expected, low, high], dim=1)


class Heads(nn.Module):  # type: ignore[misc]
    """An ensemble of heads with different initial weights, whose mean errs less than each (deep ensembles,
    Lakshminarayanan et al. 2017)."""

    def __init__(self, count: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.each = nn.ModuleList(Head(dropout) for _ in range(count))

    def join(self, deep: Tensor, psd: Tensor, numbers: Tensor) -> Tensor:
        """Return the joined branches (N, 96) of the first head."""
        joined: Tensor = self.each[0].join(deep, psd, numbers)
        return joined

    def forward(self, deep: Tensor, psd: Tensor, numbers: Tensor) -> Tensor:
        """Return the outputs (H, N, 3) of all heads."""
        return torch.stack([head(deep, psd, numbers) for head in self.each])


def loss(predicted: Tensor, log_error: Tensor) -> Tensor:
    """Return the loss of predicted (..., N, 3), as of `Head`, for log_error (N,) in log cm.

    The expected error is fitted by the Poisson deviance: its minimum is the mean, and it weighs large errors
    more than a logarithm and less than a square would. The interval is fitted by the pinball loss of its
    quantiles.
    """
    expected, low, high = predicted.unbind(dim=-1)
    deviance = torch.exp(expected) - torch.exp(log_error) * expected
    return (
        deviance.mean()
        + _pinball_loss(log_error - low, LOW_QUANTILE)
        + _pinball_loss(log_error - high, HIGH_QUANTILE)
    )


def _pinball_loss(excess: Tensor, quantile: float) -> Tensor:
    """Quantile regression, Koenker and Bassett 1978."""
    return torch.maximum(quantile * excess, (quantile - 1) * excess).mean()
