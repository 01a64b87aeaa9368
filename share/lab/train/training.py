"""Fit heads to labels: standardise inputs, train, calibrate intervals and estimate the training domain."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from share import __version__
from share.lab.train.keyframe_table import LabelCollection
from share.lab.train.optimisation import Inputs, ShowEpoch, TrainingOptions, train_heads
from share.lab.train.trained_heads import (
    TrainedHeads,
    conformal_margin,
    fold_standardisation,
    mahalanobis_scale,
)
from share.metrics.local_error import WINDOW_S
from share.types import F32

_MIN_DEVIATION = 1e-3  # least deviation of an input


def train_model(
    collection: LabelCollection,
    deep_features: F32,
    backbone: str,
    options: TrainingOptions,
    checkpoint: Path | None,
    on_epoch: ShowEpoch,
) -> TrainedHeads:
    """Return the heads trained on the collection. deep_features (N, 1280): of the table's pictures, by the
    backbone whose id (`onnx_graph.backbone_id`) is `backbone`."""
    scale = _Standardiser(deep_features, collection)
    parts = {name: scale.inputs(name) for name in collection.parts}
    heads = train_heads(parts["learn"], parts["stop"], options, checkpoint, on_epoch)
    with torch.no_grad():
        joined = {name: heads.join(*_tensors(parts[name])).numpy() for name in ("learn", "calibrate")}
        calibrated = heads(*_tensors(parts["calibrate"])).mean(dim=0).numpy()
    about = {
        "version": __version__,
        "window_s": WINDOW_S,
        "backbone": backbone,
        "options": asdict(options),
        "rooms": {name: _rooms(collection, name) for name in collection.parts},
        "keyframes": {name: len(part.log_error) for name, part in parts.items()},
    }
    return TrainedHeads(
        [_folded_weights(head, scale) for head in heads.each],
        conformal_margin(calibrated, parts["calibrate"].log_error),
        *mahalanobis_scale(joined["learn"], joined["calibrate"]),
        about,
    )


def _folded_weights(head: torch.nn.Module, scale: _Standardiser) -> dict[str, F32]:
    """Return the head's weights for inputs that are not standardised."""
    weights = {name: value.numpy() for name, value in head.state_dict().items()}
    weights = fold_standardisation(weights, "visual.0", *scale.deep_moments)
    for layer in ("numbers.0", "straight"):
        weights = fold_standardisation(weights, layer, *scale.number_moments)
    return weights


class _Standardiser:
    """Scales inputs to mean 0 and deviation 1 over the training part."""

    def __init__(self, deep: F32, collection: LabelCollection) -> None:
        self._deep_features, self._collection = deep, collection
        is_training = collection.keyframes_of("learn")
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


def _rooms(collection: LabelCollection, part: str) -> list[str]:
    abouts = (collection.abouts[run] for run in collection.parts[part].tolist())
    return sorted({str(about["session"]) for about in abouts})
