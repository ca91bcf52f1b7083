"""A residual network's stages, averaged over windows: the embedding of the paper that this library follows."""

from __future__ import annotations

import copy
import hashlib
import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.protocol import TOGETHER, Capabilities, canary
from scroll_tactile.embeddings.resnet import DEPTH, ResNet, folded
from scroll_tactile.embeddings.steady import steady
from scroll_tactile.embeddings.weights import digest_of, hash_tensors, load_network, source_name
from scroll_tactile.errors import InputError
from scroll_tactile.libraries import optional
from scroll_tactile.signals.augmentation import fit

with optional("torch", "torch", "the embedding Vision"):
    import torch
    from torch import nn
    from torch.nn import functional

__all__ = ["TunableVision", "Vision", "pool_windows", "to_planes"]

FloatArray = npt.NDArray[np.float32]

# Of each colour plane in [0, 1], as torchvision's networks were trained.
MEAN = (0.485, 0.456, 0.406)
DEVIATION = (0.229, 0.224, 0.225)

# Windows of TOGETHER steps or more share one pass over the whole image: RoboSkin is classified 0.3 points better so
# than in windows apart, and one pass is cheaper. Narrower ones are cut out first, for early decisions rest on them, and
# these see only what was observed: pooled from a whole pass, the first 0.3 s were right in 7 % instead of 87.
MOST_STEPS = 4096  # of a whole image passed at once; of longer ones every window is read by itself, at bounded memory
LEAST = {"torchvision": 1, "universal": 3}  # rows and columns: a kernel has to fit the padded image


