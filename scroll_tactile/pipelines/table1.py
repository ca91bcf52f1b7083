"""The paper's Table I: every system on every data set, fold by fold, with the paper's figures beside ours."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from scroll_tactile.datasets import Recordings
from scroll_tactile.embeddings.weights import PUBLISHED
from scroll_tactile.errors import InputError, WeightsError
from scroll_tactile.pipelines.cells import Cell, Figures, Split, pooled, require_data, run_cells, split
from scroll_tactile.pipelines.metrics import accuracy
from scroll_tactile.pipelines.runfile import RunFile
from scroll_tactile.pipelines.systems.catalogue import NEED_WEIGHTS, SYSTEMS, Catalogue
from scroll_tactile.pipelines.systems.descent import Course
from scroll_tactile.pipelines.systems.protocol import System
from scroll_tactile.pipelines.systems.trained import Trained
from scroll_tactile.training import Progress

__all__ = ["NOT_OF_FRAMES", "PAPER", "Study", "Table1", "blocked", "rows", "weights_digest"]

PAPER: dict[str, dict[str, float]] = {
    "svm": {"BioTac-20": 0.942, "RoboSkin-20": 0.505},
    "svm-spikes": {"BioTac-20": 0.935, "RoboSkin-20": 0.633},
    "conv-lstm": {"BioTac-20": 0.945, "RoboSkin-20": 0.935},
    "snn": {"BioTac-20": 0.946, "RoboSkin-20": 0.922},
    "least-squares": {"BioTac-20": 0.938, "RoboSkin-20": 0.848, "GelSight-45": 0.671},
    "resnet": {"BioTac-20": 0.980, "RoboSkin-20": 0.950, "GelSight-45": 0.929},
    "resnet-pretrained": {"BioTac-20": 0.989, "RoboSkin-20": 0.960, "GelSight-45": 0.951},
}
"""Key of a system → data set → accuracy in the paper. GelSight-45 is not public: nothing of ours stands beside it."""

NOT_OF_FRAMES = ("svm", "svm-spikes", "conv-lstm", "snn")
"""Systems of streams, for which the paper has no figure on a camera's frames, and which are not run on them."""

QUICK_COLUMNS = 50  # about, of the residual networks' images in a quick run
QUICK_EVERY = 2  # of the recordings that are learned in a quick run


@dataclass(frozen=True)
class Study:
    """What the studies of the paper's systems share: on what, with what, and where it is written down.

    sets: of different names. systems: keys of SYSTEMS. weights: of a trained ResNet, for those in NEED_WEIGHTS.
    epochs: of the networks. device: of all networks but ours. seed: of all that is drawn.
    quick: learn every second recording, and let residual networks read about 50 columns an image: for a look.
    folder: where finished cells are noted, so that a run that was killed goes on; or None.

    Raises InputError for unknown systems, sets of one name, or weights that are needed and not given.
    """

    sets: Sequence[Recordings]
    systems: tuple[str, ...]
    weights: str | None = None
    epochs: int = 100
    device: str = "cpu"
    seed: int = 0
    quick: bool = False
    folder: Path | None = None

    name = "study"

    def __post_init__(self) -> None:
        strange = [key for key in self.systems if key not in SYSTEMS]
        if strange or not self.systems:
            raise InputError(f"expected systems out of {', '.join(SYSTEMS)}; came {', '.join(strange) or 'none'}")
        needing = [key for key in self.systems if key in NEED_WEIGHTS and self.weights is None]
        if needing:
            raise InputError(f"{', '.join(needing)} need the weights of a trained ResNet: give a file or resnet18")
        if len({one.name for one in self.sets}) < len(self.sets) or not self.sets:
            raise InputError(f"expected data sets of different names; came {[one.name for one in self.sets]}")
        Course(epochs=self.epochs)
        if self.seed < 0:
            raise InputError(f"expected a seed of 0 or more; came {self.seed}")

    @property
    def plan(self) -> dict[str, Any]:
        """All that each figure depends on, beside the data; sets, systems and folds can be added to a run later."""
        options = {name: getattr(self, name) for name in ("epochs", "device", "seed", "quick")}
        return {"run": self.name, **options, "weights": None if self.weights is None else weights_digest(self.weights)}

    def cells(self, folds: Mapping[str, Sequence[int]]) -> list[Cell]:
        """The cells of these folds of each set, by name; set by set and system by system."""
        return [
            Cell(one.name, fold, key)
            for one in self.sets
            for key in self.systems
            for fold in folds[one.name]
            if not (one.sensor.camera and key in NOT_OF_FRAMES)
        ]

    def run(
        self, folds: Mapping[str, Sequence[int]], progress: Progress = lambda what, done, of: None
    ) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each cell as it is finished; those finished before are read back.

        Raises InputError for a folder of another run or folds that are not there, and what the systems raise.
        """
        notes = RunFile(None if self.folder is None else self.folder / f"{self.name}.json", self.plan)
        cells = self.cells(folds)
        for one in self.sets:
            require_data(notes, one)
            for fold in folds[one.name]:
                split(one, fold, self.seed)  # what is refused is refused before anything is measured
        yield from run_cells(notes, cells, self._measure, progress)

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        raise NotImplementedError

    def _split(self, cell: Cell) -> Split:
        return split(self._by_name[cell.dataset], cell.fold, self.seed, every=QUICK_EVERY if self.quick else 1)

    def _system(self, cell: Cell) -> System:
        return self._catalogues[cell.dataset].make(cell.system)

    @cached_property
    def _by_name(self) -> dict[str, Recordings]:
        return {one.name: one for one in self.sets}

    @cached_property
    def _catalogues(self) -> dict[str, Catalogue]:
        return {one.name: self._catalogue(one) for one in self.sets}

    def _catalogue(self, recordings: Recordings) -> Catalogue:
        columns = recordings.sensor.shape[1] if recordings.sensor.camera else recordings.sensor.readings
        every = max(1, round(columns / QUICK_COLUMNS)) if self.quick else 1
        return Catalogue(self.weights, Course(epochs=self.epochs), self.device, every, self.seed)


class Table1(Study):
    """The paper's Table I: each cell a fit and a test."""

    name = "table1"

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        touches, system = self._split(cell), self._system(cell)
        exam = [stream for _, stream in touches.exam]
        truth = [name for name, _ in touches.exam]
        curve: list[float] = []
        system.fit(
            touches.streams,
            touches.materials,
            touches.validation,
            self.seed,
            progress,
            watch=lambda: curve.append(accuracy(truth, system.predict(exam))),
        )
        said = system.predict(exam)
        figures = {
            "taught": len(touches.streams),
            "validation": len(touches.validation),
            "tested": len(truth),
            "right": sum(one == other for one, other in zip(truth, said, strict=True)),
            **_votes(truth, said, touches.touch),
        }
        if isinstance(system, Trained):
            figures["epochs"] = [
                {"accuracy": share, "loss": e.loss, "validation_loss": e.validation_loss, "rate": e.rate}
                for share, e in zip(curve, system.epochs, strict=True)
            ]
        for chosen in ("chosen", "penalty"):
            if hasattr(system, chosen):
                figures["chosen"] = getattr(system, chosen)
        return figures


