"""Run the error model: inputs to an estimate, with any ONNX session."""

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
MAX_ERROR_CM = 20.0  # a tracker this wrong is as good as lost; labels and estimates end here
_MAX_LOG_ERROR = 10.0  # bound of the network's output: e^10 cm is far above `MAX_ERROR_CM`
_UNFAMILIAR_SCALE = 2.0  # widens the interval, in logarithms, out of the training distribution


class OnnxSession(Protocol):
    """The part of onnxruntime.InferenceSession that is used.

    Inputs: picture (N, 128, 128) uint8, psd (N, 3, 12, 16), scalars (N, 8), recent (N, 14). Outputs:
    log_error (N, 3), of cm: expected, low, high; embedding (N, 64); distance (N,) from the training
    distribution, which ends at 1.
    """

    def get_inputs(self) -> Sequence[Any]: ...
    def run(self, names: Sequence[str], inputs: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]: ...


@dataclass(frozen=True, eq=False)
class ErrorEstimate:
    """The expected position error of the last seconds, at most 20 cm, with a 90 % interval low_cm to high_cm.

    out_of_distribution: the training data has nothing similar, so the interval is wider. embedding (64,): of
    the picture.
    """

    error_cm: float
    low_cm: float
    high_cm: float
    out_of_distribution: bool
    embedding: F32


def estimate_error(network: OnnxSession, features: ErrorModelInput) -> ErrorEstimate:
    """Return the estimate for one keyframe. Raises DataError where the network's output is not finite."""
    inputs = {name: value[None] for name, value in features.arrays_by_name().items()}
    log_error, embedding, distance = network.run(OUTPUTS, inputs)
    if not (np.isfinite(log_error).all() and np.isfinite(distance).all()):
        raise DataError("the error model's output for a keyframe is not finite; use another model")
    expected, low, high = np.clip(log_error[0], -_MAX_LOG_ERROR, _MAX_LOG_ERROR).tolist()
    out_of_distribution = bool(distance[0] > 1)
    if out_of_distribution:
        low = expected + _UNFAMILIAR_SCALE * (low - expected)
        high = expected + _UNFAMILIAR_SCALE * (high - expected)
    error_cm, low_cm, high_cm = (min(math.exp(x), MAX_ERROR_CM) for x in (expected, low, high))
    return ErrorEstimate(error_cm, low_cm, high_cm, out_of_distribution, np.asarray(embedding[0], np.float32))
