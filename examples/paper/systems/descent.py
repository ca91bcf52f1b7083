"""The one training loop of all networks of the comparison: the paper's, by gradient descent over epochs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn import functional

from scroll_tactile.embeddings.steady import full_float32
from scroll_tactile.errors import InputError, ScrollTactileError
from scroll_tactile.finetune.fine_tune import Progress

__all__ = [
    "AT_ONCE",
    "Batches",
    "Course",
    "Epoch",
    "Loss",
    "Precision",
    "TrainingError",
    "descend",
    "logits_of",
    "seeded",
]

Precision = Literal["float32", "bfloat16"]

Fetch = Callable[[npt.NDArray[np.intp]], torch.Tensor]
Loss = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""(outputs, targets) of a batch → their mean loss in nats, a scalar."""
AT_ONCE = 64  # images in a batch that nothing is learned from


class TrainingError(ScrollTactileError):
    """A network's training had to stop, with a loss that is not finite or a device without memory."""


@dataclass(frozen=True)
class Course:
    """How a network is trained; as the paper's by default, and its batch size, patience and factor, which it does
    not give, as is usual.

    epochs: passes over the touches. batch: touches in a step, at most. rate: of learning, at first. momentum, decay:
    of SGD. patience: epochs without a lower loss on the validation after which the rate is multiplied by `factor`.
    precision: of the products in a step; weights, sums and all answers stay float32. bfloat16 is half the time on
    processors and devices that have it.

    Raises InputError for settings that cannot be.
    """

    epochs: int = 100
    batch: int = 32
    rate: float = 0.01
    momentum: float = 0.9
    decay: float = 1e-4
    patience: int = 10
    factor: float = 0.1
    precision: str = "float32"

    @classmethod
    def in_proportion(cls, epochs: int, precision: str = "float32") -> Course:
        """A course of fewer or more epochs with a patience of a tenth of them, as the default has, 1 or more.

        With ten epochs' patience the rate would not fall once in twenty, and a network swings until it does.
        """
        return cls(epochs=epochs, patience=max(1, epochs // 10), precision=precision)

    def __post_init__(self) -> None:
        whole = self.epochs >= 1 and self.batch >= 2 and self.patience >= 0
        if not (whole and 0 < self.rate < math.inf and 0 <= self.momentum < 1 and self.decay >= 0):
            raise InputError(
                f"expected epochs of 1 or more, a batch of 2 or more, patience of 0 or more, a rate above 0, momentum "
                f"in [0, 1) and decay of 0 or more; came {self}"
            )
        if not 0 < self.factor < 1:
            raise InputError(f"expected a factor between 0 and 1 to lower the rate by; came {self.factor}")
        if self.precision not in get_args(Precision):
            raise InputError(f"expected a precision out of {', '.join(get_args(Precision))}; came {self.precision!r}")


@dataclass(frozen=True)
class Epoch:
    """What one epoch came to: mean losses in nats, and the rate that it was trained at."""

    loss: float
    validation_loss: float | None
    rate: float


@dataclass(frozen=True)
class Batches:
    """Touches to learn from: `fetch` gives the images at some of N places, `targets` is what the loss takes."""

    fetch: Fetch
    targets: torch.Tensor


@contextmanager
def seeded(seed: int, device: str) -> Iterator[None]:
    """Let torch's generators draw from a seed, and be afterwards as they were; full float32, repeatable kernels.

    What a processor gives is the same for the same number of threads.
    """
    cuda = torch.device(device).type == "cuda"
    with ExitStack() as stack:
        stack.enter_context(torch.random.fork_rng(devices=[torch.device(device)] if cuda else []))
        stack.enter_context(full_float32())
        stack.enter_context(torch.autocast(torch.device(device).type, enabled=False))
        stack.enter_context(torch.backends.cudnn.flags(deterministic=True, benchmark=False, allow_tf32=False))
        torch.default_generator.manual_seed(seed)  # torch.manual_seed would seed every device
        if cuda:
            with torch.cuda.device(torch.device(device)):
                torch.cuda.manual_seed(seed)
        yield


def descend(
    net: nn.Module,
    trained: Batches,
    held: Batches | None,
    course: Course,
    random: np.random.Generator,
    progress: Progress,
    watch: Callable[[], object],
    criterion: Loss = functional.cross_entropy,
) -> list[Epoch]:
    """Train a network in place by SGD, at a rate that falls on plateaus; what each epoch came to.

    held: the validation; where there is none the plateaus are those of the training's own loss. In the end the
    network has the weights of the epoch of least validation loss. watch: called after each epoch. criterion: the loss;
    of classes, by default.

    Raises TrainingError where the loss is not finite, or the device has no memory left.
    """
    optimiser = torch.optim.SGD(net.parameters(), course.rate, course.momentum, weight_decay=course.decay)
    plateau = torch.optim.lr_scheduler.ReduceLROnPlateau(optimiser, factor=course.factor, patience=course.patience)
    epochs: list[Epoch] = []
    best, state = math.inf, None
    for i in range(course.epochs):
        rate = float(optimiser.param_groups[0]["lr"])
        loss = _epoch(net, trained, optimiser, course, random, i + 1, criterion)
        validation = None if held is None else _loss(net, held, criterion)
        epochs.append(Epoch(loss, validation, rate))
        judged = loss if validation is None else validation
        if judged < best:
            best, state = judged, {name: tensor.clone() for name, tensor in net.state_dict().items()}
        plateau.step(judged)
        progress("training", i + 1, course.epochs)
        watch()
    if state is not None:
        net.load_state_dict(state)
    return epochs


def _epoch(
    net: nn.Module,
    trained: Batches,
    optimiser: torch.optim.Optimizer,
    course: Course,
    random: np.random.Generator,
    number: int,
    criterion: Loss,
) -> float:
    """Mean loss of one pass in a random order."""
    net.train()
    order = random.permutation(len(trained.targets))
    total = torch.zeros((), dtype=torch.float64)
    # Of nearly one size: batch normalisation cannot train on a last batch of one.
    for places in np.array_split(order, -(-len(order) // course.batch)):
        targets = trained.targets[torch.from_numpy(places)]
        try:
            # Rounded weights are kept until the outermost autocast ends, which is that of `seeded`: not to be kept.
            half = course.precision == "bfloat16"
            with torch.autocast(targets.device.type, torch.bfloat16, enabled=half, cache_enabled=False):
                logits = net(trained.fetch(places))
            loss = criterion(logits.float(), targets)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
        except torch.OutOfMemoryError as error:
            raise TrainingError(
                f"{targets.device} is out of memory in epoch {number}: free some, or take --device cpu ({error})"
            ) from error
        total += len(places) * loss.detach().double().cpu()
    mean = float(total) / len(order)
    if not math.isfinite(mean):
        raise TrainingError(
            f"the loss became {mean} in epoch {number}: the training diverged. Are the readings sound? Another seed "
            f"or a lower rate than {course.rate:g} may do"
        )
    return mean


def _loss(net: nn.Module, held: Batches, criterion: Loss) -> float:
    """Mean loss on touches that nothing is learned from."""
    places = np.arange(len(held.targets))
    logits = torch.cat([logits_of(net, held.fetch(places[i : i + AT_ONCE])) for i in range(0, len(places), AT_ONCE)])
    return float(criterion(logits.double(), held.targets))


def logits_of(net: nn.Module, images: torch.Tensor) -> torch.Tensor:
    """Logits (B, C) of images of one size, without learning from them."""
    net.eval()
    with torch.inference_mode(), full_float32():
        return torch.cat([net(part) for part in torch.split(images, AT_ONCE)])
