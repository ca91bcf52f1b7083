"""A folded residual network as an ONNX graph.

Written node by node: a folded network is convolutions, ReLUs, sums and one max-pooling, and so its graph holds for
any batch, height and width, where tracing exporters specialise to the sizes that they were shown.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from torch import nn

from scroll_tactile.embeddings.resnet import ResNet, folded
from scroll_tactile.errors import InputError

__all__ = ["OPSET", "Graph", "network_model"]

OPSET = 17  # of 2022: every ONNX Runtime and OpenVINO in use reads it
IR_VERSION = 8  # the file format of that year; the onnx package would write its newest


class Graph:
    """Nodes and constants of a graph under construction; each method returns the name of what it adds."""

    def __init__(self) -> None:
        self.onnx = _onnx()
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._weights: dict[nn.Conv2d, tuple[str, str]] = {}

    def add(self, kind: str, *inputs: str, name: str = "", **attributes: Any) -> str:
        """Add an operator with one output, called `name` where one is given."""
        name = name or f"{kind}_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, list(inputs), [name], name=name, **attributes))
        return name

    def constant(self, values: npt.ArrayLike) -> str:
        """Add an array."""
        name = f"constant_{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def network(self, quick: ResNet, planes: str, last: int, name: str = "stage") -> list[str]:
        """Add stages 0 to `last` of a folded network to its input `planes`; the names of their maps, name_0 …

        The same network can be added for several inputs: its weights are kept once.
        """
        maps = [self.add("Relu", self._convolution(quick.conv1, planes), name=f"{name}_0")]
        for stage in range(1, last + 1):
            at = maps[-1]
            if stage == 1 and quick.stem == "torchvision":
                at = self.add("MaxPool", at, kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
            blocks = list(quick.get_submodule(f"layer{stage}").children())
            for place, block in enumerate(blocks):
                at = self._block(block, at, f"{name}_{stage}" if place + 1 == len(blocks) else "")
            maps.append(at)
        return maps

    def model(self, inputs: dict[str, list[Any]], outputs: dict[str, list[Any]], **metadata: str) -> bytes:
        """The bytes of the finished model; float32 inputs and outputs by name, with their shapes."""
        helper, kind = self.onnx.helper, self.onnx.TensorProto.FLOAT
        made = helper.make_graph(
            self.nodes,
            "scroll-tactile",
            [helper.make_tensor_value_info(name, kind, shape) for name, shape in inputs.items()],
            [helper.make_tensor_value_info(name, kind, shape) for name, shape in outputs.items()],
            self.constants,
        )
        model = helper.make_model(
            made, producer_name="scroll-tactile", opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
        )
        helper.set_model_props(model, metadata)
        self.onnx.checker.check_model(model, full_check=True)
        serialised: bytes = model.SerializeToString()
        return serialised

    def _block(self, block: Any, planes: str, name: str) -> str:
        convolutions = [block.conv1, block.conv2] + ([block.conv3] if block.bottleneck else [])
        inner = planes
        for place, convolution in enumerate(convolutions):
            inner = self._convolution(convolution, self.add("Relu", inner) if place else inner)
        shortcut = planes if block.downsample is None else self._convolution(block.downsample[0], planes)
        return self.add("Relu", self.add("Add", inner, shortcut), name=name)

    def _convolution(self, convolution: nn.Conv2d, planes: str) -> str:
        assert convolution.bias is not None
        assert not isinstance(convolution.padding, str)
        if convolution not in self._weights:
            weight, bias = self.constant(convolution.weight.numpy()), self.constant(convolution.bias.numpy())
            self._weights[convolution] = weight, bias
        return self.add(
            "Conv",
            planes,
            *self._weights[convolution],
            kernel_shape=list(convolution.kernel_size),
            strides=list(convolution.stride),
            pads=[*convolution.padding, *convolution.padding],
        )


def network_model(net: ResNet, last: int) -> bytes:
    """An ONNX model from `planes` (B, 3, H, W) to the maps `stage_0` … `stage_<last>`, for any B, H and W.

    Raises InputError where the package onnx is missing.
    """
    graph = Graph()
    maps = graph.network(folded(net, last), "planes", last)
    shapes = {name: ["B", net.widths[at], f"H{at}", f"W{at}"] for at, name in enumerate(maps)}
    return graph.model({"planes": ["B", 3, "H", "W"]}, shapes)


def _onnx() -> Any:
    try:
        import onnx
        import onnx.helper
        import onnx.numpy_helper
    except ImportError as error:
        raise InputError(
            "an ONNX graph needs the package onnx, which is not installed: pip install 'scroll-tactile[onnx]', or use "
            "runtime='torch'"
        ) from error
    return onnx
