"""The heads of the error model: in torch, with their loss, and as nodes appended to a backbone's ONNX graph.

Three branches are joined: backbone features of the picture, the distribution of feature points (PSD), and
scalars. Source: SHARE, IMWUT 10(3) 97, 2026; scalars of the last seconds are added here
(docs/understand/error-model.md).
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.nn import functional

from share.lab.train.trained_heads import TrainedHeads
from share.odometry.error_model.inputs import INPUT_SHAPES, RECENT_NAMES, SCALAR_NAMES
from share.odometry.error_model.network import OUTPUTS
from share.types import F32

DEEP_SIZE, EMBEDDING_SIZE, JOINED_SIZE = 1280, 64, 96
NUMBERS_SIZE = len(SCALAR_NAMES) + len(RECENT_NAMES)
LOW_QUANTILE, HIGH_QUANTILE = 0.05, 0.95


class Head(nn.Module):  # type: ignore[misc]
    """Map deep (N, 1280), psd (N, 3, 12, 16) and numbers (N, 22: scalars, recent) to the log error in cm (N,
    3): expected, low, high.

    A linear skip connection leads from numbers to the expected log error: many are logarithms of factors of
    the error, so it extrapolates beyond the training data.
    """

    def __init__(self, dropout: float = 0.0) -> None:
        super().__init__()
        self.dropout = nn.Dropout(dropout)
        self.visual = nn.Sequential(
            nn.Linear(DEEP_SIZE, EMBEDDING_SIZE), nn.ReLU(), nn.LayerNorm(EMBEDDING_SIZE)
        )
        self.psd = nn.Sequential(
            nn.Conv2d(3, 8, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(8, 16, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d(1),
            nn.Flatten(),
        )
        self.numbers = nn.Sequential(nn.Linear(NUMBERS_SIZE, 16), nn.ReLU())
        self.joined = nn.Sequential(nn.Linear(JOINED_SIZE, 48), nn.ReLU(), nn.Linear(48, 3))
        self.skip = nn.Linear(NUMBERS_SIZE, 1)

    def join(self, deep: Tensor, psd: Tensor, numbers: Tensor) -> Tensor:
        """Return the joined branches (N, 96)."""
        branches = (self.visual(self.dropout(deep)), self.psd(psd), self.numbers(numbers))
        return torch.cat(branches, dim=1)

    def forward(self, deep: Tensor, psd: Tensor, numbers: Tensor) -> Tensor:
        expected, below, above = self.joined(self.join(deep, psd, numbers)).unbind(dim=1)
        expected = expected + self.skip(numbers)[:, 0]
        low, high = expected - functional.softplus(below), expected + functional.softplus(above)
        return torch.stack([expected, low, high], dim=1)


class Heads(nn.Module):  # type: ignore[misc]
    """An ensemble of heads with different initial weights; their mean errs less than each (deep ensembles,
    Lakshminarayanan et al. 2017)."""

    def __init__(self, count: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.each = nn.ModuleList(Head(dropout) for _ in range(count))

    def join(self, deep: Tensor, psd: Tensor, numbers: Tensor) -> Tensor:
        """Return the joined branches (N, 96) of the first head."""
        joined: Tensor = self.each[0].join(deep, psd, numbers)
        return joined

    def forward(self, deep: Tensor, psd: Tensor, numbers: Tensor) -> Tensor:
        """Return the outputs (H, N, 3) of all heads."""
        return torch.stack([head(deep, psd, numbers) for head in self.each])


def loss(predicted: Tensor, log_error: Tensor) -> Tensor:
    """Return the loss of predicted (..., N, 3), as of `Head`, for log_error (N,) in log cm.

    The expected error is fitted by the Poisson deviance: its minimum is the mean, and it weighs large errors
    more than a logarithm and less than a square would. The interval is fitted by the pinball loss of its
    quantiles.
    """
    expected, low, high = predicted.unbind(dim=-1)
    deviance = torch.exp(expected) - torch.exp(log_error) * expected
    return (
        deviance.mean()
        + _pinball_loss(log_error - low, LOW_QUANTILE)
        + _pinball_loss(log_error - high, HIGH_QUANTILE)
    )


def _pinball_loss(excess: Tensor, quantile: float) -> Tensor:
    """Quantile regression, Koenker and Bassett 1978."""
    return torch.maximum(quantile * excess, (quantile - 1) * excess).mean()


class BestWeights:
    """The weights with which a network does best on validation data, and the epochs since."""

    def __init__(self, net: nn.Module) -> None:
        self._net, self.loss, self.epochs_since = net, float("inf"), 0
        self._copy()

    def update(self, loss: float) -> None:
        """Take in the validation loss of an epoch."""
        self.epochs_since += 1
        if loss < self.loss:
            self.loss, self.epochs_since = loss, 0
            self._copy()

    def restore(self) -> None:
        """Give the network its best weights, for inference."""
        self._net.load_state_dict(self.weights)
        self._net.eval()

    def _copy(self) -> None:
        state = self._net.state_dict()
        self.weights = {name: value.detach().cpu().clone() for name, value in state.items()}


# The same heads as ONNX nodes, written by hand, so that the file does not depend on an exporter.

DEEP_OUTPUT = "deep"  # the backbone's output (N, 1280)
_HEAD_PREFIX = "head/"  # prefix of the names of all nodes and constants of heads
_INPUTS = {name: ("N", *shape) for name, shape in INPUT_SHAPES.items() if name != "picture"}
_OUTPUT_SHAPES = {"log_error": ("N", 3), "embedding": ("N", 64), "distance": ("N",)}


def with_heads(base: bytes, fitted: TrainedHeads) -> bytes:
    """Return the model `base` (a backbone, perhaps with heads) with the heads of `fitted` in place of its
    own."""
    model = onnx.load_model_from_string(base)
    graph = model.graph
    _strip_heads(graph)
    nodes = _head_nodes(fitted)
    graph.node.extend(nodes.all)
    graph.initializer.extend(nodes.constants)
    graph.input.extend(
        helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in _INPUTS.items()
    )
    graph.output.extend(
        helper.make_tensor_value_info(name, TensorProto.FLOAT, _OUTPUT_SHAPES[name]) for name in OUTPUTS
    )
    helper.set_model_props(model, {name: str(value) for name, value in fitted.about.items()})
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def backbone_id(base: bytes) -> str:
    """Return an id of the backbone, independent of the heads."""
    graph = onnx.load_model_from_string(base).graph
    _strip_heads(graph)
    parts = (one.SerializeToString() for field in (graph.node, graph.initializer) for one in field)
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]


def origin(base: bytes) -> str:
    """Return source and licence of the backbone, empty if unknown."""
    return str(onnx.load_model_from_string(base).doc_string)


def _strip_heads(graph: Any) -> None:
    """Remove the heads; `deep` stays an output, which training needs."""
    for field in (graph.node, graph.initializer):
        remaining = [one for one in field if not one.name.startswith(_HEAD_PREFIX)]
        del field[:]
        field.extend(remaining)
    for field, names in ((graph.input, _INPUTS), (graph.output, OUTPUTS)):
        remaining = [one for one in field if one.name not in names]
        del field[:]
        field.extend(remaining)


class _NodeList:
    """Nodes and constants, in order."""

    def __init__(self) -> None:
        self.all: list[Any] = []
        self.constants: list[Any] = []

    def add(self, kind: str, inputs: list[str], output: str = "", **attributes: Any) -> str:
        """Append a node and return the name of its output."""
        name = f"{_HEAD_PREFIX}{len(self.all)}"
        self.all.append(helper.make_node(kind, inputs, [output or name], name, **attributes))
        return output or name

    def columns(self, x: str) -> list[str]:
        """Split x (N, 3) into three columns (N, 1)."""
        name = f"{_HEAD_PREFIX}{len(self.all)}"
        each = [f"{name}/{k}" for k in range(3)]
        ones = self.constant(f"{name}/ones", np.ones(3, np.int64))
        self.all.append(helper.make_node("Split", [x, ones], each, name, axis=1))
        return each

    def constant(self, name: str, value: Any) -> str:
        name = name if name.startswith(_HEAD_PREFIX) else _HEAD_PREFIX + name
        self.constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name


class _HeadNodes:
    """The nodes of one head. joined: (N, 96). prediction (N, 3): log error, and widths of the interval below
    and above it."""

    def __init__(self, nodes: _NodeList, number: int, weights: dict[str, F32], numbers: str) -> None:
        self._nodes, self._number, self._weights = nodes, number, weights
        visual = self._linear(DEEP_OUTPUT, "visual.0", relu=True)
        norm = self._layer("visual.2")
        self.embedding = nodes.add("LayerNormalization", [visual, *norm], axis=-1, epsilon=1e-5)
        psd = self._conv(self._conv("psd", "psd.0"), "psd.2")
        psd = nodes.add("Flatten", [nodes.add("GlobalAveragePool", [psd])])
        numeric = self._linear(numbers, "numbers.0", relu=True)
        self.joined = nodes.add("Concat", [self.embedding, psd, numeric], axis=1)
        outputs = self._linear(self._linear(self.joined, "joined.0", relu=True), "joined.2")
        correction, below, above = nodes.columns(outputs)
        expected = nodes.add("Add", [correction, self._linear(numbers, "skip")])
        widths = [nodes.add("Softplus", [side]) for side in (below, above)]
        self.prediction = nodes.add("Concat", [expected, *widths], axis=1)

    def _linear(self, x: str, layer: str, relu: bool = False) -> str:
        y = self._nodes.add("Gemm", [x, *self._layer(layer)], transB=1)
        return self._nodes.add("Relu", [y]) if relu else y

    def _conv(self, x: str, layer: str) -> str:
        shape: dict[str, Any] = {"kernel_shape": [3, 3], "strides": [2, 2], "pads": [1, 1, 1, 1]}
        return self._nodes.add("Relu", [self._nodes.add("Conv", [x, *self._layer(layer)], **shape)])

    def _layer(self, name: str) -> list[str]:
        """Add the layer's weight and bias as constants."""
        names = [f"{name}.{what}" for what in ("weight", "bias")]
        return [self._nodes.constant(f"{self._number}/{name}", self._weights[name]) for name in names]


def _head_nodes(fitted: TrainedHeads) -> _NodeList:
    """Return the nodes of all heads and of their mean."""
    nodes = _NodeList()
    numbers = nodes.add("Concat", ["scalars", "recent"], axis=1)
    heads = [_HeadNodes(nodes, k, weights, numbers) for k, weights in enumerate(fitted.heads)]
    expected, below, above = nodes.columns(nodes.add("Mean", [head.prediction for head in heads]))
    margin = nodes.constant("margin", np.array(fitted.margin, np.float32))
    below, above = (nodes.add("Relu", [nodes.add("Add", [width, margin])]) for width in (below, above))
    ends = nodes.add("Sub", [expected, below]), nodes.add("Add", [expected, above])
    nodes.add("Concat", [expected, *ends], "log_error", axis=1)
    nodes.add("Identity", [heads[0].embedding], "embedding")
    offset = nodes.add("Sub", [heads[0].joined, nodes.constant("mean", fitted.mean)])
    offset = nodes.add("MatMul", [offset, nodes.constant("whitening", fitted.whitening)])
    nodes.add("ReduceL2", [offset], "distance", axes=[1], keepdims=0)
    return nodes
