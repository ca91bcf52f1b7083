"""The residual network of 18 layers that gives the maps of all its stages, for images of any size.

He et al. 2016 (arXiv 1512.03385), in the arrangement and with the tensors' names of torchvision, so that published
weights fit. Two stems: torchvision's, and that of Meta-Dataset's universal representations (Li et al. 2021, arXiv
2103.13841: 5 × 5, no max-pooling), which was made for smaller images.
"""

from __future__ import annotations

import copy
import math
from typing import Final, Literal, Self, cast

from scroll_tactile.libraries import optional

with optional("torch", "torch", "a residual network"):
    import torch
    from torch import nn
    from torch.nn import functional

__all__ = ["DEPTH", "ResNet", "Stem", "folded"]

Stem = Literal["torchvision", "universal"]

DEPTH: Final = 18  # as fingerprints and configurations name it
STEMS = {"torchvision": (7, 3), "universal": (5, 1)}  # kernel, padding; the stride is 2


class _Block(nn.Module):
    """Two 3 × 3 convolutions beside a shortcut."""

    def __init__(self, inputs: int, planes: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, planes, 3, stride, 1, bias=False)
        self.bn1: nn.Module = nn.BatchNorm2d(planes)
        self.conv2 = nn.Conv2d(planes, planes, 3, 1, 1, bias=False)
        self.bn2: nn.Module = nn.BatchNorm2d(planes)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or inputs != planes:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, planes, 1, stride, bias=False), nn.BatchNorm2d(planes))

    def forward(self, planes: torch.Tensor) -> torch.Tensor:
        inner: torch.Tensor = self.bn2(self.conv2(torch.relu_(self.bn1(self.conv1(planes)))))
        return torch.relu_(inner.add_(planes if self.downsample is None else self.downsample(planes)))


class ResNet(nn.Module):
    """A ResNet-18 without its classifier.

    stem: "torchvision" (7 × 7 of stride 2, then max-pooling) or "universal" (5 × 5 of stride 2, padded by 1, no
    pooling). Tensors are named as torchvision names them. A new one has torch's own initial weights; `random` makes one
    from a seed. widths: the planes of the maps of stages 0 to 4.
    """

    widths = (64, 64, 128, 256, 512)

    def __init__(self, stem: Stem = "torchvision") -> None:
        super().__init__()
        self.stem: Stem = stem
        kernel, padding = STEMS[stem]
        self.conv1 = nn.Conv2d(3, self.widths[0], kernel, 2, padding, bias=False)
        self.bn1: nn.Module = nn.BatchNorm2d(self.widths[0])
        for layer in range(1, 5):
            inputs, planes = self.widths[layer - 1 : layer + 1]
            blocks = _Block(inputs, planes, 1 if layer == 1 else 2), _Block(planes, planes, 1)
            setattr(self, f"layer{layer}", nn.Sequential(*blocks))

    @classmethod
    def random(cls, seed: int, stem: Stem = "torchvision") -> Self:
        """A network of random weights (He et al. 2015, arXiv 1502.01852, by fan-out), in evaluation mode.

        The same seed gives the same weights, and torch's own random state is left as it was.
        """
        net = cls.empty(stem)
        generator = torch.Generator(device="cpu").manual_seed(seed)
        for module in net.modules():
            if isinstance(module, nn.Conv2d):
                fan_out = module.out_channels * math.prod(module.kernel_size)
                nn.init.normal_(module.weight, 0.0, math.sqrt(2.0 / fan_out), generator)
        return net

    @classmethod
    def empty(cls, stem: Stem) -> Self:
        """A network in evaluation mode whose convolutions hold anything: to be filled, at no cost of initialising."""
        with torch.device("meta"):
            net = cls(stem)
        net.to_empty(device="cpu")
        for module in net.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.reset_parameters()
        return net.eval()

    def forward(self, planes: torch.Tensor, last: int = 4) -> list[torch.Tensor]:
        """Maps of the stages 0 to `last`, each of shape (B, widths[stage], rows, columns), of images (B, 3, H, W).

        Stage 0 is the stem after its ReLU, before max-pooling; 1 to 4 are the layers. What lies after `last` is not
        computed.
        """
        maps: list[torch.Tensor] = [torch.relu_(self.bn1(self.conv1(planes)))]
        for stage in range(1, last + 1):
            below = maps[-1]
            if stage == 1 and self.stem == "torchvision":
                below = functional.max_pool2d(below, 3, 2, 1)
            maps.append(self.get_submodule(f"layer{stage}")(below))
        return maps


def folded(net: ResNet, last: int) -> ResNet:
    """A copy for inference: batch normalisation folded into the convolutions, channels-last, nothing to be trained.

    last: stages after it are left out, with their weights. It gives the same maps, but for rounding, and is faster.
    """
    # Filled anew rather than copied whole: what lies after `last` is most of the weights.
    quick = copy.copy(net)
    stages = {name: int(name[-1]) if name.startswith("layer") else 0 for name in net._modules}
    quick._modules = {name: copy.deepcopy(net._modules[name]) for name, stage in stages.items() if stage <= last}
    for parent in list(quick.modules()):
        for conv_name, norm_name in (("conv1", "bn1"), ("conv2", "bn2"), ("0", "1")):
            norm, conv = parent._modules.get(norm_name), parent._modules.get(conv_name)
            if isinstance(norm, nn.BatchNorm2d) and isinstance(conv, nn.Conv2d):
                _fold(conv, norm)
                parent._modules[norm_name] = nn.Identity()
    quick.eval().requires_grad_(False)
    return quick.to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def _fold(conv: nn.Conv2d, norm: nn.BatchNorm2d) -> None:
    mean, variance = cast(torch.Tensor, norm.running_mean), cast(torch.Tensor, norm.running_var)
    # In double precision, so that folding rounds once.
    slope = norm.weight.double() / torch.sqrt(variance.double() + norm.eps)
    bias = norm.bias.double() - mean.double() * slope
    conv.weight = nn.Parameter((conv.weight.double() * slope[:, None, None, None]).float().detach())
    conv.bias = nn.Parameter(bias.float().detach())
