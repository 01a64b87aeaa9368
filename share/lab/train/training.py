"""Train the heads on labels: standardise inputs, train until the validation rooms gain no more, calibrate
intervals, estimate the training domain."""

from __future__ import annotations

import dataclasses
import io
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from share import __version__
from share.errors import DataError
from share.files.reading import MB, read_bytes
from share.files.writing import atomic_write
from share.lab.train.keyframe_table import LabelCollection
from share.lab.train.network import BestWeights, Heads, loss
from share.lab.train.trained_heads import (
    TrainedHeads,
    conformal_margin,
    fold_standardisation,
    mahalanobis_scale,
)
from share.metrics.local_error import WINDOW_S
from share.types import F32

_MIN_DEVIATION = 1e-3  # least deviation of an input
_MAX_BYTES = 200 * MB  # of a checkpoint; four heads and their moments take 5 MB
ShowEpoch = Callable[[int, float, float], None]  # epoch, training loss, validation loss


def train_model(
    collection: LabelCollection,
    deep_features: F32,
    backbone: str,
    options: TrainingOptions,
    checkpoint: Path | None,
    on_epoch: ShowEpoch,
) -> TrainedHeads:
    """Return the heads trained on the collection. deep_features (N, 1280): of the table's pictures, by the
    backbone with the id `backbone` (`network.backbone_id`)."""
    scale = Standardiser(deep_features, collection)
    parts = {name: scale.inputs(name) for name in collection.parts}
    heads = train_heads(parts["train"], parts["validate"], options, checkpoint, on_epoch)
    with torch.no_grad():
        joined = {name: heads.join(*_tensors(parts[name])).numpy() for name in ("train", "calibrate")}
        calibrated = heads(*_tensors(parts["calibrate"])).mean(dim=0).numpy()
    about = {
        "version": __version__,
        "window_s": WINDOW_S,
        "backbone": backbone,
        "options": asdict(options),
        "rooms": {
            name: sorted({str(collection.abouts[run]["session"]) for run in runs.tolist()})
            for name, runs in collection.parts.items()
        },
        "keyframes": {name: len(part.log_error) for name, part in parts.items()},
    }
    return TrainedHeads(
        [_folded_weights(head, scale) for head in heads.each],
        conformal_margin(calibrated, parts["calibrate"].log_error),
        *mahalanobis_scale(joined["train"], joined["calibrate"]),
        about,
    )


def _folded_weights(head: torch.nn.Module, scale: Standardiser) -> dict[str, F32]:
    """Return the head's weights for inputs that are not standardised."""
    weights = {name: value.numpy() for name, value in head.state_dict().items()}
    weights = fold_standardisation(weights, "visual.0", *scale.deep_moments)
    for layer in ("numbers.0", "skip"):
        weights = fold_standardisation(weights, layer, *scale.number_moments)
    return weights


class Standardiser:
    """Scales inputs to mean 0 and deviation 1 over the training part."""

    def __init__(self, deep: F32, collection: LabelCollection) -> None:
        self._deep_features, self._collection = deep, collection
        is_training = collection.keyframes_of("train")
        self.deep_moments = _mean_and_deviation(deep[is_training])
        self.number_moments = _mean_and_deviation(collection.table.numbers[is_training])

    def inputs(self, part: str) -> Inputs:
        rows, table = self._collection.keyframes_of(part), self._collection.table
        return Inputs(
            _standardised(self._deep_features[rows], *self.deep_moments),
            table.psd[rows],
            _standardised(table.numbers[rows], *self.number_moments),
            table.log_error[rows],
        )


def _mean_and_deviation(x: F32) -> tuple[F32, F32]:
    return x.mean(axis=0), np.maximum(x.std(axis=0), _MIN_DEVIATION)


def _standardised(x: F32, mean: F32, deviation: F32) -> F32:
    out: F32 = (x - mean) / deviation
    return out


def _tensors(inputs: Inputs) -> list[torch.Tensor]:
    return inputs.tensors(torch.device("cpu"))[:-1]


# Optimisation of the heads.


