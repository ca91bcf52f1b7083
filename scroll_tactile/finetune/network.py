"""What f* reads a touch with: the frozen features, and a network whose tensors can be others than the embedding's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.protocol import TOGETHER, Embedding, capabilities_of, embed_windows, parts_of
from scroll_tactile.embeddings.resnet import folded
from scroll_tactile.embeddings.steady import steady
from scroll_tactile.embeddings.vision import MOST_STEPS, TunableVision, Vision
from scroll_tactile.errors import MismatchError
from scroll_tactile.libraries import optional
from scroll_tactile.memory.touch_rows import Codes
from scroll_tactile.memory.tuned import Tuned
from scroll_tactile.prediction.predictor import LogitsReader, Predictor
from scroll_tactile.signals.windows import WindowPlan

with optional("torch", "torch", "a fine-tune"):
    import torch
    from torch import nn
    from torch.nn import functional

__all__ = ["Backbone", "TouchFeatures", "TrainingSample", "TunedReader", "adapted", "reader_of"]

FloatArray = npt.NDArray[np.float64]

ADAPTER = 1e-4  # of the identity that an adapter begins as
# Of features that lie in [-1, 1]: one that hardly varies among the exemplars must not be blown up, or a touch in which
# it does decides the answer. With 0.001 an f* of BioTac's kernels had 89.5 %, with 0.05 it has 98.5.
SPREAD_FLOOR = 0.05


@dataclass(frozen=True)
class TrainingSample:
    """An exemplar made ready: its tactile image, and of each judging scale the mean of its windows' frozen features.

    frozen: width → float64 (d,), zero where the features come from the network. codes: the rows that it added to the
    statistics.
    """

    material: str
    key: bytes
    image: npt.NDArray[np.float32]
    frozen: Mapping[int, FloatArray]
    codes: Codes = field(default_factory=dict)


class Backbone(nn.Module):
    """A network, batch normalisation folded into it, that gives the features of windows and can be trained."""

    def __init__(self, twin: TunableVision) -> None:
        super().__init__()
        self.twin = TunableVision(folded(twin.net, twin.stages[-1]), twin.stages)
        self.twin.requires_grad_(True)

    def forward(self, images: torch.Tensor, windows: Sequence[tuple[int, int]]) -> torch.Tensor:
        """Features (B, windows, d) of images (B, C, T) at windows (first column, width)."""
        return self.twin.forward(images.contiguous(), windows)

    def tensors(self) -> dict[str, npt.NDArray[np.float32]]:
        """The tensors that are trained, by name."""
        return {
            name: parameter.detach().cpu().contiguous().numpy().copy()
            for name, parameter in self.named_parameters()
            if parameter.requires_grad
        }

    def put(self, tensors: Mapping[str, npt.NDArray[np.float32]]) -> None:
        """Replace tensors by those that `tensors` returned. Raises MismatchError for others."""
        parameters = dict(self.named_parameters())
        others = [
            name
            for name, tensor in tensors.items()
            if name not in parameters or tuple(parameters[name].shape) != tensor.shape
        ]
        if others:
            raise MismatchError(f"f* trained {others[:5]}, which this network does not have so: fine-tune again")
        with torch.no_grad():
            for name, tensor in tensors.items():
                parameters[name].copy_(torch.from_numpy(tensor))


class _Adapted(nn.Module):
    """A convolution with a 1 × 1 one beside it, of the same stride: y = conv(x) + α x."""

    def __init__(self, conv: nn.Conv2d) -> None:
        super().__init__()
        self.conv = conv.requires_grad_(False)
        self.alpha = nn.Parameter(
            ADAPTER * torch.eye(conv.out_channels, conv.in_channels, dtype=conv.weight.dtype)[:, :, None, None]
        )

    def forward(self, planes: torch.Tensor) -> torch.Tensor:
        return self.conv.forward(planes) + functional.conv2d(planes, self.alpha, stride=self.conv.stride)


def adapted(net: Backbone) -> Backbone:
    """The network with an adapter beside every 3 × 3 convolution, and all but the adapters frozen."""
    net.requires_grad_(False)
    for parent in list(net.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, nn.Conv2d) and child.kernel_size == (3, 3):
                setattr(parent, name, _Adapted(child))
    return net


class TouchFeatures:
    """Mean features of touches, by scale, with the embedding's frozen parts and any network for the rest.

    Features are shares of the embedding's bound. Of several parts only the first tunable one is tuned, and of the
    scales only those whose windows share one pass; narrower windows stay as the embedding reads them, each by itself.
    """

    def __init__(self, embedding: Embedding, plan: WindowPlan) -> None:
        self.parts = parts_of(embedding)
        self.plan = plan
        self._tuned = next((i for i, part in enumerate(self.parts) if capabilities_of(part).tunable), None)
        edges = np.cumsum([0, *(part.dimension for part in self.parts)])
        self.dimension = int(edges[-1])
        self._place = (
            slice(0, 0) if self._tuned is None else slice(int(edges[self._tuned]), int(edges[self._tuned + 1]))
        )

    @property
    def tunable(self) -> bool:
        """Whether there is a network to be trained, and a scale that it reads."""
        return self._tuned is not None and self.plan.widths[-1] >= TOGETHER

    def reads(self, columns: int) -> bool:
        """Whether a touch of so many columns is one pass of the network, or needs none."""
        return not self.tunable or columns <= MOST_STEPS

    def network(self) -> Backbone:
        """A new copy of the network, with the embedding's own weights."""
        assert self._tuned is not None
        return Backbone(cast(Vision, self.parts[self._tuned]).network())

    def windows(self, columns: int) -> dict[int, list[int]]:
        """Width → first columns of the windows that judge a touch of so many columns."""
        starts = self.plan.extent(columns)
        return {
            scale.width: [starts[scale.width][place] for place in places]
            for scale, places in self.plan.scored(columns, columns).items()
        }

    def frozen(self, image: npt.NDArray[np.float32]) -> dict[int, FloatArray]:
        """Width → mean features (d,) of all that no training changes, zero in the place of the network's."""
        windows = self.windows(image.shape[1])
        means = {width: np.zeros(self.dimension) for width in windows}
        first = 0
        for i, part in enumerate(self.parts):
            fixed = {width: starts for width, starts in windows.items() if i != self._tuned or width < TOGETHER}
            if fixed:
                for width, rows in embed_windows(part, image, fixed).items():
                    means[width][first : first + part.dimension] = rows.mean(axis=0, dtype=np.float64) / part.bound
            first += part.dimension
        return means

    def means(
        self, net: Backbone | None, samples: Sequence[TrainingSample], device: torch.device | None = None
    ) -> dict[int, torch.Tensor]:
        """Width → mean features (B, d), float64, of samples, those of the network from `net`.

        Without one the network's are those of the embedding itself.
        """
        scales = sorted(samples[0].frozen)
        means = {s: torch.from_numpy(np.stack([sample.frozen[s] for sample in samples])).to(device) for s in scales}
        passed = [] if self._tuned is None else [scale for scale in scales if scale >= TOGETHER]
        if not passed:
            return means
        sizes: dict[int, list[int]] = {}
        for i, sample in enumerate(samples):
            sizes.setdefault(sample.image.shape[1], []).append(i)
        for columns, members in sizes.items():
            images = torch.from_numpy(np.stack([samples[i].image for i in members]))
            windows = self.windows(columns)
            spans = [(start, width) for width in passed for start in windows[width]]
            features = (self._own(images, spans).to(device) if net is None else net(images.to(device), spans)).double()
            first = 0
            for width in passed:
                mean = features[:, first : first + len(windows[width])].mean(dim=1)
                first += len(windows[width])
                padded = functional.pad(mean, (self._place.start, self.dimension - self._place.stop))
                place = torch.tensor(members, device=device)
                means[width] = means[width].index_add(0, place, padded)
        return means

    @cached_property
    def _own(self) -> Backbone:
        return self.network().requires_grad_(False)

    def spreads(self, samples: Sequence[TrainingSample]) -> dict[int, FloatArray]:
        """Width → the standard deviation of each feature among samples, (d,), no less than a twentieth."""
        with torch.no_grad():
            parts = [self.means(None, samples[first : first + 32]) for first in range(0, len(samples), 32)]
        return {
            width: np.maximum(np.concatenate([part[width].numpy() for part in parts]).std(axis=0), SPREAD_FLOOR)
            for width in parts[0]
        }


