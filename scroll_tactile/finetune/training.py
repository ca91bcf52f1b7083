"""The training of a fine-tune: from f's readout, on samples, tested on others that are held out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.runtimes import full_float32, one_torch_thread
from scroll_tactile.errors import FineTuneError
from scroll_tactile.finetune.network import Backbone, TouchFeatures, TrainingSample, adapted
from scroll_tactile.libraries import optional
from scroll_tactile.memory.tuned import TuneMode
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.task import Task
from scroll_tactile.signals.augmentation import Augmentation
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.statistics import Statistics

with optional("torch", "torch", "a fine-tune"):
    import torch
    from torch import nn
    from torch.nn import functional

__all__ = ["FOLDS", "Progress", "Start", "Trained", "Trainer", "named_out_of_memory", "repeatable", "start_of"]

FloatArray = npt.NDArray[np.float64]
Progress = Callable[[str, int, int], object]

FOLDS = 3  # of the exemplars
BATCH = 32
# Larger rates train faster away from what f has solved. Held out, with 400 exemplars of RoboSkin, f's log loss is
# 0.171; f*'s is 0.151 with adapters' rates of 5e-6 and 5e-5, 0.159 with 1e-6. BioTac tells them apart: f 0.060, f*
# 0.060 at 5e-6 and 0.073 at 5e-5, which had 92.0 % on the touches of the test where f has 99.5.
RATES: dict[TuneMode, float] = {"head": 0.0, "adapters": 5e-6, "network": 3e-6}
HEAD_RATE = 3e-5  # in units of a feature's spread
# A tenth of the touches is augmented, gently: at the strengths of offline training, where nothing else is known, f*
# lost 2 to 3 points on clean touches more.
AUGMENTED = 0.1
AUGMENTATION = Augmentation(flip=0.05, speed=(0.97, 1.03), keep=0.97, noise=0.002, drift=0.002)


@dataclass(frozen=True)
class Start:
    """Where training starts from: a linear readout of mean features, in the order of `names`."""

    names: list[str]
    heads: dict[int, FloatArray]
    bias: FloatArray


@dataclass
class Trained:
    """The result of a training.

    logits: (touches, C) of the exemplars held out, after every epoch. targets: the places of their materials among the
    C. heads, bias, network: as in `Tuned`, after the last epoch.
    """

    logits: list[FloatArray]
    targets: npt.NDArray[np.intp]
    heads: dict[int, FloatArray]
    bias: FloatArray
    network: dict[str, npt.NDArray[np.float32]]


def start_of(model: Model, names: Sequence[str], readouts: Mapping[Scale, Readout] | None = None) -> Start:
    """f's own readouts at the last stage as one linear head; or others in their place."""
    heads, bias = {}, np.zeros(len(names))
    for scale, weight in zip(model.stages[-1], model.calibrations[-1].weights, strict=True):
        readout = (readouts or model.readouts)[scale]
        slopes, offsets = readout.linear(names, model.kind)
        heads[scale.width] = np.ascontiguousarray(weight * slopes * 2.0**BITS)  # as it will lie when it is read again
        bias += weight * (offsets - readout.origin @ slopes)
    return Start(list(names), heads, bias)


def start_without(
    model: Model, statistics: Statistics, samples: Sequence[TrainingSample], names: Sequence[str]
) -> Start:
    """The head that f would be had it never observed some samples; of those of the names that it would know then.

    statistics: of the memory; they are as before when this returns.
    """
    for sample in samples:
        statistics.remove(sample.material, sample.codes, sample.image.shape[1])
    scales = model.stages[-1]
    known = sorted(set(names).intersection(*(statistics.names(scale) for scale in scales)))
    if len(known) < 2:
        start = Start(known, {}, np.zeros(len(known)))
    else:
        reference = names if model.kind == "lda" else list(statistics.materials)
        readouts = {scale: Task.of(statistics, scale, reference).solve() for scale in scales}
        start = start_of(model, known, readouts)
    for sample in samples:
        statistics.add(sample.material, sample.codes, sample.image.shape[1])
    return start


