"""From labels to heads: inputs are standardised, heads are fitted and calibrated, and know how far their
knowledge goes."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from share import __version__
from share.lab.train.fit import FitOptions, Inputs, Show, fit
from share.lab.train.fitted import Fitted, folded, known, margin
from share.lab.train.table import Collection
from share.metrics.local_error import WINDOW_S
from share.types import F32

_LEAST = 1e-3  # deviation of an input that hardly changes


def teach(
    collection: Collection, deep: F32, backbone: str, options: FitOptions, checkpoint: Path | None, show: Show
) -> Fitted:
    """deep (N, 1280): of the table's pictures, by the backbone that the head will be put onto, which is
    called `backbone` (`graph.backbone_id`)."""
    scale = _Scale(deep, collection)
    parts = {name: scale.inputs(name) for name in collection.parts}
    heads = fit(parts["learn"], parts["stop"], options, checkpoint, show)
    with torch.no_grad():
        joined = {name: heads.join(*_tensors(parts[name])).numpy() for name in ("learn", "calibrate")}
        told = heads(*_tensors(parts["calibrate"])).mean(dim=0).numpy()
    about = {
        "version": __version__,
        "window_s": WINDOW_S,
        "backbone": backbone,
        "options": asdict(options),
        "rooms": {name: _rooms(collection, name) for name in collection.parts},
        "keyframes": {name: len(part.log_error) for name, part in parts.items()},
    }
    return Fitted(
        [_folded(head, scale) for head in heads.each],
        margin(told, parts["calibrate"].log_error),
        *known(joined["learn"], joined["calibrate"]),
        about,
    )


def _folded(head: torch.nn.Module, scale: _Scale) -> dict[str, F32]:
    """Its weights, for inputs as they come."""
    weights = {name: value.numpy() for name, value in head.state_dict().items()}
    weights = folded(weights, "visual.0", *scale.deep)
    for layer in ("numbers.0", "straight"):
        weights = folded(weights, layer, *scale.numbers)
    return weights


class _Scale:
    """Inputs at a mean of 0 and a deviation of 1, by those that are learnt from."""

    def __init__(self, deep: F32, collection: Collection) -> None:
        self._deep, self._collection = deep, collection
        learn = collection.of("learn")
        self.deep = _moments(deep[learn])
        self.numbers = _moments(collection.table.numbers[learn])

    def inputs(self, part: str) -> Inputs:
        rows, table = self._collection.of(part), self._collection.table
        return Inputs(
            _scaled(self._deep[rows], *self.deep),
            table.psd[rows],
            _scaled(table.numbers[rows], *self.numbers),
            table.log_error[rows],
        )


def _moments(x: F32) -> tuple[F32, F32]:
    return x.mean(axis=0), np.maximum(x.std(axis=0), _LEAST)


def _scaled(x: F32, mean: F32, deviation: F32) -> F32:
    out: F32 = (x - mean) / deviation
    return out


def _tensors(inputs: Inputs) -> list[torch.Tensor]:
    return inputs.tensors(torch.device("cpu"))[:-1]


def _rooms(collection: Collection, part: str) -> list[str]:
    abouts = (collection.abouts[run] for run in collection.parts[part].tolist())
    return sorted({str(about["session"]) for about in abouts})