@dataclass(frozen=True)
class TrainingOptions:
    """epochs: at most. patience: epochs without a gain before training stops. dropout: of backbone features,
    since there are few rooms and many pictures of each. heads: number of heads; their mean is the prediction.
    """

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
    """Inputs of N keyframes: deep_features (N, 1280); psd as in `ErrorModelInput`; numbers (N, 22), scalars
    and recent; log_error (N,)."""

    deep_features: F32
    psd: F32
    numbers: F32
    log_error: F32

    def tensors(self, device: torch.device) -> list[torch.Tensor]:
        """Return the arrays as tensors, in the order of the fields."""
        return [torch.from_numpy(column).to(device) for column in self._columns()]

    @property
    def crc(self) -> int:
        """Return a checksum of the arrays."""
        return zlib.crc32(b"".join(column.tobytes() for column in self._columns()))

    def _columns(self) -> list[F32]:
        return [np.ascontiguousarray(getattr(self, f.name)) for f in dataclasses.fields(self)]


def train_heads(
    training: Inputs, validation: Inputs, options: TrainingOptions, checkpoint: Path | None, show: ShowEpoch
) -> Heads:
    """Return the heads that do best on `validation`. checkpoint: written after each epoch; resumed from if it
    has the same inputs and options. Uses a GPU if there is one."""
    torch.manual_seed(options.seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    heads = Heads(options.heads, options.dropout)
    heads.to(device)
    optimiser = torch.optim.AdamW(heads.parameters(), options.rate, weight_decay=options.decay)
    epoch, best = 0, BestWeights(heads)
    identity = {**asdict(options), "train": training.crc, "validate": validation.crc}
    if checkpoint is not None and checkpoint.is_file():
        try:
            saved = torch.load(
                io.BytesIO(read_bytes(checkpoint, _MAX_BYTES)), map_location=device, weights_only=True
            )
            if saved["identity"] == identity:
                heads.load_state_dict(saved["heads"])
                optimiser.load_state_dict(saved["optimiser"])
                epoch, best.weights = saved["epoch"], saved["best"]
                best.loss, best.epochs_since = saved["loss"], saved["epochs_since"]
        except Exception as error:  # torch, pickle and zip raise types of their own
            raise DataError(f"{checkpoint}: is damaged; remove it to start again ({error!r:.200})") from None
    rows, validation_tensors = training.tensors(device), validation.tensors(device)
    while epoch < options.epochs and best.epochs_since < options.patience:
        training_loss = _train_epoch(heads, optimiser, rows, options, epoch)
        validation_loss = _validation_loss(heads, validation_tensors)
        epoch += 1
        best.update(validation_loss)
        show(epoch, training_loss, validation_loss)
        if checkpoint is not None:
            data = io.BytesIO()
            progress = {"epoch": epoch, "loss": best.loss, "epochs_since": best.epochs_since}
            states = {"heads": heads.state_dict(), "optimiser": optimiser.state_dict(), "best": best.weights}
            torch.save({"identity": identity} | progress | states, data)
            atomic_write(checkpoint, data.getvalue())
    best.restore()
    heads.cpu()
    return heads


def _train_epoch(
    heads: Heads,
    optimiser: torch.optim.Optimizer,
    rows: list[torch.Tensor],
    options: TrainingOptions,
    epoch: int,
) -> float:
    """Train one epoch and return its loss. Seed and epoch decide the order, so that a resumed run gives the
    same result."""
    heads.train()
    torch.manual_seed(options.seed * 100_003 + epoch)
    order, total = torch.randperm(len(rows[0])), 0.0
    for batch_rows in order.split(options.batch):
        *inputs, log_error = (column[batch_rows.to(column.device)] for column in rows)
        optimiser.zero_grad()
        value = loss(heads(*inputs), log_error)
        (options.heads * value).backward()  # the gradients of training each head alone
        for head in heads.each:
            torch.nn.utils.clip_grad_norm_(head.parameters(), 1.0)
        optimiser.step()
        total += value.item() * len(batch_rows)
    return total / len(order)


def _validation_loss(heads: Heads, rows: list[torch.Tensor]) -> float:
    heads.eval()
    with torch.no_grad():
        return float(loss(heads(*rows[:-1]).mean(dim=0), rows[-1]))