class TunedReader:
    """Logits of f*: the network with what was trained put into it, and the head.

    Raises MismatchError for an f* that is none of this embedding's.
    """

    def __init__(self, embedding: Embedding, plan: WindowPlan, tuned: Tuned) -> None:
        self.tuned = tuned
        self._touches = TouchFeatures(embedding, plan)
        judging = {int(scale) for scale in plan.judging(plan.milestones()[-1])}
        if set(tuned.heads) != judging or (tuned.mode != "head" and not self._touches.tunable):
            raise MismatchError(
                f"f*, with heads of windows {sorted(tuned.heads)} and {tuned.mode!r} trained, is of another embedding "
                f"than {embedding.name!r}: fine-tune again"
            )
        self._net = None if tuned.mode == "head" else self._touches.network()
        if self._net is not None:
            if tuned.mode == "adapters":
                adapted(self._net)
            self._net.put(tuned.network)
            self._net.requires_grad_(False)

    def logits_of(self, image: npt.NDArray[np.float32], candidates: Sequence[str]) -> dict[str, float] | None:
        """The `logits` of a touch; None where f* cannot answer for these candidates, or for so many columns."""
        able = set(candidates) <= set(self.tuned.names) and self._touches.reads(image.shape[1])
        return self.logits(image) if able else None

    def logits(self, image: npt.NDArray[np.float32]) -> dict[str, float]:
        """Material → logit, for a touch that reaches the last stage; image: (C, T) in [-1, 1]."""
        with steady():
            means = self._touches.means(self._net, [TrainingSample("", b"", image, self._touches.frozen(image))])
            logits = self.tuned.bias.copy()
            for scale, head in self.tuned.heads.items():
                logits += means[scale][0].numpy() @ head
        return dict(zip(self.tuned.names, logits.tolist(), strict=True))


def reader_of(predictor: Predictor) -> LogitsReader | None:
    """What reads with the tuned model of a memory, made once; None where the memory has none that answers."""
    tuned = predictor.ledger.memory.tuned
    if tuned is None or not tuned.kept:
        return None
    if predictor.tuned_reader is None or predictor.tuned_reader.tuned is not tuned:
        predictor.tuned_reader = TunedReader(predictor.recipe.embedding, predictor.recipe.plan, tuned)
    return predictor.tuned_reader
