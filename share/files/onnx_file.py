"""Check an untrusted ONNX file before a runtime loads it. Pure: works on bytes.

Parses only the parts of the protocol buffer that matter (onnx.proto: ModelProto, GraphProto, NodeProto,
AttributeProto, TensorProto). Allows layers whose output is at most about as large as input and weights;
refuses layers that loop, branch, call, or make large tensors from a few bytes.
"""

from __future__ import annotations

from collections.abc import Iterator

# field numbers
_GRAPH, _FUNCTIONS = 7, 25  # ModelProto
_NODE, _INITIALIZER, _SPARSE_INITIALIZER = 1, 5, 15  # GraphProto
_TYPE, _ATTRIBUTE, _DOMAIN = 4, 5, 7  # NodeProto
_TENSOR, _GRAPH_OF, _TENSORS, _GRAPHS, _SPARSE, _SPARSES = 5, 6, 10, 11, 22, 23  # AttributeProto
_EXTERNAL, _LOCATION = 13, 14  # TensorProto
_BYTES, _FIXED = 2, {1: 8, 5: 4}  # wire types: length-delimited; fixed length, bytes by type
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
    """Raise ValueError that says why a file is not an allowed model."""
    try:
        parts = list(_fields(data))
        graphs = [value for number, value in parts if number == _GRAPH]
        if len(graphs) != 1 or not isinstance(graphs[0], bytes):
            raise ValueError("it has no graph")
        if any(number == _FUNCTIONS for number, _ in parts):
            raise ValueError("it defines functions")
        _check_graph(graphs[0])
    except IndexError:
        raise ValueError("it is not a protocol buffer, or cut short") from None


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
        raise ValueError(f"its layer '{name:.60}' is not allowed in an error model")


def _check_attribute(attribute: bytes) -> None:
    for number, value in _fields(attribute):
        if number in (_TENSOR, _TENSORS):
            _check_tensor(_checked_bytes(value))
        elif number in (_GRAPH_OF, _GRAPHS, _SPARSE, _SPARSES):
            raise ValueError("one of its layers holds a graph or sparse numbers")


def _check_tensor(tensor: bytes) -> None:
    for number, value in _fields(tensor):
        if number == _EXTERNAL or (number == _LOCATION and value != 0):
            raise ValueError("its weights are in other files; save the model with its weights inside")


def _checked_bytes(value: bytes | int) -> bytes:
    if not isinstance(value, bytes):
        raise ValueError("it is not a protocol buffer, or damaged")
    return value


def _fields(data: bytes) -> Iterator[tuple[int, bytes | int]]:
    """Yield number and value of each field. Raises IndexError if one is cut short, ValueError."""
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
            raise ValueError("it is not a protocol buffer, or damaged")
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
    raise ValueError("it is not a protocol buffer, or damaged")
