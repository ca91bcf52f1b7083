"""Runtimes: what runs a frozen network on one thread, behind one small interface.

torch is always there. ONNX Runtime is given the same folded network as an ONNX graph, which is written node by node: a
folded network is convolutions, ReLUs, sums and one max-pooling, and so its graph holds for any batch, height and width,
where tracing exporters specialise to the sizes that they were shown. Each runtime gives the same bytes for the same
planes, and other last bits than the other does.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.libraries import optional

if TYPE_CHECKING:
    from torch import nn

    from scroll_tactile.embeddings.resnet import ResNet

__all__ = [
    "OPSET",
    "RUNTIMES",
    "Graph",
    "Precision",
    "Run",
    "RuntimeName",
    "full_float32",
    "make_runtime",
    "network_model",
    "one_torch_thread",
    "steady",
    "version_of",
]

FloatArray = npt.NDArray[np.float32]
RuntimeName = Literal["torch", "onnxruntime"]
Precision = Literal["float32", "bfloat16"]

# Planes (B, 3, H, W), float32 → the maps of stages 0 to the last, each (B, planes, rows, columns), float32.
Run = Callable[[FloatArray], list[FloatArray]]

RUNTIMES: Final[tuple[RuntimeName, ...]] = ("torch", "onnxruntime")
OPSET: Final = 17  # of 2022: every ONNX Runtime in use reads it
IR_VERSION = 8  # the file format of that year; the onnx package would write its newest


def make_runtime(name: RuntimeName, net: ResNet, last: int, precision: Precision = "float32") -> Run:
    """Make ready to run the stages 0 to `last` of a network.

    precision: "bfloat16" for torch, whose features then differ by half a percent, and which is faster only on
    processors that have it.

    Raises InputError for another name or precision, for bfloat16 in ONNX Runtime, and for a package that is missing.
    """
    if name not in RUNTIMES or precision not in ("float32", "bfloat16"):
        raise InputError(
            f"expected a runtime among {list(RUNTIMES)} and a precision 'float32' or 'bfloat16'; came {name!r}, "
            f"{precision!r}"
        )
    return _torch(net, last, precision) if name == "torch" else _onnxruntime(net, last, precision)


def version_of(name: RuntimeName) -> str:
    """The version of a runtime: another may give other last bits."""
    return str(_package(name).__version__)


@contextmanager
def steady() -> Iterator[None]:
    """Run torch so that one image gives one vector of bytes: one thread, full float32, no autocast, no gradients.

    With two threads an image of 60 × 75 gives other bits in layer 4 than with one.
    """
    import torch

    with ExitStack() as stack:
        stack.enter_context(torch.inference_mode())
        stack.enter_context(torch.autocast("cpu", enabled=False))
        stack.enter_context(one_torch_thread())
        stack.enter_context(full_float32())
        yield


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run torch on one thread of its own accord.

    A touch is two milliseconds of small products: a second thread saves a fifth of it on an idle machine, and on a
    busy one, where threads wait for each other at every product, made it take forty times as long.
    """
    import torch

    threads = torch.get_num_threads()
    if threads == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def full_float32() -> Iterator[None]:
    """Keep float32 products at full precision where the caller's program allows shortened ones."""
    import torch

    before = torch.get_float32_matmul_precision()
    if before == "highest":
        yield
        return
    torch.set_float32_matmul_precision("highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def _torch(net: ResNet, last: int, precision: Precision) -> Run:
    import torch

    from scroll_tactile.embeddings.resnet import folded

    kind = torch.bfloat16 if precision == "bfloat16" else torch.float32
    quick = folded(net, last).to(kind)

    def run(planes: FloatArray) -> list[FloatArray]:
        image = torch.from_numpy(planes).to(kind).contiguous(memory_format=torch.channels_last)
        with torch.inference_mode():
            return [stage.float().numpy() for stage in quick(image, last)]

    return run


def _onnxruntime(net: ResNet, last: int, precision: Precision) -> Run:
    if precision != "float32":
        raise InputError(
            "ONNX Runtime has no bfloat16 convolutions on processors: use precision='float32', or runtime='torch' with "
            "bfloat16"
        )
    runtime = _package("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors: its warnings are about optimisations that it left out
    session = runtime.InferenceSession(network_model(net, last), options, providers=["CPUExecutionProvider"])

    def run(planes: FloatArray) -> list[FloatArray]:
        maps: list[FloatArray] = session.run(None, {"planes": planes})
        return maps

    return run


def _package(name: RuntimeName) -> Any:
    with optional(name, "onnx" if name == "onnxruntime" else "torch", f"runtime={name!r}"):
        return importlib.import_module(name)


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
            planes = maps[-1]
            if stage == 1 and quick.stem == "torchvision":
                planes = self.add("MaxPool", planes, kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
            blocks = list(quick.get_submodule(f"layer{stage}").children())
            for i, block in enumerate(blocks):
                planes = self._block(block, planes, f"{name}_{stage}" if i + 1 == len(blocks) else "")
            maps.append(planes)
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
        for i, convolution in enumerate(convolutions):
            inner = self._convolution(convolution, self.add("Relu", inner) if i else inner)
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
    from scroll_tactile.embeddings.resnet import folded

    graph = Graph()
    maps = graph.network(folded(net, last), "planes", last)
    shapes = {name: ["B", net.widths[i], f"H{i}", f"W{i}"] for i, name in enumerate(maps)}
    return graph.model({"planes": ["B", 3, "H", "W"]}, shapes)


def _onnx() -> Any:
    with optional("onnx", "onnx", "an ONNX graph", "use runtime='torch'"):
        import onnx
        import onnx.helper
        import onnx.numpy_helper
    return onnx