class Vision:
    """Stages of a ResNet, each averaged over a window and scaled to length 1, side by side.

    weights: torchvision's "resnet18", fetched once; a `.safetensors` or `.pth` file in torchvision's or Meta-Dataset's
        (URL) layout; a state dict; or None for a random network, the control that shows what the weights are worth.
    stages: which, ascending: 0 the stem, 1 to 4 the layers. Nothing after the last of them is computed.
    seed: of the random network.

    A touch narrower than a window is not read at that scale (`Capabilities.partial_windows`): a network is lost at a
    length that it did not learn from. Where several scales fit only the widest is judged (`judged_scales`), so that
    a touch costs one forward pass.

    It runs in float32. One image gives the same bytes whatever was embedded before; another machine or version of torch
    may give other last bits, and so another fingerprint.

    Raises WeightsError for weights that cannot be used, InputError for settings that do not fit.

    >>> import numpy as np
    >>> Vision(None, seed=0, stages=(1, 2)).embed(np.zeros((19, 400), dtype=np.float32)).shape
    (192,)
    """

    name = "vision"
    bound = 1.0
    capabilities = Capabilities(partial_windows=False, judged_scales="widest", embeds_windows=True, tunable=True)

    def __init__(
        self,
        weights: str | os.PathLike[str] | Mapping[str, torch.Tensor] | None = "resnet18",
        *,
        stages: Sequence[int] = (1, 2, 3),
        seed: int | None = None,
    ) -> None:
        self.stages = tuple(stages)
        if not self.stages or list(self.stages) != sorted(set(self.stages) & set(range(5))):
            raise InputError(f"expected stages from 0 to 4, ascending, each once; came {self.stages}")
        if (weights is None) != (seed is not None):
            raise InputError(
                f"a random network, weights=None, and only that, needs a seed; came seed={seed!r} with weights "
                f"{'None' if weights is None else 'given'}"
            )
        self.seed = seed
        self._source = source_name(weights)
        net = load_network(weights) if weights is not None else ResNet.random(cast(int, seed))
        self._net = net.requires_grad_(False)
        self._quick = folded(self._net, self.stages[-1])
        self.dimension = sum(self._net.widths[stage] for stage in self.stages)

    def __repr__(self) -> str:
        source = repr(self._source or "<state dict>") if self.seed is None else f"None, seed={self.seed}"
        return f"Vision({source}, stages={self.stages})"

    def configuration(self) -> dict[str, Any]:
        """What makes an equal one, in JSON's types; of weights their file's name and their hash."""
        weights = {"name": self._source, "sha256": digest_of(self._net)} if self.seed is None else None
        network = {"weights": weights, "seed": self.seed, "depth": DEPTH, "stem": self._net.stem}
        return {"kind": "vision", **network, "stages": list(self.stages)}

    @cached_property
    def fingerprint(self) -> str:
        """A hash of all the tensors, the settings, torch's version and the features of three fixed images."""
        settings = (DEPTH, self._net.stem, self.stages, torch.__version__)
        digest = hashlib.sha256(f"vision 1 {settings} {MEAN} {DEVIATION} {TOGETHER}".encode())
        hash_tensors(digest, self._net)
        for channels, steps in ((3, 9), (19, 30), (60, 75)):
            digest.update(self.embed(canary(channels, steps)).astype("<f4").tobytes())
        return digest.hexdigest()

    def embed(self, image: npt.NDArray[np.float32]) -> FloatArray:
        """Features in [0, 1], float32 of shape (d,), of a tactile image of shape (C, T) in [-1, 1].

        Raises InputError for an image that has not two axes, or an empty one.
        """
        image = self._readable(image)
        return np.asarray(self._read(image, [(0, image.shape[1])])[0])

    def embed_windows(
        self, image: npt.NDArray[np.float32], windows: Mapping[int, Sequence[int]]
    ) -> dict[int, FloatArray]:
        """Embed windows of an image: width → first steps, to width → features (windows, d).

        Windows of 48 steps or more are averaged from one pass over the whole image, so that they also see a little
        of what lies beside them. A narrower one is what `embed` gives for it alone, to the bit.
        """
        image = self._readable(image)
        steps = image.shape[1]
        wide = [width for width in windows if width >= TOGETHER and steps <= MOST_STEPS]
        places = [(start, width) for width in wide for start in windows[width]]
        pooled = iter(self._read(image, places)) if places else iter(())
        features: dict[int, FloatArray] = {}
        for width, starts in windows.items():
            rows = (
                [next(pooled) for _ in starts]
                if width in wide
                else [self.embed(np.ascontiguousarray(image[:, start : start + width])) for start in starts]
            )
            features[width] = np.stack(rows)
        return features

    def network(self) -> TunableVision:
        """A copy of the network that can be trained, with this embedding's reading of windows around it.

        A new one at each call: training it changes nothing here. `Vision(tuned.net.state_dict(), …)` is the embedding
        of what was trained.
        """
        net = copy.deepcopy(self._net).requires_grad_(True)
        return TunableVision(net, self.stages)

    def _readable(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The image, continued by its mirror image where it has fewer steps than the network can read."""
        if image.ndim != 2 or 0 in image.shape:
            raise InputError(f"expected a tactile image of shape (C, T); came {image.shape}")
        least = LEAST[self._net.stem]
        if len(image) < least:
            raise InputError(
                f"expected a tactile image of at least {least} channels, which the {self._net.stem} stem needs; came "
                f"{image.shape}. Take weights in torchvision's layout, or Kernels"
            )
        return image if image.shape[1] >= least else fit(np.asarray(image, np.float32), least)

    def _read(self, image: npt.NDArray[np.float32], windows: Sequence[tuple[int, int]]) -> FloatArray:
        """Features (windows, d) from one pass over an image."""
        with steady():
            planes = to_planes(torch.tensor(image[None], dtype=torch.float32))
            maps = self._quick(planes.contiguous(memory_format=torch.channels_last), self.stages[-1])
            pooled = pool_windows([maps[stage] for stage in self.stages], image.shape[1], windows)[0]
            # Rounding may pass 1 by a unit in the last place.
            return np.asarray(np.minimum(pooled.numpy(), np.float32(1)))


class TunableVision(nn.Module):
    """The differentiable twin of a Vision, in float32: `net` is its ResNet, to be trained.

    Batch normalisation keeps its statistics, in training mode too: a robot's few touches would spoil them.
    """

    def __init__(self, net: ResNet, stages: Sequence[int]) -> None:
        super().__init__()
        self.net = net
        self.stages = tuple(stages)
        self.eval()

    def train(self, mode: bool = True) -> TunableVision:
        """Stay in evaluation mode, whatever is asked for; parameters are trained none the less."""
        super().train(False)
        return self

    def forward(self, images: torch.Tensor, windows: Sequence[tuple[int, int]]) -> torch.Tensor:
        """Features (B, windows, d) of images (B, C, T) in [-1, 1], at windows (first step, width).

        Equal to the embedding's but for rounding; all windows are averaged from one pass.
        """
        maps = self.net(to_planes(images), self.stages[-1])
        return pool_windows([maps[stage] for stage in self.stages], images.shape[-1], windows)


def to_planes(images: torch.Tensor) -> torch.Tensor:
    """Tactile images (B, C, T) in [-1, 1] as colour planes (B, 3, C, T), scaled as in the networks' training.

    Images that have three planes already, (B, 3, H, W), are scaled only.
    """
    mean = torch.tensor(MEAN, dtype=images.dtype, device=images.device)[:, None, None]
    deviation = torch.tensor(DEVIATION, dtype=images.dtype, device=images.device)[:, None, None]
    planes = images if images.ndim == 4 else images[:, None]
    return ((planes + 1) / 2 - mean) / deviation


def pool_windows(maps: Sequence[torch.Tensor], steps: int, windows: Sequence[tuple[int, int]]) -> torch.Tensor:
    """Average maps over windows: features (B, windows, d), each map's part of them of length 1.

    maps: of some stages, each (B, planes, rows, W), of an image of so many steps. windows: (first step, width) in
    steps of the image; one that reaches beyond it is taken as far as it goes. Averaged are all rows, and the
    columns of the map that the window covers, at least one. A part that is zero stays zero.
    """
    parts = []
    for stage in maps:
        across = stage.shape[-1]
        # Window by window: what is asked for beside a window must not change its bits, and a product would.
        averages = []
        for start, width in windows:
            first = start * across // steps
            after = max(first + 1, -(-min(start + width, steps) * across // steps))
            averages.append(stage[..., first:after].mean(dim=(2, 3)))
        parts.append(functional.normalize(torch.stack(averages, dim=1), dim=-1))
    return torch.cat(parts, dim=-1)
