"""Assemble the error model from a backbone and trained heads, and compare it with its baselines."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from share.config import ControlConfig
from share.errors import UsageError
from share.files.json_file import own_format_errors
from share.lab.train.baselines import BASELINES, KeyframeRows, Predictor, ShowProgress
from share.lab.train.keyframe_table import LabelCollection, collect_labels
from share.lab.train.network import backbone_id, with_heads
from share.lab.train.score import ErrorModelScore
from share.lab.train.trained_heads import TrainedHeads, read_trained
from share.odometry.error_model.network import (
    OnnxSession,
    backbone_features,
    estimate_error,
    open_network,
    read_model,
)
from share.scheduling.qoe import ACCEPTED_DELAY_MS, QoeParameters, qoe
from share.types import F32, F64, AgentKind

_TIMED_KEYFRAMES = 200


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


def score_network(name: str, network: OnnxSession, rows: KeyframeRows) -> ErrorModelScore:
    """Score the network one keyframe at a time, as on an agent."""
    table, estimates, cpu_start_s = rows.table, [], time.thread_time()
    for features in table.features():
        estimates.append(estimate_error(network, features))
    ms = 1e3 * (time.thread_time() - cpu_start_s) / max(len(estimates), 1)
    low, high = (np.array([getattr(one, side) for one in estimates]) for side in ("low_cm", "high_cm"))
    coverage = float(((low <= table.error_cm) & (table.error_cm <= high)).mean())
    return score_predictions(
        name, np.array([one.error_cm for one in estimates]), table.error_cm, coverage, ms
    )


def score_baselines(
    collection: LabelCollection, deep_features: F32, seed: int, on_progress: ShowProgress
) -> Iterator[ErrorModelScore]:
    """Train each baseline on the model's training rooms and yield its score on the test rooms."""
    rows = KeyframeRows(collection.table, deep_features)
    parts = {part: rows.take(collection.keyframes_of(part)) for part in collection.parts}
    training, validation, test = parts["train"], parts["validate"], parts["test"]
    yield _score_constant_mean(training, test)
    for name, train_baseline in BASELINES.items():

        def show(text: str, name: str = name) -> None:
            on_progress(f"{name}: {text}")

        show("training")
        predict = train_baseline(training, validation, seed, show)
        yield score_predictions(name, predict(test), test.table.error_cm, ms=_ms_per_keyframe(predict, test))


def score_predictions(
    name: str, predicted_cm: F64, error_cm: F32, coverage: float = float("nan"), ms: float = float("nan")
) -> ErrorModelScore:
    from scipy.stats import spearmanr

    errors = predicted_cm - error_cm
    rank = float(spearmanr(predicted_cm, error_cm).statistic) if np.ptp(predicted_cm) else 0.0
    rmse, mae = float(np.sqrt((errors**2).mean())), float(np.abs(errors).mean())
    return ErrorModelScore(
        name, rmse, mae, rank, float(np.abs(_qoe(predicted_cm) - _qoe(error_cm)).mean()), coverage, ms
    )


def _qoe(error_cm: F64 | F32) -> F64:
    """Return the QoE of a headset without delay, which would only make differences smaller."""
    needs = QoeParameters.from_config(ControlConfig(), AgentKind.AR)
    return np.array([qoe(ACCEPTED_DELAY_MS, cm, needs) for cm in error_cm.tolist()])


def _score_constant_mean(training: KeyframeRows, test: KeyframeRows) -> ErrorModelScore:
    """Score the constant prediction of the training's mean error."""
    constant = np.full(len(test.deep_features), float(training.table.error_cm.mean()))
    return score_predictions("always the mean", constant, test.table.error_cm)


def _ms_per_keyframe(predict: Predictor, rows: KeyframeRows) -> float:
    """Return CPU ms of a prediction, one keyframe at a time."""
    samples = [rows.take(np.array([k])) for k in range(min(_TIMED_KEYFRAMES, len(rows.deep_features)))]
    cpu_start_s = time.process_time()
    for one in samples:
        predict(one)
    return 1e3 * (time.process_time() - cpu_start_s) / max(len(samples), 1)
