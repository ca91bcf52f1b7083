"""Residual networks that give the maps of all their stages, for images of any size.

He et al. 2016 (arXiv 1512.03385), in the arrangement and with the tensors' names of torchvision, so that published
weights fit. Two stems: torchvision's, and that of Meta-Dataset's universal representations (Li et al. 2021, arXiv
2103.13841: 5 × 5, no max-pooling), which was made for smaller images.
"""

from __future__ import annotations

import copy
import math
from typing import Literal, Self

from scroll_tactile.errors import InputError
from scroll_tactile.libraries import optional

with optional("torch", "torch", "a residual network"):
    import torch
    from torch import nn
    from torch.nn import functional

__all__ = ["BLOCKS", "ResNet", "Stem", "folded"]

Stem = Literal["torchvision", "universal"]

BLOCKS = {18: (2, 2, 2, 2), 34: (3, 4, 6, 3), 50: (3, 4, 6, 3)}  # depth → residual blocks of layers 1 to 4
BOTTLENECK = 50  # the depth from which blocks are bottlenecks
EXPANSION = 4  # of a bottleneck: its last convolution has this many times the others' planes
FIRST = 64  # planes of the stem
STEMS = {"torchvision": (7, 3), "universal": (5, 1)}  # kernel, padding; the stride is 2


