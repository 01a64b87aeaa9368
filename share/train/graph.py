"""The error model as ONNX: a backbone that is there already, and a head put onto it node by node.

Written out by hand, because it is thirty nodes, and so that the file depends on nobody's exporter.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from share.evaluator.features import SHAPES
from share.evaluator.model import OUTPUTS
from share.train.fitted import Fitted

DEEP = "deep"  # the backbone's last tensor (N, 1280)
_HEAD = "head/"  # names of all that a head brings begin with it
_INPUTS = {name: ("N", *shape) for name, shape in SHAPES.items() if name != "picture"}
_SHAPES = {"log_error": ("N", 3), "embedding": ("N", 64), "distance": ("N",)}


def with_head(base: bytes, fitted: Fitted) -> bytes:
    """`base`, a model with a backbone and perhaps another head, with this one."""
    model = onnx.load_model_from_string(base)
    graph = model.graph
    _strip(graph)
    head = _Head(fitted)
    graph.node.extend(head.nodes)
    graph.initializer.extend(head.constants)
    graph.input.extend(
        helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in _INPUTS.items()
    )
    graph.output.extend(
        helper.make_tensor_value_info(name, TensorProto.FLOAT, _SHAPES[name]) for name in OUTPUTS
    )
    helper.set_model_props(model, {name: str(value) for name, value in fitted.about.items()})
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def backbone_id(base: bytes) -> str:
    """The same for models that differ in their heads alone."""
    graph = onnx.load_model_from_string(base).graph
    _strip(graph)
    parts = (one.SerializeToString() for field in (graph.node, graph.initializer) for one in field)
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]


def origin(base: bytes) -> str:
    """Where its backbone comes from, and by what licence; empty if nobody says."""
    return str(onnx.load_model_from_string(base).doc_string)


def _strip(graph: Any) -> None:
    """Of an earlier head; deep stays as an output, by which others are taught."""
    for field in (graph.node, graph.initializer):
        kept = [one for one in field if not one.name.startswith(_HEAD)]
        del field[:]
        field.extend(kept)
    for field, names in ((graph.input, _INPUTS), (graph.output, OUTPUTS)):
        kept = [one for one in field if one.name not in names]
        del field[:]
        field.extend(kept)


class _Head:
    """Its nodes and constants, in order."""

    def __init__(self, fitted: Fitted) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._weights = fitted.weights
        seen = self._linear(DEEP, "visual.0", relu=True)
        self._node("LayerNormalization", [seen, *self._layer("visual.2")], "embedding", axis=-1, epsilon=1e-5)
        spread = self._conv(self._conv("psd", "spread.0"), "spread.2")
        spread = self._node("Flatten", [self._node("GlobalAveragePool", [spread])])
        numbers = self._node("Concat", ["scalars", "recent"], axis=1)
        heard = self._linear(numbers, "numbers.0", relu=True)
        joined = self._node("Concat", ["embedding", spread, heard], axis=1)
        told = self._linear(self._linear(joined, "joined.0", relu=True), "joined.2")
        self._interval(told, self._linear(numbers, "straight"), fitted.margin)
        away = self._node("Sub", [joined, self._constant("mean", fitted.mean)])
        away = self._node("MatMul", [away, self._constant("whitening", fitted.whitening)])
        self._node("ReduceL2", [away], "distance", axes=[1], keepdims=0)

    def _interval(self, told: str, straight: str, margin: float) -> None:
        bent, below, above = (f"{_HEAD}{name}" for name in ("bent", "below", "above"))
        ones = self._constant("ones", np.ones(3, np.int64))
        self.nodes.append(
            helper.make_node("Split", [told, ones], [bent, below, above], f"{_HEAD}split", axis=1)
        )
        expected = self._node("Add", [bent, straight])
        further = self._constant("margin", np.array(margin, np.float32))

        def width(raw: str) -> str:
            return self._node("Relu", [self._node("Add", [self._node("Softplus", [raw]), further])])

        low = self._node("Sub", [expected, width(below)])
        high = self._node("Add", [expected, width(above)])
        self._node("Concat", [expected, low, high], "log_error", axis=1)

    def _linear(self, x: str, layer: str, relu: bool = False) -> str:
        y = self._node("Gemm", [x, *self._layer(layer)], transB=1)
        return self._node("Relu", [y]) if relu else y

    def _conv(self, x: str, layer: str) -> str:
        y = self._node(
            "Conv", [x, *self._layer(layer)], kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1]
        )
        return self._node("Relu", [y])

    def _layer(self, name: str) -> list[str]:
        """Its weight and bias."""
        return [
            self._constant(f"{name}.{what}", self._weights[f"{name}.{what}"]) for what in ("weight", "bias")
        ]

    def _constant(self, name: str, value: Any) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(value), f"{_HEAD}{name}"))
        return f"{_HEAD}{name}"

    def _node(self, kind: str, inputs: list[str], output: str = "", **attributes: Any) -> str:
        name = f"{_HEAD}{len(self.nodes)}"
        out = output or name
        self.nodes.append(helper.make_node(kind, inputs, [out], name, **attributes))
        return out
