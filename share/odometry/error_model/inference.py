"""The error model around a network that somebody else runs: features in, an estimate out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.odometry.error_model.inputs import ErrorModelInput
from share.types import F32

OUTPUTS = ("log_error", "embedding", "distance")
MAX_ERROR_CM = 20.0  # from where on a tracker is as good as lost: more is neither taught nor told
_MAX_LOG_ERROR = 10.0  # of what a network says, either way: e^10 cm is far above MOST_CM
_UNFAMILIAR_SCALE = 2.0  # times as wide, by logarithms, where the network has seen nothing alike


class OnnxSession(Protocol):
    """As an onnxruntime.InferenceSession: inputs picture (N, 128, 128) uint8, psd (N, 3, 12, 16), scalars
    (N, 8), recent (N, 14); outputs log_error (N, 3), of cm: expected, low, high; embedding (N, 64); distance
    (N,), from what it has learnt on, 1 where it ends."""

    def get_inputs(self) -> Sequence[Any]: ...
    def run(self, names: Sequence[str], inputs: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]: ...


@dataclass(frozen=True, eq=False)
class ErrorEstimate:
    """error_cm: what the tracker's position error of the last seconds is expected to be; nine times of ten it
    is between low_cm and high_cm; 20 stands for all that is more. strange: the model has learnt on nothing
    alike, so the interval is wider. embedding (64,): what the picture looks like."""

    error_cm: float
    low_cm: float
    high_cm: float
    out_of_distribution: bool
    embedding: F32


def estimate_error(network: OnnxSession, features: ErrorModelInput) -> ErrorEstimate:
    """Of one keyframe. Raises DataError where the network says no number."""
    inputs = {name: value[None] for name, value in features.arrays_by_name().items()}
    log_error, embedding, distance = network.run(OUTPUTS, inputs)
    if not (np.isfinite(log_error).all() and np.isfinite(distance).all()):
        raise DataError("the error model says no number of a keyframe")
    expected, low, high = np.clip(
        log_error[0], -_MAX_LOG_ERROR, _MAX_LOG_ERROR
    ).tolist()  # exp of more may be none
    out_of_distribution = bool(distance[0] > 1)
    if out_of_distribution:
        low, high = (
            expected + _UNFAMILIAR_SCALE * (low - expected),
            expected + _UNFAMILIAR_SCALE * (high - expected),
        )
    error_cm, low_cm, high_cm = (min(math.exp(x), MAX_ERROR_CM) for x in (expected, low, high))
    return ErrorEstimate(error_cm, low_cm, high_cm, out_of_distribution, np.asarray(embedding[0], np.float32))