class _Block(nn.Module):
    """Convolutions beside a shortcut: two 3 × 3, or in a bottleneck 1 × 1, 3 × 3, 1 × 1."""

    conv1: nn.Conv2d
    conv2: nn.Conv2d
    conv3: nn.Conv2d  # of a bottleneck; so is bn3
    bn1: nn.Module
    bn2: nn.Module
    bn3: nn.Module

    def __init__(self, inputs: int, planes: int, stride: int, bottleneck: bool) -> None:
        super().__init__()
        self.bottleneck = bottleneck
        outputs = planes * (EXPANSION if bottleneck else 1)
        # (inputs, outputs, kernel, stride); torchvision's bottlenecks have the stride in the 3 × 3.
        shapes = [(inputs, planes, 3, stride), (planes, planes, 3, 1)]
        if bottleneck:
            shapes = [(inputs, planes, 1, 1), (planes, planes, 3, stride), (planes, outputs, 1, 1)]
        for i, (into, out, kernel, step) in enumerate(shapes, start=1):
            setattr(self, f"conv{i}", nn.Conv2d(into, out, kernel, step, kernel // 2, bias=False))
            setattr(self, f"bn{i}", nn.BatchNorm2d(out))
        self.downsample: nn.Sequential | None = None
        if stride != 1 or inputs != outputs:
            shortcut = nn.Conv2d(inputs, outputs, 1, stride, bias=False)
            self.downsample = nn.Sequential(shortcut, nn.BatchNorm2d(outputs))

    def forward(self, planes: torch.Tensor) -> torch.Tensor:
        inner: torch.Tensor = self.bn2(self.conv2(torch.relu_(self.bn1(self.conv1(planes)))))
        if self.bottleneck:
            inner = self.bn3(self.conv3(torch.relu_(inner)))
        shortcut = planes if self.downsample is None else self.downsample(planes)
        return torch.relu_(inner.add_(shortcut))


class ResNet(nn.Module):
    """A residual network without its classifier.

    depth: 18, 34 (blocks of two 3 × 3 convolutions) or 50 (bottlenecks). stem: "torchvision" (7 × 7 of stride 2, then
    max-pooling) or "universal" (5 × 5 of stride 2, padded by 1, no pooling). Tensors are named as torchvision names
    them. A new one has torch's own initial weights; `random` makes one from a seed.

    Raises InputError for another depth or stem.
    """

    def __init__(self, depth: int = 18, stem: Stem = "torchvision") -> None:
        if depth not in BLOCKS or stem not in STEMS:
            raise InputError(
                f"expected a depth among {sorted(BLOCKS)} and a stem among {sorted(STEMS)}; came {depth!r}, {stem!r}"
            )
        super().__init__()
        self.depth = depth
        self.stem: Stem = stem
        kernel, padding = STEMS[stem]
        self.conv1 = nn.Conv2d(3, FIRST, kernel, 2, padding, bias=False)
        self.bn1: nn.Module = nn.BatchNorm2d(FIRST)
        bottleneck = depth >= BOTTLENECK
        inputs = FIRST
        for layer, blocks in enumerate(BLOCKS[depth], start=1):
            planes = FIRST * 2 ** (layer - 1)
            outputs = self.widths[layer]
            strides = [1 if layer == 1 else 2] + [1] * (blocks - 1)
            made = [_Block(outputs if i else inputs, planes, s, bottleneck) for i, s in enumerate(strides)]
            setattr(self, f"layer{layer}", nn.Sequential(*made))
            inputs = outputs

    @property
    def widths(self) -> tuple[int, ...]:
        """The planes of the maps of stages 0 to 4: (64, 64, 128, 256, 512) for depths 18 and 34."""
        expansion = EXPANSION if self.depth >= BOTTLENECK else 1
        return (FIRST, *(FIRST * 2**layer * expansion for layer in range(4)))

    @classmethod
    def random(cls, seed: int, depth: int = 18, stem: Stem = "torchvision") -> Self:
        """A network of random weights (He et al. 2015, arXiv 1502.01852, by fan-out), in evaluation mode.

        The same seed gives the same weights, and torch's own random state is left as it was.
        """
        net = cls.empty(depth, stem)
        generator = torch.Generator(device="cpu").manual_seed(seed)
        for module in net.modules():
            if isinstance(module, nn.Conv2d):
                fan_out = module.out_channels * math.prod(module.kernel_size)
                with torch.no_grad():
                    module.weight.normal_(0.0, math.sqrt(2.0 / fan_out), generator=generator)
        return net

    @classmethod
    def empty(cls, depth: int, stem: Stem) -> Self:
        """A network in evaluation mode whose convolutions hold anything: to be filled, at no cost of initialising."""
        with torch.device("meta"):
            net = cls(depth, stem)
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


def folded(net: ResNet, last: int = 4) -> ResNet:
    """A copy for inference: batch normalisation folded into the convolutions, channels-last, nothing to be trained.

    last: stages after it are left out, with their weights. It gives the same maps, but for rounding, and is faster.
    """
    # Filled anew rather than copied whole: what lies after `last` is most of the weights.
    quick = copy.copy(net)
    quick._modules = {name: copy.deepcopy(module) for name, module in net.named_children() if _stage(name) <= last}
    for parent in list(quick.modules()):
        for conv_name, norm_name in (("conv1", "bn1"), ("conv2", "bn2"), ("conv3", "bn3"), ("0", "1")):
            norm = parent._modules.get(norm_name)
            if isinstance(norm, nn.BatchNorm2d):
                conv = parent._modules[conv_name]
                assert isinstance(conv, nn.Conv2d)
                parent._modules[conv_name] = _fold(conv, norm)
                parent._modules[norm_name] = nn.Identity()
    quick.eval().requires_grad_(False)
    return quick.to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def _stage(name: str) -> int:
    return int(name.removeprefix("layer")) if name.startswith("layer") else 0


def _fold(conv: nn.Conv2d, norm: nn.BatchNorm2d) -> nn.Conv2d:
    assert norm.running_mean is not None
    assert norm.running_var is not None
    # In double precision, so that folding rounds once.
    slope = norm.weight.double() / torch.sqrt(norm.running_var.double() + norm.eps)
    with torch.device("meta"):
        both = nn.Conv2d(
            conv.in_channels,
            conv.out_channels,
            conv.kernel_size,  # type: ignore[arg-type]
            conv.stride,  # type: ignore[arg-type]
            conv.padding,  # type: ignore[arg-type]
        )
    weight = conv.weight.double() * slope[:, None, None, None]
    bias = norm.bias.double() - norm.running_mean.double() * slope
    both.weight = nn.Parameter(weight.float().detach(), requires_grad=False)
    both.bias = nn.Parameter(bias.float().detach(), requires_grad=False)
    return both
