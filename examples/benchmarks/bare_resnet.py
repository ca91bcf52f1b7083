"""A ResNet-18's forward pass as it is usually run, the yardstick of speed."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

from scroll_tactile.embeddings.resnet import ResNet

__all__ = ["Plain", "resnet18"]


class Plain(nn.Module):
    """A network without its classifier: all layers, batch normalisation as it was trained, one global average."""

    def __init__(self, net: ResNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, planes: torch.Tensor) -> torch.Tensor:
        """(B, 3, H, W) → (B, planes of layer 4, 1, 1)."""
        return functional.adaptive_avg_pool2d(self.net(planes)[-1], 1)


def resnet18(seed: int = 0) -> nn.Module:
    """The network with random weights, in evaluation mode: (B, 3, H, W) → (B, 512, 1, 1). Its work is the published."""
    return Plain(ResNet.random(seed)).eval()
