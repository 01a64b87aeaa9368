"""Networks as ONNX files, run by onnxruntime on one thread: two are slower on cores that others want, too."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.evaluator.features import SHAPES
from share.types import F32, U8

if TYPE_CHECKING:
    from share.evaluator.model import Network

SHIPPED = Path(__file__).parents[1] / "evaluator" / "error_model.onnx"
_BATCH = 32


def open_network(model: Path | bytes) -> Network:
    """A file, or what is in one. Raises DataError that says what is wrong with it."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors
    given = model if isinstance(model, bytes) else str(model)
    try:
        network: Network = onnxruntime.InferenceSession(given, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # a class of its own for each reason
        name = "the model" if isinstance(model, bytes) else str(model)
        raise DataError(f"{name}: is no network that can be run: {str(error).splitlines()[0]}") from None
    return network


def error_model(given: str) -> Network:
    """The one that comes with SHARE (`shipped`), or a file. Raises DataError."""
    return open_network(SHIPPED if given == "shipped" else Path(given))


def deep_of(network: Network, pictures: U8) -> F32:
    """What the backbone of an error model makes of pictures (N, 128, 128): (N, 1280)."""
    out = []
    for begin in range(0, len(pictures), _BATCH):
        some = pictures[begin : begin + _BATCH]
        taken = {spec.name for spec in network.get_inputs()} - {"picture"}
        inputs: dict[str, NDArray[Any]] = {"picture": some}
        inputs |= {name: np.zeros((len(some), *SHAPES[name]), np.float32) for name in taken}
        out.append(np.asarray(network.run(["deep"], inputs)[0], np.float32))
    return np.concatenate(out) if out else np.zeros((0, 1280), np.float32)
