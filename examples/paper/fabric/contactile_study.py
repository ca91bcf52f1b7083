"""The paper's third task: what fabrics are made of, trained on a robot's touches and tested on a hand's.

Every row of the paper's Table III, and ours: on a published set of fabrics, or on the simulated one, which is named so.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from examples.paper.fabric.contactile_rows import NEED_BIOTAC, NEED_WEIGHTS, PAPER, PAPER_EPOCHS, ROWS, RowMaker
from examples.paper.fabric.fabric_protocol import score
from examples.paper.fabric.fabrics_set import Fabrics, load
from examples.paper.fabric.pretraining import Pretraining
from examples.paper.fabric.simulated import LIMITS, FabricScene
from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cells import Cell, Figures, Split, require_data, run_cells, split
from examples.paper.runs.study import weights_digest
from examples.paper.systems.constituent_memory import ConstituentMemory, estimates_of
from examples.paper.systems.constituent_nets import ConstituentNet
from examples.paper.systems.constituent_squares import ConstituentSquares, Shares
from examples.paper.systems.descent import Course
from examples.paper.systems.trained import require_device
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.training import Progress
from scroll_tactile.pipelines.runfile import RunFile

__all__ = ["HAND", "HELD_OUT", "PARTS", "Contactile", "rows", "simulated"]

HAND, HELD_OUT = "protocol 1 → 2", "protocol 1 → 1, held out"
PARTS = {"hand": HAND, "held-out": HELD_OUT}
"""Key, as on the command line → what is trained on and what is tested: all touches of the robot, and the hand's; or
four fifths of the robot's, and the fifth that is left."""


def simulated(seed: int = 0, count: int = 32, robot: int = 40, hand: int = 10) -> Fabrics:
    """The simulated fabrics, written in the published layout and read again: what the reader reads is what is used.

    seed: of the fabrics and of their folds. count: of fabrics. robot, hand: touches of each under either protocol.
    """
    with TemporaryDirectory() as folder:
        FabricScene(seed, count).write(Path(folder) / "fabrics", robot, hand)
        read = load(Path(folder) / "fabrics", seed, limits=LIMITS)
    return replace(read, recordings=replace(read.recordings, name="simulated fabrics"))


