"""What an ONNX file asks for, before a runtime sees it. Pure: bytes in, names out.

Only those parts of the protocol buffer are looked at that matter (onnx.proto: ModelProto, GraphProto,
NodeProto, AttributeProto, TensorProto). Layers whose output is at most about as large as input and weights
are let through; those that loop, branch, call or make tensors of any size out of a few bytes are not.
"""

from __future__ import annotations

from collections.abc import Iterator

_GRAPH, _FUNCTIONS = 7, 25  # of a model
_NODE, _INITIALIZER, _SPARSE_INITIALIZER = 1, 5, 15  # of a graph
_TYPE, _ATTRIBUTE, _DOMAIN = 4, 5, 7  # of a node
_TENSOR, _GRAPH_OF, _TENSORS, _GRAPHS, _SPARSE, _SPARSES = 5, 6, 10, 11, 22, 23  # of an attribute
_EXTERNAL, _LOCATION = 13, 14  # of a tensor
_BYTES, _FIXED = 2, {1: 8, 5: 4}  # wire types, and how long those of one length are
_MAX_NODES = 20_000
_DOMAINS = (b"", b"ai.onnx")

ALLOWED_LAYERS = frozenset((
    "Abs", "Add", "And", "ArgMax", "ArgMin", "AveragePool", "BatchNormalization", "Cast", "CastLike",
    "Ceil", "Clip", "Concat", "Constant", "Conv", "ConvInteger", "Cos", "DequantizeLinear", "Div",
    "Dropout", "DynamicQuantizeLinear", "Elu", "Equal", "Erf", "Exp", "Flatten", "Floor", "Gather", "Gelu",
    "Gemm", "GlobalAveragePool", "GlobalMaxPool", "Greater", "GreaterOrEqual", "HardSigmoid", "HardSwish",
    "Identity", "InstanceNormalization", "LayerNormalization", "LeakyRelu", "Less", "LessOrEqual", "Log",
    "LogSoftmax", "LpNormalization", "MatMul", "MatMulInteger", "Max", "MaxPool", "Mean", "Min", "Mish",
    "Mul", "Neg", "Not", "Or", "PRelu", "Pow", "QLinearConv", "QLinearMatMul", "QuantizeLinear",
    "Reciprocal", "ReduceL1", "ReduceL2", "ReduceLogSumExp", "ReduceMax", "ReduceMean", "ReduceMin",
    "ReduceProd", "ReduceSum", "ReduceSumSquare", "Relu", "Reshape", "Round", "Selu", "Shape", "Sigmoid",
    "Sign", "Sin", "Slice", "Softmax", "Softplus", "Softsign", "Split", "Sqrt", "Squeeze", "Sub", "Sum",
    "Tanh", "Transpose", "Unsqueeze", "Where", "Xor",
))  # fmt: skip


def check_model(data: bytes) -> None:
    """Raises ValueError that says what of a model is not let through, or that it is none."""
    try:
        parts = list(_fields(data))
        graphs = [value for number, value in parts if number == _GRAPH]
        if len(graphs) != 1 or not isinstance(graphs[0], bytes):
            raise ValueError("it has no graph")
        if any(number == _FUNCTIONS for number, _ in parts):
            raise ValueError("it defines functions")
        _check_graph(graphs[0])
    except IndexError:
        raise ValueError("it is no protocol buffer, or cut short") from None


def _check_graph(graph: bytes) -> None:
    nodes = 0
    for number, value in _fields(graph):
        if number == _NODE:
            nodes += 1
            if nodes > _MAX_NODES:
                raise ValueError(f"it has more than {_MAX_NODES} layers")
            _check_node(_checked_bytes(value))
        elif number == _INITIALIZER:
            _check_tensor(_checked_bytes(value))
        elif number == _SPARSE_INITIALIZER:
            raise ValueError("it has sparse weights")


def _check_node(node: bytes) -> None:
    kind = domain = b""
    for number, value in _fields(node):
        if number == _TYPE:
            kind = _checked_bytes(value)
        elif number == _DOMAIN:
            domain = _checked_bytes(value)
        elif number == _ATTRIBUTE:
            _check_attribute(_checked_bytes(value))
    if domain not in _DOMAINS or kind.decode(errors="replace") not in ALLOWED_LAYERS:
        name = b".".join((domain, kind) if domain else (kind,)).decode(errors="replace")
        raise ValueError(f"its layer '{name:.60}' is none that an error model may have")


def _check_attribute(attribute: bytes) -> None:
    for number, value in _fields(attribute):
        if number in (_TENSOR, _TENSORS):
            _check_tensor(_checked_bytes(value))
        elif number in (_GRAPH_OF, _GRAPHS, _SPARSE, _SPARSES):
            raise ValueError("a layer of it holds a graph, or sparse numbers")


def _check_tensor(tensor: bytes) -> None:
    for number, value in _fields(tensor):
        if number == _EXTERNAL or (number == _LOCATION and value != 0):
            raise ValueError("its weights lie in other files; save it with its weights inside")


def _checked_bytes(value: bytes | int) -> bytes:
    if not isinstance(value, bytes):
        raise ValueError("it is no protocol buffer, or damaged")
    return value


def _fields(data: bytes) -> Iterator[tuple[int, bytes | int]]:
    """Number and value of each. Raises IndexError where they are cut short, ValueError."""
    offset = 0
    while offset < len(data):
        key, offset = _varint(data, offset)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, offset = _varint(data, offset)
            yield number, value
            continue
        if wire == _BYTES:
            length, offset = _varint(data, offset)
        elif wire in _FIXED:
            length = _FIXED[wire]
        else:
            raise ValueError("it is no protocol buffer, or damaged")
        if length > len(data) - offset:
            raise IndexError
        yield number, data[offset : offset + length]
        offset += length


def _varint(data: bytes, offset: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = data[offset]
        offset += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, offset
    raise ValueError("it is no protocol buffer, or damaged")
