"""ONNX files written byte by byte: the package that makes them is not needed, nor does it make bad ones."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from share.odometry.error_model.inputs import INPUT_SHAPES

FLOAT, UINT8 = 1, 2


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def field(number: int, value: int | bytes | str) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def tensor(name: str, dims: Sequence[int], values: Sequence[float] = (), extra: bytes = b"") -> bytes:
    """Return a tensor of floats. extra: more fields."""
    head = b"".join(field(1, d) for d in dims) + field(2, FLOAT) + field(8, name)
    return head + field(9, struct.pack(f"<{len(values)}f", *values)) + extra


def ints(name: str, values: Sequence[int]) -> bytes:
    return (
        field(1, len(values))
        + field(2, 7)
        + field(8, name)
        + field(9, struct.pack(f"<{len(values)}q", *values))
    )


def node(kind: str, inputs: Sequence[str], output: str, *attributes: bytes, domain: str = "") -> bytes:
    parts = [*(field(1, name) for name in inputs), field(2, output), field(4, kind)]
    return b"".join([*parts, *(field(5, one) for one in attributes), *([field(7, domain)] if domain else [])])


def number(name: str, value: int) -> bytes:
    """An attribute."""
    return field(1, name) + field(3, value) + field(20, 2)


def numbers(name: str, values: Sequence[int]) -> bytes:
    return field(1, name) + b"".join(field(8, v) for v in values) + field(20, 7)


def value_info(name: str, kind: int, dims: Sequence[int | str]) -> bytes:
    shape = b"".join(field(1, field(1, d) if isinstance(d, int) else field(2, d)) for d in dims)
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, shape)))


def model(
    nodes: Sequence[bytes],
    weights: Sequence[bytes],
    inputs: Sequence[bytes],
    outputs: Sequence[bytes],
    extra: bytes = b"",
) -> bytes:
    parts = [(1, nodes), (5, weights), (11, inputs), (12, outputs)]
    graph = field(2, "g") + b"".join(field(k, one) for k, some in parts for one in some)
    return field(1, 8) + field(7, graph) + field(8, field(2, 17)) + extra


INPUTS = [
    value_info(name, UINT8 if name == "picture" else FLOAT, ["N", *shape])
    for name, shape in INPUT_SHAPES.items()
]
OUTPUTS = [
    value_info("log_error", FLOAT, ["N", 3]),
    value_info("embedding", FLOAT, ["N", 64]),
    value_info("distance", FLOAT, ["N"]),
]


def small_error_model(
    says: Sequence[float] = (0.0, -1.0, 1.0),
    more: Sequence[bytes] = (),
    weights: Sequence[bytes] = (),
    first: str = "log_error",
) -> bytes:
    """One that always says the same, with `more` layers, which make of `first` what it says."""
    nodes = [
        node("Gemm", ["scalars", "w3", "says"], first),
        node("Gemm", ["scalars", "w64"], "embedding"),
        node("ReduceL2", ["embedding"], "distance", numbers("axes", [1]), number("keepdims", 0)),
        node("Cast", ["picture"], "seen", number("to", FLOAT)),
        *(node("ReduceMean", [name], f"of {name}") for name in ("seen", "psd", "recent")),
    ]
    own = [tensor("w3", [8, 3], [0.0] * 24), tensor("says", [3], says), tensor("w64", [8, 64], [0.0] * 512)]
    return model([*nodes, *more], [*own, *weights], INPUTS, OUTPUTS)
