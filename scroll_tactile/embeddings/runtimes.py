"""Runtimes: what runs a frozen network on one thread, behind one small interface.

torch is always there. ONNX Runtime is given the same folded network, which torch traces: a folded network is
convolutions, ReLUs, sums and one max-pooling, without a branch on a size, and so its graph holds for any batch, height
and width. Each runtime gives the same bytes for the same planes, and other last bits than the other does.
"""

from __future__ import annotations

import importlib
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.libraries import optional

if TYPE_CHECKING:
    from torch import nn

    from scroll_tactile.embeddings.resnet import ResNet

__all__ = [
    "RUNTIMES",
    "Precision",
    "Run",
    "RuntimeName",
    "full_float32",
    "make_runtime",
    "network_model",
    "one_torch_thread",
    "onnx_model",
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
_TRACING = threading.Lock()  # torch refuses to trace in two threads


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


def network_model(net: ResNet, last: int) -> bytes:
    """An ONNX model from `planes` (B, 3, H, W) to the maps `stage_0` … `stage_<last>`, for any B, H and W.

    Raises InputError where the package onnx is missing.
    """
    import torch

    from scroll_tactile.embeddings.resnet import folded

    names = [f"stage_{i}" for i in range(last + 1)]
    axes = {"planes": {0: "B", 2: "H", 3: "W"}} | {name: {0: "B", 2: f"H_{name}", 3: f"W_{name}"} for name in names}
    return onnx_model(folded(net, last), (torch.zeros(1, 3, 32, 32), last), "planes", names, axes)


def onnx_model(
    module: nn.Module,
    example: tuple[Any, ...],
    name: str,
    outputs: list[str],
    axes: dict[str, dict[int, str]] | None = None,
    metadata: dict[str, str] | None = None,
) -> bytes:
    """The bytes of a module as an ONNX model with one input.

    example: what the module is called with to be traced. axes: those that may have any length, by input or output;
    all others are as long as in the example.

    Raises InputError where the package onnx is missing.
    """
    import torch

    with optional("onnx", "onnx", "an ONNX graph", "use runtime='torch'"):
        import onnx
    file = BytesIO()
    with _TRACING, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it is deprecated, and branches on sizes, which the example has
        torch.onnx.export(
            module,
            example,
            file,  # type: ignore[arg-type]
            input_names=[name],
            output_names=outputs,
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
        )
    model = onnx.load_from_string(file.getvalue())
    onnx.helper.set_model_props(model, metadata or {})
    onnx.checker.check_model(model, full_check=True)
    serialised: bytes = model.SerializeToString()
    return serialised
