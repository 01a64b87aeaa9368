"""The error model as an ONNX file: opened, checked and run, from inputs to an estimate.

onnxruntime has one thread, because agents need the other cores.

A file from anywhere is checked before the runtime reads it (`check_model`), and an error model is run once on
zeros, so that its inputs and outputs are known to be right.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.files.onnx_file import check_model
from share.files.reading import MB, read_bytes
from share.odometry.error_model.inputs import INPUT_SHAPES, ErrorModelInput, input_dtype
from share.types import F32, U8

SHIPPED_MODEL = Path(__file__).with_name("error_model.onnx")
_BATCH_SIZE, _BACKBONE_SIZE = 32, 1280
_MAX_BYTES = 100 * MB  # of a file; the shipped model has 4
_MAX_MEMORY_BYTES = 1000 * MB  # of all networks; the shipped model takes 20, and 300 for a batch
_OUTPUT_SHAPES = {"log_error": (1, 3), "embedding": (1, 64), "distance": (1,)}

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


def read_model(path: Path) -> bytes:
    """Return the bytes of an ONNX file. Raises DataError that says what is wrong with it."""
    try:
        data = read_bytes(path, _MAX_BYTES)
        check_model(data)
        return data
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise DataError(f"{path}: not a usable ONNX network: {reason}") from None


def open_network(model: bytes, name: str = "the model") -> OnnxSession:
    """Return a session of the network in `model`. name: used in errors. Raises DataError that says what is
    wrong."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # DataError carries the message
    _limit_memory()
    options.add_session_config_entry("session.use_env_allocators", "1")
    try:
        network: OnnxSession = onnxruntime.InferenceSession(
            model, options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime has a class for each reason
        raise DataError(f"{name}: not a usable ONNX network: {_first_line(error)}") from None
    return network


def open_error_model(source: str) -> OnnxSession:
    """Return a session of the model shipped with SHARE (`shipped`) or of a file. Raises DataError."""
    path = SHIPPED_MODEL if source == "shipped" else Path(source)
    network = open_network(read_model(path), str(path))
    try:
        input_names = {spec.name for spec in network.get_inputs()}
        inputs = {name: np.zeros((1, *shape), input_dtype(name)) for name, shape in INPUT_SHAPES.items()}
        if input_names != inputs.keys():
            expected = ", ".join(sorted(inputs))
            raise ValueError(f"its inputs are {', '.join(sorted(input_names))}, expected {expected}")
        for name, value in zip(OUTPUTS, network.run(OUTPUTS, inputs), strict=True):
            if value.shape != _OUTPUT_SHAPES[name] or value.dtype != np.float32:
                raise ValueError(
                    f"its {name} is {value.shape} {value.dtype}, expected {_OUTPUT_SHAPES[name]} float32"
                )
    except Exception as error:
        raise DataError(f"{path}: not an error model: {_first_line(error)}") from None
    return network


@cache
def _limit_memory() -> None:
    """Limit the memory of all networks of this process together: weights broadcast against each other can
    make any size."""
    import onnxruntime as ort

    memory = ort.OrtMemoryInfo("Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT)
    arena = ort.OrtArenaCfg(_MAX_MEMORY_BYTES, -1, -1, -1)  # -1: the default
    ort.create_and_register_allocator(memory, arena)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def backbone_features(network: OnnxSession, pictures: U8) -> F32:
    """Return the output (N, 1280) of an error model's backbone for pictures (N, 128, 128). Raises
    DataError."""
    out = []
    for start in range(0, len(pictures), _BATCH_SIZE):
        batch = pictures[start : start + _BATCH_SIZE]
        input_names = {spec.name for spec in network.get_inputs()} - {"picture"}
        inputs: dict[str, NDArray[Any]] = {"picture": batch}
        inputs |= {
            name: np.zeros((len(batch), *INPUT_SHAPES[name]), np.float32)
            for name in input_names & INPUT_SHAPES.keys()
        }
        try:
            output = np.asarray(network.run(["deep"], inputs)[0], np.float32)
            if output.shape != (len(batch), _BACKBONE_SIZE):
                raise ValueError(f"its deep is {output.shape}, expected {(len(batch), _BACKBONE_SIZE)}")
        except Exception as error:
            raise DataError(f"the model has no backbone of an error model: {_first_line(error)}") from None
        out.append(output)
    return np.concatenate(out) if out else np.zeros((0, _BACKBONE_SIZE), np.float32)
