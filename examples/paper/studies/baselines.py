"""The paper's systems in the studies of robustness: trained on the same touches, with its augmentations or without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from examples.paper.runs.cells import held_back
from examples.paper.studies.perturbations import changed
from examples.paper.systems.catalogue import CONTROLS, EPOCHAL, OURS, SYSTEMS, Catalogue
from examples.paper.systems.own import code_digest, is_own
from examples.paper.systems.system_protocol import System
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.signals.augmentation import Augmentation, Change, Image, fit
from scroll_tactile.signals.stream import fewest_readings

if TYPE_CHECKING:
    from examples.paper.studies.strengths import Make

__all__ = ["BASELINES", "COPIES", "STRONG", "Sometimes", "baseline"]

BASELINES = tuple(key for key in SYSTEMS if key not in (*OURS, *CONTROLS) and not key.startswith("least-squares"))
"""Keys of the catalogue that classify touches of any length and speed."""


@dataclass(frozen=True)
class Sometimes(Augmentation):
    """An augmentation that leaves some touches as they were recorded: `share` is the probability that one is changed.

    Where every touch of every epoch came strongly changed, networks had 28 to 53 % of RoboSkin's clean touches after
    twenty epochs, in place of 85 to 92.
    """

    share: float = 0.5

    def draw(self, rng: np.random.Generator) -> Change:
        """One change of at most these strengths, or none; it takes the same numbers from `rng` whatever they are."""
        change = super().draw(rng)
        return change if rng.random() < self.share else Change()


STRONG = Sometimes(flip=0.5, speed=(0.45, 2.2), keep=0.1, noise=0.6, drift=0.1)
"""The paper's four, as strong as the studies: to about half and twice the speed, down to a tenth of the touch, and to
noise of a standard deviation of 0.6 of half the range, as uniform noise of ± 0.52 of the range has. Half of what a
system sees is as it was recorded."""

COPIES = 3
"""Of each touch, for a system that is not trained over epochs, in which it would see others every time."""


def baseline(
    key: str, catalogue: Catalogue, seed: int = 0, augmentation: Augmentation = STRONG
) -> tuple[Make, dict[str, Any]]:
    """A system of the catalogue, or one's own, for the studies of robustness, and what it depends on, in JSON's types.

    With its augmentation a network sees each touch changed anew in every epoch, and any other system COPIES changed
    ones beside each. The validation, a tenth of each material's touches, is left as it was recorded.

    Raises InputError for a system that is not in BASELINES.
    """
    if key not in BASELINES and not is_own(key):
        raise InputError(f"expected a system out of {', '.join(BASELINES)}; came {key!r}")

    def make(train: Sequence[Labelled], augmented: bool, progress: Progress) -> System:
        learned, held = _part(train, seed)
        if augmented and key not in EPOCHAL:
            learned = [*learned, *_copies(learned, augmentation, seed)]
        made = replace(catalogue, augmentation=augmentation if augmented else None).make(key)
        made.fit([stream for _, stream in learned], [name for name, _ in learned], held, seed, progress)
        return made

    course = {"epochs": catalogue.course.epochs, "precision": catalogue.course.precision} if key in EPOCHAL else {}
    drawn = asdict(augmentation) | ({} if key in EPOCHAL else {"copies": COPIES})
    code = {"code": code_digest(key)} if is_own(key) else {}
    return make, {"augmentation": drawn, "columns": catalogue.every, "seed": seed, **course, **code}


def _part(train: Sequence[Labelled], seed: int) -> tuple[list[Labelled], list[Labelled]]:
    """What is learned, and a tenth of each material's touches to choose on (see `held_back`)."""
    random = np.random.default_rng([seed, 3])
    held: set[int] = set()
    for name in sorted({name for name, _ in train}):
        own = random.permutation([i for i, (material, _) in enumerate(train) if material == name])
        held.update(own[: held_back(len(own))].tolist())
    learned = [touch for i, touch in enumerate(train) if i not in held]
    return learned, [train[i] for i in sorted(held)]


def _copies(touches: Sequence[Labelled], augmentation: Augmentation, seed: int) -> list[Labelled]:
    random = np.random.default_rng([seed, 4])
    return [
        (name, changed(stream, partial(_long_enough, augmentation.draw(random), fewest_readings(stream.sensor))))
        for name, stream in touches
        for _ in range(COPIES)
    ]


def _long_enough(change: Change, least: int, image: Image) -> Image:
    """The changed image; where it is shorter than a stream can be it goes on as its mirror image."""
    made = change.apply(image)
    return made if made.shape[-1] >= least else fit(made, least)