@dataclass(frozen=True)
class Contactile:
    """The study of some rows on a set of fabrics; each row is trained and tested in two parts (`PARTS`).

    rows: keys of ROWS. weights: of a trained ResNet, for those in NEED_WEIGHTS. biotac: recordings of BioTac's
    materials, for those in NEED_BIOTAC. epochs: of the networks on fabrics, and biotac_epochs: on BioTac. device: of
    all networks but ours. seed: of all that is drawn. every: columns that the images of the paper's rows are averaged
    over. take: learn one of so many touches. folder: where finished cells are noted, so that a run resumes; or None.

    A fabric of which nothing is known is trained on, and not tested; a constituent that all fabrics have, or none, is
    learned and not scored. Raises InputError for unknown rows, what a row needs and was not given, settings that cannot
    be, fabrics without touches under protocol 1 or 2, or no constituent that some fabrics have and others have not.
    """

    fabrics: Fabrics
    rows: tuple[str, ...]
    weights: str | None = None
    biotac: Recordings | None = None
    epochs: int = PAPER_EPOCHS
    biotac_epochs: int = PAPER_EPOCHS
    device: str = "cpu"
    seed: int = 0
    every: int = 1
    take: int = 1
    folder: Path | None = None

    def __post_init__(self) -> None:
        strange = [key for key in self.rows if key not in ROWS]
        if strange or not self.rows:
            raise InputError(f"expected rows out of {', '.join(ROWS)}; came {', '.join(strange) or 'none'}")
        for needing, given, what in (
            (NEED_WEIGHTS, self.weights, "the weights of a trained ResNet: a file, or resnet18"),
            (NEED_BIOTAC, self.biotac, "recordings of BioTac-20"),
        ):
            if given is None and (keys := [key for key in self.rows if key in needing]):
                raise InputError(f"{', '.join(keys)} need {what}")
        Course(epochs=self.epochs)
        Course(epochs=self.biotac_epochs)
        require_device(self.device)
        if self.seed < 0 or self.every < 1 or self.take < 1:
            raise InputError(
                "expected a seed of 0 or more, every and take of 1 or more; came "
                f"{self.seed}, {self.every}, {self.take}"
            )
        if (protocols := sorted(set(self.fabrics.protocol.tolist()))) != [1, 2]:
            raise InputError(f"expected touches under protocols 1 and 2; came {protocols}")
        if not self.scored:
            raise InputError("expected a constituent that some fabrics have and others have not; there is none")

    @cached_property
    def shares(self) -> Shares:
        """What the fabrics are made of."""
        return Shares(self.fabrics.constituents, self.fabrics.compositions)

    @cached_property
    def scored(self) -> list[str]:
        """The constituents that are known of some fabrics to be there, and of others not to be."""
        presence = self.shares.presence(list(self.fabrics.compositions))
        return [name for name, own in zip(self.shares.names, presence.T, strict=True) if {0.0, 1.0} <= set(own)]

    @property
    def plan(self) -> dict[str, Any]:
        """All that each figure depends on, beside the touches; rows can be added later, not weights."""
        made_of = json.dumps(self.fabrics.compositions, sort_keys=True).encode()
        options = {name: getattr(self, name) for name in ("epochs", "biotac_epochs", "device", "seed", "every", "take")}
        return {
            "run": "contactile",
            "dataset": self.fabrics.recordings.name,
            "fabrics": len(self.fabrics.compositions),
            "constituents": list(self.fabrics.constituents),
            "compositions": hashlib.sha256(made_of).hexdigest()[:16],
            "weights": None if self.weights is None else weights_digest(self.weights),
            **options,
        }

    def run(
        self, parts: Sequence[str] = tuple(PARTS), progress: Progress = lambda what, done, of: None
    ) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each row in each part, as they are finished; those finished before are read back.

        Raises InputError for other parts or a folder of another run, and what the systems raise.
        """
        if not parts or set(parts) - set(PARTS):
            raise InputError(f"expected parts out of {', '.join(PARTS)}; came {', '.join(parts) or 'none'}")
        notes = RunFile(None if self.folder is None else self.folder / "contactile.json", self.plan)
        for recordings in (self.fabrics.recordings, self.biotac):
            if recordings is not None:
                require_data(notes, recordings)
        asked = [PARTS[part] for part in parts]
        for part in asked:
            self.split(part)  # what is refused is refused before anything is measured
        cells = [Cell(part, 0, key) for key in self.rows for part in asked]
        yield from run_cells(notes, cells, self._measure, progress)

    def split(self, part: str) -> Split:
        """The touches of HAND or HELD_OUT; those tested are of fabrics of which something is known."""
        whole, by_hand = self.fabrics.recordings, self.fabrics.protocol == 2
        if part == HAND:
            recordings = replace(whole, fold=np.where(by_hand, 0, 1))
        else:
            keep = np.flatnonzero(~by_hand)
            recordings = Recordings(
                whole.name,
                whole.sensor,
                [whole.streams[i] for i in keep],
                [whole.materials[i] for i in keep],
                whole.repetition[keep],
                whole.fold[keep],
                whole.ordered,
            )
        touches = split(recordings, 0, self.seed, every=self.take)
        described = np.isfinite(self._truth(touches.truth)).any(axis=1)
        test = [item for item, known in zip(touches.test, described, strict=True) if known]
        return replace(
            touches, test=test, touch=[i for i, known in zip(touches.touch, described, strict=True) if known]
        )

    @cached_property
    def _maker(self) -> RowMaker:
        file = None if self.folder is None else self.folder / "biotac.npz"
        tuning = None
        if self.biotac is not None and self.weights is not None:
            course = Course(epochs=self.biotac_epochs)
            tuning = Pretraining(self.biotac, self.weights, course, self.device, self.every, self.seed, file)
        return RowMaker(self.shares, self.weights, tuning, Course(epochs=self.epochs), self.device, self.every)

    def _truth(self, fabrics: Sequence[str]) -> Any:
        return self.shares.presence(fabrics)[:, self._columns]

    @cached_property
    def _columns(self) -> list[int]:
        return [self.shares.names.index(name) for name in self.scored]

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        touches, system = self.split(cell.dataset), self._maker.make(cell.system, progress)
        system.fit(touches.streams, touches.materials, touches.validation, self.seed, progress)
        truth, masses = self._truth(touches.truth), self.shares.masses(touches.truth)[:, self._columns]
        described = system.estimate(touches.test_streams, progress)
        figures: Figures = {"learned": len(touches.streams), "validation": len(touches.validation)}
        figures |= score(
            self.scored, truth, described.presence[:, self._columns], (masses, described.share[:, self._columns])
        )
        if isinstance(system, ConstituentMemory):
            figures |= self._otherwise(system, touches, truth, progress)
        if isinstance(system, ConstituentSquares):
            figures["chosen"] = system.chosen
        if isinstance(system, ConstituentNet):
            figures["epochs"] = [[item.loss, item.validation_loss, item.rate] for item in system.epochs]
        if cell.system in NEED_BIOTAC:
            figures["accuracy on BioTac"] = self._maker.accuracy
        return figures

    def _otherwise(self, system: ConstituentMemory, touches: Split, truth: Any, progress: Progress) -> Figures:
        """Ours with novelty inferred; by heads alone, as if no fabric were known; and which fabric."""
        found: Figures = {}
        for name, unfamiliar in (("inferred", 0.5), ("heads", 1.0)):
            predicted = system.compositions(touches.test_streams, unfamiliar, progress)
            found[name] = score(self.scored, truth, estimates_of(self.scored, predicted).presence)["score"]
        fabrics = [item.prediction.material for item in predicted]
        found["fabric"] = float(np.mean([item == true for item, true in zip(fabrics, touches.truth, strict=True)]))
        return found


def rows(results: Sequence[tuple[Cell, Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """One row for each system: part → its figures, and of the paper's part the paper's score and the difference."""
    found: list[dict[str, Any]] = []
    wanted = ("score", "exact", "share_error", "calibration_error", "always", "inferred", "heads", "fabric")
    for key, name in ROWS.items():
        parts = {
            cell.dataset: {what: figures.get(what) for what in wanted}
            for cell, figures in results
            if cell.system == key
        }
        if parts:
            paper, here = PAPER.get(key), parts.get(HAND, {}).get("score")
            apart = None if paper is None or here is None else here - paper
            found.append({"key": key, "system": name, "paper": paper, "difference": apart, "parts": parts})
    return found
