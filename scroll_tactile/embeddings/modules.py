"""Any torch module as an embedding."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Sequence
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.protocol import Capabilities, canary
from scroll_tactile.embeddings.steady import steady
from scroll_tactile.errors import EmbeddingError, InputError
from scroll_tactile.libraries import optional
from scroll_tactile.signals.augmentation import fit

with optional("torch", "torch", "the embedding ModuleEmbedding"):
    import torch
    from torch import nn

__all__ = ["ModuleEmbedding"]

SHORTEST = 9  # steps that a module is given; modules of convolutions read no two steps
STEPS = (SHORTEST, 30, 75)  # of the fixed images that the fingerprint is taken of
CHANNELS = (1, 3, 19)


class ModuleEmbedding:
    """A torch module of one's own, from images (1, C, T) float32 in [-1, 1] to features (1, d), as an embedding.

    The module is copied, put into evaluation mode and frozen: what is done to the original later changes nothing. An
    image of fewer than nine steps is continued by its mirror image to nine before the module reads it.

    name: what messages call it. dimension: d. bound: no feature's magnitude exceeds it.
    partial_windows: whether it reads a touch narrower than a window as it reads a whole window.
    judged_scales: "all", or "widest" where one forward pass a touch is all that may be spent.
    channels: how many channels the fixed images of the fingerprint have; numbers that the module does not take
        are left out. Name those of the sensor where the module takes no others.

    `check_embedding` tells whether it keeps the promises of an embedding. Raises InputError for settings that cannot
    be; its methods raise EmbeddingError for an output that breaks a promise.

    >>> pool = nn.Sequential(nn.AdaptiveAvgPool2d((4, 4)), nn.Flatten())
    >>> ModuleEmbedding(pool, name="pool", dimension=16).embed(np.zeros((19, 30), np.float32)).shape
    (16,)
    """

    def __init__(
        self,
        module: nn.Module,
        *,
        name: str,
        dimension: int,
        bound: float = 1.0,
        partial_windows: bool = False,
        judged_scales: Literal["widest", "all"] = "all",
        channels: Sequence[int] = CHANNELS,
    ) -> None:
        if not isinstance(module, nn.Module):
            raise InputError(f"expected a torch module; came {type(module).__name__}")
        if dimension < 1 or not 0 < bound < float("inf"):
            raise InputError(f"expected a dimension of at least 1 and a positive bound; came {dimension}, {bound}")
        if judged_scales not in ("widest", "all"):
            raise InputError(f"judged_scales must be 'widest' or 'all'; came {judged_scales!r}")
        self.name = name
        self.dimension = dimension
        self.bound = bound
        self.capabilities = Capabilities(partial_windows=partial_windows, judged_scales=judged_scales)
        self._channels = tuple(channels)
        self._module = copy.deepcopy(module).eval().requires_grad_(False).cpu()

    def __repr__(self) -> str:
        return f"ModuleEmbedding({type(self._module).__name__}, name={self.name!r}, dimension={self.dimension})"

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the module's tensors, the settings, torch's version and the features of fixed images.

        Raises EmbeddingError where the module reads none of these images.
        """
        settings = (type(self._module).__qualname__, self.name, self.dimension, self.bound, torch.__version__)
        digest = hashlib.sha256(f"module 1 {settings}".encode())
        for name, tensor in sorted(self._module.state_dict().items()):
            digest.update(f"\n{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
        read = 0
        for image in (canary(channels, steps) for channels in self._channels for steps in STEPS):
            try:
                features = self.embed(image)
            except (RuntimeError, ValueError, IndexError):  # what torch says of an image that does not fit
                continue
            digest.update(f"\n{image.shape}".encode() + features.astype("<f4").tobytes())
            read += 1
        if not read:
            raise EmbeddingError(
                f"{self!r} reads no image of {self._channels} channels and {STEPS} columns: say in `channels` how "
                "many it takes"
            )
        return digest.hexdigest()

    def embed(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Features of shape (d,), float32, of a tactile image of shape (C, T) in [-1, 1].

        Raises EmbeddingError where the module's output has another shape. Whether features are finite and within the
        bound is looked at where they are learned from or judged by.
        """
        with steady():
            output = self._module(torch.tensor(fit(image, max(SHORTEST, image.shape[-1]))[None], dtype=torch.float32))
        if not isinstance(output, torch.Tensor) or output.shape != (1, self.dimension):
            came = tuple(output.shape) if isinstance(output, torch.Tensor) else type(output).__name__
            raise EmbeddingError(
                f"expected from {self!r} features of shape {(1, self.dimension)} for an image of {image.shape}; "
                f"came {came}"
            )
        return np.asarray(output[0].float().contiguous().numpy())
