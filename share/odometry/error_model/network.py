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
from share.odometry.error_model.features import SHAPES, kind_of
from share.odometry.error_model.model import OUTPUTS
from share.types import F32, U8

if TYPE_CHECKING:
    from share.odometry.error_model.model import Network

SHIPPED = Path(__file__).with_name("error_model.onnx")
_BATCH, _DEEP = 32, 1280
_MOST_BYTES = 100 * MB  # ours has 4; one that an agent can run beside its tracker has not many more
_MOST_MEMORY = 1000 * MB  # ours takes 20, and 300 where a batch goes through it
_TELLS = {"log_error": (1, 3), "embedding": (1, 64), "distance": (1,)}


def read_model(path: Path) -> bytes:
    """A file that may be a network. Raises DataError that says what is wrong with it."""
    try:
        data = read_bytes(path, _MOST_BYTES)
        check_model(data)
        return data
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise DataError(f"{path}: is no network that can be run: {reason}") from None


def open_network(model: bytes, name: str = "the model") -> Network:
    """What is in a file. name: what an error calls it. Raises DataError that says what is wrong with it."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what is wrong is said once, by DataError
    _bound_memory()
    options.add_session_config_entry("session.use_env_allocators", "1")
    try:
        network: Network = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # a class of its own for each reason
        raise DataError(f"{name}: is no network that can be run: {_said(error)}") from None
    return network


def error_model(given: str) -> Network:
    """The one that comes with SHARE (`shipped`), or a file. Raises DataError."""
    path = SHIPPED if given == "shipped" else Path(given)
    network = open_network(read_model(path), str(path))
    try:
        taken = {spec.name for spec in network.get_inputs()}
        inputs = {name: np.zeros((1, *shape), kind_of(name)) for name, shape in SHAPES.items()}
        if taken != inputs.keys():
            raise ValueError(f"it takes {', '.join(sorted(taken))}, not {', '.join(sorted(inputs))}")
        for name, value in zip(OUTPUTS, network.run(OUTPUTS, inputs), strict=True):
            if value.shape != _TELLS[name] or value.dtype != np.float32:
                raise ValueError(
                    f"its {name} is {value.shape} of {value.dtype}, not {_TELLS[name]} of float32"
                )
    except Exception as error:
        raise DataError(f"{path}: is no error model: {_said(error)}") from None
    return network


@cache
def _bound_memory() -> None:
    """Of all networks of this process together: weights that are added row to column make any size."""
    import onnxruntime as ort

    memory = ort.OrtMemoryInfo("Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT)
    ort.create_and_register_allocator(memory, ort.OrtArenaCfg(_MOST_MEMORY, -1, -1, -1))  # -1: as it is


def _said(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def deep_of(network: Network, pictures: U8) -> F32:
    """What the backbone of an error model makes of pictures (N, 128, 128): (N, 1280). Raises DataError."""
    out = []
    for begin in range(0, len(pictures), _BATCH):
        some = pictures[begin : begin + _BATCH]
        taken = {spec.name for spec in network.get_inputs()} - {"picture"}
        inputs: dict[str, NDArray[Any]] = {"picture": some}
        inputs |= {name: np.zeros((len(some), *SHAPES[name]), np.float32) for name in taken & SHAPES.keys()}
        try:
            deep = np.asarray(network.run(["deep"], inputs)[0], np.float32)
            if deep.shape != (len(some), _DEEP):
                raise ValueError(f"its deep is {deep.shape}, not {(len(some), _DEEP)}")
        except Exception as error:
            raise DataError(f"the model has no backbone of an error model: {_said(error)}") from None
        out.append(deep)
    return np.concatenate(out) if out else np.zeros((0, _DEEP), np.float32)
