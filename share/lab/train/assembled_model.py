"""An error model assembled from a backbone and trained heads, with the labels of the training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share.errors import UsageError
from share.files.json_file import own_format_errors
from share.lab.train.baselines import KeyframeRows
from share.lab.train.keyframe_table import LabelCollection, collect_labels
from share.lab.train.onnx_graph import backbone_id, with_heads
from share.lab.train.trained_heads import TrainedHeads, read_trained
from share.odometry.error_model.inference import OnnxSession
from share.odometry.error_model.network import backbone_features, open_network, read_model
from share.types import F32


@dataclass(frozen=True, eq=False)
class AssembledModel:
    """model: the ONNX file. deep_features (N, 1280): of the collection's table."""

    fitted: TrainedHeads
    collection: LabelCollection
    model: bytes
    network: OnnxSession
    deep_features: F32

    @property
    def test(self) -> KeyframeRows:
        """Return the keyframes held out from training."""
        return KeyframeRows(self.collection.table, self.deep_features).take(
            self.collection.keyframes_of("test")
        )


def assemble(fit: Path, labels: Path, base: Path) -> AssembledModel:
    """Load trained heads, labels and backbone, and assemble the model. fit: a folder of `share train fit`.
    Raises UsageError where labels or base differ from those of the training, DataError."""
    fitted = read_trained(file := fit / "fit.npz")
    with own_format_errors(file):
        seed, backbone = int(fitted.about["options"]["seed"]), fitted.about["backbone"]
    collection = collect_labels(labels, seed)
    with own_format_errors(file):
        _check_rooms(collection, fitted.about, labels)
    base_model = read_model(base)
    if backbone_id(base_model) != backbone:
        raise UsageError(
            f"{base}: its backbone is not the one that {fit} was trained with; give that one as --base"
        )
    with own_format_errors(file):
        model = with_heads(base_model, fitted)
    network = open_network(model)
    return AssembledModel(
        fitted, collection, model, network, backbone_features(network, collection.table.picture)
    )


def _check_rooms(collection: LabelCollection, about: Mapping[str, Any], labels: Path) -> None:
    """Raise UsageError where the split differs from the training's: the test would include training data."""
    for part, runs in collection.parts.items():
        sessions = {str(collection.abouts[run]["session"]) for run in runs.tolist()}
        if sessions != set(about["rooms"][part]):
            raise UsageError(
                f"{labels}: these labels are not those of the training; the sessions of '{part}' differ"
            )
