"""In place of MobileNetV2, for tests: as large an output, at once."""

from __future__ import annotations

import numpy as np
from onnx import TensorProto, helper, numpy_helper


def tiny_backbone() -> bytes:
    """Means of 1280 blocks of the picture."""
    width = 128 * 128 // 1280  # 12 of the pixels in a row
    picture = helper.make_tensor_value_info("picture", TensorProto.UINT8, ["N", 128, 128])
    deep = helper.make_tensor_value_info("deep", TensorProto.FLOAT, ["N", 1280])
    blocks = np.zeros((128 * 128, 1280), np.float32)
    blocks[np.arange(1280 * width), np.arange(1280 * width) // width] = 1 / (255 * width)
    nodes = [
        helper.make_node("Cast", ["picture"], ["x"], "cast", to=TensorProto.FLOAT),
        helper.make_node("Flatten", ["x"], ["flat"], "flatten"),
        helper.make_node("MatMul", ["flat", "blocks"], ["deep"], "blocks of it"),
    ]
    graph = helper.make_graph(nodes, "tiny", [picture], [deep], [numpy_helper.from_array(blocks, "blocks")])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    return bytes(model.SerializeToString())
