"""A control: an embedding that nobody trained or designed, one convolution along time with random weights."""

from __future__ import annotations

import torch
from torch import nn

from scroll_tactile.embeddings.modules import ModuleEmbedding

__all__ = ["random_convolution"]


class _Convolution(nn.Module):
    """tanh of the mean and of the maximum over time of relu(w * x), for random kernels w over all channels."""

    def __init__(self, channels: int, kernels: int, columns: int, seed: int) -> None:
        super().__init__()
        weights = torch.randn(kernels, channels, columns, generator=torch.Generator().manual_seed(seed))
        self.register_buffer("kernels", weights / (channels * columns) ** 0.5)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Features (1, 2 kernels) of images (1, C, T)."""
        responses = torch.relu(nn.functional.conv1d(images, self.get_buffer("kernels")))
        return torch.tanh(torch.cat([responses.mean(dim=2), responses.amax(dim=2)], dim=1))


def random_convolution(channels: int, seed: int = 0, *, dimension: int = 1008, columns: int = 9) -> ModuleEmbedding:
    """The embedding for a sensor of so many channels; of `dimension` features, an even number."""
    module = _Convolution(channels, dimension // 2, columns, seed)
    return ModuleEmbedding(module, name="random Conv1d", dimension=dimension, channels=(channels,))
