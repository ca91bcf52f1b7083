"""Runtimes: what runs a frozen network on one thread, behind one small interface.

torch is always there. ONNX Runtime and OpenVINO are fed the same folded network as an ONNX graph of free height and
width. Each gives the same bytes for the same planes, and other last bits than the others do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
import torch

from scroll_tactile.embeddings.kernels import one_torch_thread
from scroll_tactile.embeddings.onnx_graph import network_model
from scroll_tactile.embeddings.resnet import ResNet, folded
from scroll_tactile.errors import InputError

__all__ = ["RUNTIMES", "Precision", "Run", "RuntimeName", "full_float32", "make_runtime", "steady", "version_of"]

FloatArray = npt.NDArray[np.float32]
RuntimeName = Literal["torch", "onnxruntime", "openvino"]
Precision = Literal["float32", "bfloat16"]

# Planes (B, 3, H, W), float32 → the maps of stages 0 to the last, each (B, planes, rows, columns), float32.
Run = Callable[[FloatArray], list[FloatArray]]

RUNTIMES: Final = {"torch": "torch", "onnxruntime": "onnx", "openvino": "openvino"}  # → the extra that brings it


def make_runtime(name: RuntimeName, net: ResNet, last: int, precision: Precision = "float32") -> Run:
    """Make ready to run the stages 0 to `last` of a network.

    precision: "bfloat16" for torch and OpenVINO, whose features then differ by half a percent, and which is faster
    only on processors that have it.

    Raises InputError for another name or precision, for bfloat16 in ONNX Runtime, and for a package that is missing.
    """
    if name not in RUNTIMES or precision not in ("float32", "bfloat16"):
        raise InputError(
            f"expected a runtime among {list(RUNTIMES)} and a precision 'float32' or 'bfloat16'; came {name!r}, "
            f"{precision!r}"
        )
    if name == "torch":
        return _torch(net, last, precision)
    if name == "onnxruntime":
        return _onnxruntime(net, last, precision)
    return _openvino(net, last, precision)


def version_of(name: RuntimeName) -> str:
    """The version of a runtime: another may give other last bits."""
    return str(_package(name).__version__)


@contextmanager
def steady() -> Iterator[None]:
    """Run torch so that one image gives one vector of bytes: one thread, full float32, no autocast, no gradients.

    With two threads an image of 60 × 75 gives other bits in layer 4 than with one.
    """
    with ExitStack() as stack:
        stack.enter_context(torch.inference_mode())
        stack.enter_context(torch.autocast("cpu", enabled=False))
        stack.enter_context(one_torch_thread())
        stack.enter_context(full_float32())
        yield


@contextmanager
def full_float32() -> Iterator[None]:
    """Keep float32 products at full precision where the caller's program allows shortened ones."""
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
            "ONNX Runtime has no bfloat16 convolutions on processors: use precision='float32', or runtime='torch' or "
            "'openvino' with bfloat16"
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


def _openvino(net: ResNet, last: int, precision: Precision) -> Run:
    runtime = _package("openvino")
    core = runtime.Core()
    settings = {
        "INFERENCE_NUM_THREADS": 1,
        "NUM_STREAMS": 1,
        # Said for float32 too: where the processor has bfloat16, OpenVINO would take it of its own accord.
        "INFERENCE_PRECISION_HINT": "bf16" if precision == "bfloat16" else "f32",
    }
    compiled: Any = core.compile_model(core.read_model(network_model(net, last)), "CPU", settings)

    def run(planes: FloatArray) -> list[FloatArray]:
        # A request of its own at each call: one that is kept serves one thread only.
        answer = compiled.create_infer_request().infer({"planes": planes})
        return [np.array(answer[stage], dtype=np.float32) for stage in range(last + 1)]

    return run


def _package(name: RuntimeName) -> Any:
    try:
        if name == "onnxruntime":
            import onnxruntime as found
        elif name == "openvino":
            import openvino as found
        else:
            found = torch
    except ImportError as error:
        raise InputError(
            f"runtime={name!r} needs the package {name}, which is not installed: "
            f"pip install 'scroll-tactile[{RUNTIMES[name]}]', or use runtime='torch'"
        ) from error
    return found
