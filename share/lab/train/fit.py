"""Teaching the network: epochs until it gets no better on rooms that it does not learn from."""

from __future__ import annotations

import dataclasses
import io
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from share.errors import DataError
from share.files.reading import MB, read_bytes
from share.files.writing import atomic_write
from share.lab.train.network import Heads, loss
from share.types import F32

_MOST_BYTES = 200 * MB  # of a checkpoint: four heads and their moments have 5
Show = Callable[[int, float, float], None]  # epoch, loss where it learns, loss where it stops


@dataclass(frozen=True)
class FitOptions:
    """epochs at most; patience: without a gain, after which it ends. dropout: of what the backbone
    says, since rooms are few, and many pictures are of the same one. heads: whose mean is told."""

    epochs: int = 200
    patience: int = 25
    batch: int = 256
    rate: float = 1e-3
    decay: float = 0.05
    dropout: float = 0.9
    heads: int = 4
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Inputs:
    """Of N keyframes: deep (N, 1280), by the backbone; psd as in `Features`; numbers (N, 22), its scalars
    and recent; log_error (N,)."""

    deep: F32
    psd: F32
    numbers: F32
    log_error: F32

    def tensors(self, device: torch.device) -> list[torch.Tensor]:
        """In this order."""
        return [torch.from_numpy(column).to(device) for column in self._columns()]

    @property
    def crc(self) -> int:
        """The same for the same keyframes."""
        return zlib.crc32(b"".join(column.tobytes() for column in self._columns()))

    def _columns(self) -> list[F32]:
        return [np.ascontiguousarray(getattr(self, f.name)) for f in dataclasses.fields(self)]


@dataclass
class _Progress:
    epoch: int = 0
    best: float = float("inf")
    best_epoch: int = 0


def fit(learn: Inputs, stop: Inputs, options: FitOptions, checkpoint: Path | None, show: Show) -> Heads:
    """The heads that do best on `stop`. checkpoint: a file to go on from, if it is of the same keyframes and
    options, and to keep what has been learnt in, each epoch. On a GPU where there is one."""
    torch.manual_seed(options.seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    heads = Heads(options.heads, options.dropout)
    heads.to(device)
    optimiser = torch.optim.AdamW(heads.parameters(), options.rate, weight_decay=options.decay)
    at, best = _Progress(), _copy(heads)
    what = {**dataclasses.asdict(options), "learn": learn.crc, "stop": stop.crc}
    if checkpoint is not None and checkpoint.is_file():
        try:
            kept = torch.load(
                io.BytesIO(read_bytes(checkpoint, _MOST_BYTES)), map_location=device, weights_only=True
            )
            if kept["what"] == what:
                heads.load_state_dict(kept["heads"])
                optimiser.load_state_dict(kept["optimiser"])
                at, best = _Progress(**kept["at"]), kept["best"]
        except Exception as error:  # torch, pickle and zip each have their own
            raise DataError(f"{checkpoint}: is damaged; remove it to begin anew ({error!r:.200})") from None
    rows, checked = learn.tensors(device), stop.tensors(device)
    while at.epoch < options.epochs and at.epoch - at.best_epoch < options.patience:
        learnt = _epoch(heads, optimiser, rows, options, at.epoch)
        stopped = _evaluated(heads, checked)
        at.epoch += 1
        if stopped < at.best:
            at.best, at.best_epoch, best = stopped, at.epoch, _copy(heads)
        show(at.epoch, learnt, stopped)
        if checkpoint is not None:
            _keep(checkpoint, what, heads, optimiser, at, best)
    heads.load_state_dict(best)
    heads.cpu().eval()
    return heads


def _epoch(
    heads: Heads, optimiser: torch.optim.Optimizer, rows: list[torch.Tensor], options: FitOptions, epoch: int
) -> float:
    """In an order that the seed and the epoch decide, so that a run that goes on goes on as it would have."""
    heads.train()
    torch.manual_seed(options.seed * 100_003 + epoch)
    order, total = torch.randperm(len(rows[0])), 0.0
    for which in order.split(options.batch):
        *inputs, log_error = (column[which.to(column.device)] for column in rows)
        optimiser.zero_grad()
        value = loss(heads(*inputs), log_error)
        (options.heads * value).backward()  # each learns as it would alone
        for head in heads.each:
            torch.nn.utils.clip_grad_norm_(head.parameters(), 1.0)
        optimiser.step()
        total += value.item() * len(which)
    return total / len(order)


def _evaluated(heads: Heads, rows: list[torch.Tensor]) -> float:
    heads.eval()
    with torch.no_grad():
        return float(loss(heads(*rows[:-1]).mean(dim=0), rows[-1]))


def _copy(heads: Heads) -> dict[str, torch.Tensor]:
    return {name: value.detach().cpu().clone() for name, value in heads.state_dict().items()}


def _keep(
    path: Path,
    what: dict[str, Any],
    heads: Heads,
    optimiser: torch.optim.Optimizer,
    at: _Progress,
    best: dict[str, torch.Tensor],
) -> None:
    data = io.BytesIO()
    torch.save(
        {
            "what": what,
            "heads": heads.state_dict(),
            "optimiser": optimiser.state_dict(),
            "at": dataclasses.asdict(at),
            "best": best,
        },
        data,
    )
    atomic_write(path, data.getvalue())
