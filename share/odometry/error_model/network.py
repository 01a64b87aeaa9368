"""Networks as ONNX files, run by onnxruntime on one thread: two are slower on cores that others want, too.

A file from anywhere is looked through before the runtime sees it (`onnx_header`), and an error model is tried
once: what it takes and tells is known before anything relies on it.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.files.onnx_file import check_model
from share.files.reading import MB, read_bytes
from share.odometry.error_model.inference import OUTPUTS
from share.odometry.error_model.inputs import INPUT_SHAPES, input_dtype
from share.types import F32, U8

if TYPE_CHECKING:
    from share.odometry.error_model.inference import OnnxSession

SHIPPED_MODEL = Path(__file__).with_name("error_model.onnx")
_BATCH_SIZE, _BACKBONE_SIZE = 32, 1280
_MAX_BYTES = 100 * MB  # ours has 4; one that an agent can run beside its tracker has not many more
_MAX_MEMORY_BYTES = 1000 * MB  # ours takes 20, and 300 where a batch goes through it
_OUTPUT_SHAPES = {"log_error": (1, 3), "embedding": (1, 64), "distance": (1,)}


def read_model(path: Path) -> bytes:
    """A file that may be a network. Raises DataError that says what is wrong with it."""
    try:
        data = read_bytes(path, _MAX_BYTES)
        check_model(data)
        return data
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise DataError(f"{path}: is no network that can be run: {reason}") from None


def open_network(model: bytes, name: str = "the model") -> OnnxSession:
    """What is in a file. name: what an error calls it. Raises DataError that says what is wrong with it."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what is wrong is said once, by DataError
    _limit_memory()
    options.add_session_config_entry("session.use_env_allocators", "1")
    try:
        network: OnnxSession = onnxruntime.InferenceSession(
            model, options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # a class of its own for each reason
        raise DataError(f"{name}: is no network that can be run: {_first_line(error)}") from None
    return network


def open_error_model(source: str) -> OnnxSession:
    """The one that comes with SHARE (`shipped`), or a file. Raises DataError."""
    path = SHIPPED_MODEL if source == "shipped" else Path(source)
    network = open_network(read_model(path), str(path))
    try:
        input_names = {spec.name for spec in network.get_inputs()}
        inputs = {name: np.zeros((1, *shape), input_dtype(name)) for name, shape in INPUT_SHAPES.items()}
        if input_names != inputs.keys():
            raise ValueError(f"it takes {', '.join(sorted(input_names))}, not {', '.join(sorted(inputs))}")
        for name, value in zip(OUTPUTS, network.run(OUTPUTS, inputs), strict=True):
            if value.shape != _OUTPUT_SHAPES[name] or value.dtype != np.float32:
                raise ValueError(
                    f"its {name} is {value.shape} of {value.dtype}, not {_OUTPUT_SHAPES[name]} of float32"
                )
    except Exception as error:
        raise DataError(f"{path}: is no error model: {_first_line(error)}") from None
    return network


@cache
def _limit_memory() -> None:
    """Of all networks of this process together: weights that are added row to column make any size."""
    import onnxruntime as ort

    memory = ort.OrtMemoryInfo("Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT)
    ort.create_and_register_allocator(memory, ort.OrtArenaCfg(_MAX_MEMORY_BYTES, -1, -1, -1))  # -1: as it is


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def backbone_features(network: OnnxSession, pictures: U8) -> F32:
    """What the backbone of an error model makes of pictures (N, 128, 128): (N, 1280). Raises DataError."""
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
                raise ValueError(f"its deep is {output.shape}, not {(len(batch), _BACKBONE_SIZE)}")
        except Exception as error:
            raise DataError(f"the model has no backbone of an error model: {_first_line(error)}") from None
        out.append(output)
    return np.concatenate(out) if out else np.zeros((0, _BACKBONE_SIZE), np.float32)
