"""Export of the aggregation network to ONNX, with weights of 16 bits that are computed with 32."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from beamsplat.services.fusion.learned_aggregation import METADATA_KEY
from beamsplat.services.fusion.learned_inputs import CHANNELS, INPUTS_VERSION, OUTPUTS
from beamsplat.tools.training.network import AggregationNetwork, ResidualBlock

_OPSET, _IR_VERSION = 17, 8


class _Graph:
    """Nodes and weights of a graph; each method adds one operation and returns the name of its output."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = [
            numpy_helper.from_array(np.array([1.0, 1.0, 2.0, 2.0], np.float32), "twice")
        ]

    def _add(self, operation: str, inputs: list[str], output: str = "", **attributes: Any) -> str:
        name = output or f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, inputs, [name], **attributes))
        return name

    def conv(self, x: str, module: nn.Conv2d, name: str, output: str = "") -> str:
        wide = []
        for part, tensor in (("weight", module.weight), ("bias", module.bias)):
            assert tensor is not None
            values = tensor.detach().cpu().numpy().astype(np.float16)
            self.weights.append(numpy_helper.from_array(values, f"{name}.{part}"))
            wide.append(self._add("Cast", [f"{name}.{part}"], to=TensorProto.FLOAT))
        pad, stride, size = int(module.padding[0]), int(module.stride[0]), int(module.kernel_size[0])
        return self._add(
            "Conv", [x, *wide], output, kernel_shape=[size, size], pads=[pad] * 4, strides=[stride] * 2
        )

    def relu(self, x: str) -> str:
        return self._add("Relu", [x])

    def sum(self, x: str, y: str) -> str:
        return self._add("Add", [x, y])

    def twice(self, x: str) -> str:
        return self._add(
            "Resize", [x, "", "twice"], mode="nearest", nearest_mode="floor",
            coordinate_transformation_mode="asymmetric",
        )  # fmt: skip

    def block(self, x: str, module: ResidualBlock, name: str) -> str:
        inside = self.relu(self.conv(self.relu(x), module.first, f"{name}.first"))
        return self.sum(x, self.conv(inside, module.second, f"{name}.second"))


def onnx_bytes(network: AggregationNetwork, metadata: dict[str, str]) -> bytes:
    """Return the network as an ONNX file; the same network and metadata yield the same bytes.

    The input is [1, CHANNELS, h, w], the output [1, OUTPUTS, h, w]; h and w are free multiples of
    `learned_inputs.MULTIPLE`.
    """
    graph = _Graph()
    x = graph.conv("features", network.enter, "enter")
    x = graph.sum(x, graph.conv(graph.relu(x), network.local, "local"))
    skipped = [x]
    for k, (down, inner) in enumerate(zip(network.down, network.inner)):
        assert isinstance(down, nn.Conv2d)
        assert isinstance(inner, ResidualBlock)
        x = graph.block(graph.conv(graph.relu(x), down, f"down{k}"), inner, f"inner{k}")
        skipped.append(x)
    x = graph.block(skipped.pop(), network.bottom, "bottom")
    for k, up in enumerate(network.up):
        assert isinstance(up, nn.Conv2d)
        x = graph.sum(skipped.pop(), graph.twice(graph.conv(graph.relu(x), up, f"up{k}")))
        if k < len(network.outer):
            outer = network.outer[k]
            assert isinstance(outer, ResidualBlock)
            x = graph.block(x, outer, f"outer{k}")
    x = graph.sum(x, graph.conv(graph.relu(x), network.last, "last"))
    graph.conv(graph.relu(x), network.leave, "leave", output="output")
    model = helper.make_model(
        helper.make_graph(
            graph.nodes, "aggregation",
            [helper.make_tensor_value_info("features", TensorProto.FLOAT, [1, CHANNELS, "h", "w"])],
            [helper.make_tensor_value_info("output", TensorProto.FLOAT, [1, OUTPUTS, "h", "w"])],
            graph.weights,
        ),
        opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION, producer_name="beamsplat",
    )  # fmt: skip
    helper.set_model_props(model, {METADATA_KEY: str(INPUTS_VERSION), **metadata})
    onnx.checker.check_model(model)
    return model.SerializeToString(deterministic=True)