def _votes(truth: Sequence[str], said: Sequence[str], touch: Sequence[int]) -> Figures:
    """Right answers by the majority of what is said of one recording, where recordings have several frames."""
    ballots: dict[int, list[str]] = {}
    for one, answer in zip(touch, said, strict=True):
        ballots.setdefault(one, []).append(answer)
    if len(ballots) == len(truth):
        return {}
    name_of = dict(zip(touch, truth, strict=True))
    right = sum(max(sorted(set(votes)), key=votes.count) == name_of[one] for one, votes in ballots.items())
    return {"recordings": len(ballots), "recordings_right": right}


def rows(results: Sequence[tuple[Cell, Figures]]) -> list[dict[str, Any]]:
    """One row for each system: data set → accuracy over its folds, the paper's, and the difference."""
    found: list[dict[str, Any]] = []
    for key in SYSTEMS:
        sets: dict[str, Any] = {}
        for dataset in dict.fromkeys(cell.dataset for cell, _ in results):
            cells = [figures for cell, figures in results if (cell.system, cell.dataset) == (key, dataset)]
            if not cells:
                continue
            ours = pooled(cells)
            paper = PAPER.get(key, {}).get(dataset)
            sets[dataset] = ours | {
                "paper": paper,
                "difference": None if paper is None else ours["mean"] - paper,
                "seconds": sum(cell["seconds"] for cell in cells),
            }
            if "recordings" in cells[0]:
                asked = sum(cell["recordings"] for cell in cells)
                sets[dataset]["vote"] = sum(cell["recordings_right"] for cell in cells) / asked
        if sets:
            found.append({"key": key, "system": SYSTEMS[key], "sets": sets})
    return found


def blocked(recordings: Recordings) -> Recordings:
    """The same recordings in folds of successive repetitions, named so. Raises DatasetError where there are none."""
    return replace(recordings, name=f"{recordings.name} blocked", fold=recordings.blocked())


def weights_digest(weights: str) -> str:
    """What a run knows weights by: a published name, or 16 hex digits of the file's SHA-256.

    Raises WeightsError where there is no such file.
    """
    if weights in PUBLISHED:
        return weights
    path = Path(weights)
    if not path.is_file():
        raise WeightsError(
            f"expected weights: a file, or a published name out of {sorted(PUBLISHED)}; there is no file {path}"
        )
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
