"""How torch is run so that one image gives one vector of bytes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["full_float32", "one_torch_thread", "steady"]


@contextmanager
def steady() -> Iterator[None]:
    """Run torch so that one image gives one vector of bytes: one thread, full float32, no autocast, no gradients.

    With two threads an image of 60 × 75 gives other bits in layer 4 than with one.
    """
    import torch

    with torch.inference_mode(), torch.autocast("cpu", enabled=False), one_torch_thread(), full_float32():
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