def fold_of(key: bytes) -> int:
    """The fold of an exemplar, from its content hash: the same wherever and whenever it was observed."""
    return int.from_bytes(key[:8], "little") % FOLDS


@contextmanager
def repeatable(device: str) -> Iterator[None]:
    """One thread, no shortened floats, no algorithm whose sums depend on timing."""
    with ExitStack() as stack:
        stack.enter_context(one_torch_thread())
        stack.enter_context(full_float32())
        stack.enter_context(torch.autocast(torch.device(device).type, enabled=False))
        stack.enter_context(torch.backends.cudnn.flags(deterministic=True, benchmark=False, allow_tf32=False))
        yield


@contextmanager
def named_out_of_memory(device: str) -> Iterator[None]:
    """Raise what a device without memory left raises as a FineTuneError."""
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        text = str(error)
        if not isinstance(error, torch.OutOfMemoryError | MemoryError) and "alloc" not in text.casefold():
            raise
        raise FineTuneError(
            f"{device} is out of memory: nothing was changed, and the f* before stays. Free some, or take "
            f"device='cpu' ({text})"
        ) from error


class Trainer:
    """Trainings of one fine-tune: they differ in what is held out."""

    def __init__(
        self,
        touches: TouchFeatures,
        spreads: Mapping[int, FloatArray],
        epochs: int,
        seed: int,
        device: torch.device,
        mode: TuneMode,
        progress: Progress,
    ) -> None:
        self.touches = touches
        self.spreads = spreads
        self.epochs = epochs
        self.seed = seed
        self.device = device
        self.mode = mode
        self.progress = progress

    def held_out(
        self, model: Model, statistics: Statistics, samples: list[TrainingSample]
    ) -> tuple[list[Trained], list[Trained]]:
        """For each fold of the samples what training on the others gives for it, and what f gives that never saw it."""
        trials, before = [], []
        names = sorted({sample.material for sample in samples})
        for fold in range(FOLDS):
            held = [sample for sample in samples if fold_of(sample.key) == fold]
            start = start_without(model, statistics, held, names)
            train = [s for s in samples if fold_of(s.key) != fold and s.material in start.names]
            test = [sample for sample in held if sample.material in start.names]
            if len(start.names) < 2 or not train or not test:
                continue
            head = LinearHead(start, self.spreads).to(self.device)
            before.append(Trained([self._judge(head, None, test)], _targets(head, test), {}, start.bias, {}))
            what = f"held out {fold + 1}/{FOLDS}"
            trials.append(self.train(start, train, test, self.epochs, salt=fold, what=what))
        return trials, before

    def train(
        self,
        start: Start,
        train: list[TrainingSample],
        test: list[TrainingSample],
        until: int,
        *,
        salt: int,
        what: str = "training",
    ) -> Trained:
        """Train for `until` epochs of a schedule of `epochs`, and test it after each."""
        random = np.random.default_rng([self.seed, salt])
        head = LinearHead(start, self.spreads).to(self.device)
        net = None if self.mode == "head" else self._network()
        optimiser, schedule = self._optimiser(head, net, -(-len(train) // BATCH) * self.epochs)
        logits = []
        for epoch in range(until):
            order = random.permutation(len(train))
            for first in range(0, len(order), BATCH):
                batch = [self._augmented(train[i], random) for i in order[first : first + BATCH]]
                self._step(head, net, batch, optimiser, f"{what}, epoch {epoch + 1}")
                schedule.step()
            if test:
                logits.append(self._judge(head, net, test))
            self.progress(what, epoch + 1, until)
        heads, bias = head.arrays()
        network = {} if net is None else net.tensors()
        arrays: list[npt.NDArray[Any]] = [bias, *heads.values(), *network.values()]
        if not all(np.isfinite(array).all() for array in arrays):
            raise FineTuneError(f"the weights are not finite after {what}: nothing was changed; take another seed")
        return Trained(logits, _targets(head, test), heads, bias, network)

    def _network(self) -> Backbone:
        net = adapted(self.touches.network()) if self.mode == "adapters" else self.touches.network()
        return net.to(self.device)

    def _optimiser(
        self, head: LinearHead, net: Backbone | None, steps: int
    ) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
        groups: list[dict[str, Any]] = [
            {"params": [*head.changes.values()], "lr": HEAD_RATE},
            {"params": [head.offset], "lr": HEAD_RATE},
        ]
        if net is not None:
            groups.append({"params": [p for p in net.parameters() if p.requires_grad], "lr": RATES[self.mode]})
        optimiser = torch.optim.AdamW(groups, weight_decay=0.0)
        return optimiser, torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)

    def _augmented(self, sample: TrainingSample, random: np.random.Generator) -> TrainingSample:
        if random.random() >= AUGMENTED:
            return sample
        image = AUGMENTATION.augment(sample.image, random, steps=sample.image.shape[1])
        return replace(sample, image=image, frozen=self.touches.frozen(image))

    def _step(
        self,
        head: LinearHead,
        net: Backbone | None,
        batch: list[TrainingSample],
        optimiser: torch.optim.Optimizer,
        where: str,
    ) -> None:
        targets = torch.from_numpy(_targets(head, batch)).to(self.device)
        loss = functional.cross_entropy(head(self.touches.means(net, batch, self.device)), targets)
        value = float(loss.detach())
        if not np.isfinite(value):
            raise FineTuneError(
                f"the loss became {value} in {where}: nothing was changed, and the f* before stays. Are the "
                "exemplars' readings sound? Another seed, or fewer epochs, may do"
            )
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()

    def _judge(self, head: LinearHead, net: Backbone | None, test: list[TrainingSample]) -> FloatArray:
        """Logits (touches, C)."""
        with torch.no_grad():
            parts = [
                head(self.touches.means(net, test[first : first + BATCH], self.device))
                for first in range(0, len(test), BATCH)
            ]
        logits: FloatArray = torch.cat(parts).cpu().numpy()
        return logits


def _targets(head: LinearHead, samples: Sequence[TrainingSample]) -> npt.NDArray[np.intp]:
    return np.array([head.names.index(sample.material) for sample in samples], dtype=np.intp)


class LinearHead(nn.Module):
    """f's readout, with changes to be learned in units of the features' spread."""

    def __init__(self, start: Start, spreads: Mapping[int, FloatArray]) -> None:
        super().__init__()
        self.names = start.names
        self.scales = sorted(start.heads)
        self.bases: dict[int, torch.Tensor] = {}
        self.spreads: dict[int, torch.Tensor] = {}
        self.changes = nn.ParameterDict()
        for scale in self.scales:
            self.bases[scale] = torch.from_numpy(start.heads[scale])
            self.spreads[scale] = torch.from_numpy(1.0 / spreads[scale])[:, None]
            self.changes[str(scale)] = nn.Parameter(torch.zeros(start.heads[scale].shape, dtype=torch.float64))
        self.bias = torch.from_numpy(start.bias)
        self.offset = nn.Parameter(torch.zeros(len(start.names), dtype=torch.float64))

    def weights(self, scale: int) -> torch.Tensor:
        """The weights of a scale, (d, C), before the temperature."""
        change = self.changes[str(scale)]
        weights: torch.Tensor = self.bases[scale].to(change.device) + self.spreads[scale].to(change.device) * change
        return weights

    def forward(self, means: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """Logits (B, C) of mean features by scale, each (B, d)."""
        logits: torch.Tensor = self.bias.to(self.offset.device) + self.offset
        for scale in self.scales:
            logits = logits + means[scale] @ self.weights(scale)
        return logits

    def arrays(self) -> tuple[dict[int, FloatArray], FloatArray]:
        """The weights by scale and the bias."""
        with torch.no_grad():
            heads = {scale: self.weights(scale).cpu().numpy() for scale in self.scales}
            return heads, (self.bias.to(self.offset.device) + self.offset).cpu().numpy()
