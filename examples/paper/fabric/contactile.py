"""`fabric contactile`: what fabrics are made of, trained on a robot's touches and tested on a hand's: Table III.

Every row of the paper's Table III, and ours, on simulated fabrics, which are named so.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from examples.paper.fabric.contactile_rows import (
    EPOCHAL,
    NEED_BIOTAC,
    NEED_WEIGHTS,
    PAPER,
    PAPER_EPOCHS,
    ROWS,
    Pretraining,
    RowMaker,
)
from examples.paper.fabric.fabric_protocol import score
from examples.paper.fabric.simulated import CONSTITUENTS, Fabrics, FabricScene
from examples.paper.readers.labelled import Recordings, chosen
from examples.paper.runs.cells import Cell, Figures, Split, run_cells, silent, split
from examples.paper.runs.options import SETS, Device, Json, Quick, Run, Seed, Weights, leave_out, named, numbers
from examples.paper.runs.results import show, write
from examples.paper.runs.study import weights_digest
from examples.paper.systems.constituents import (
    ConstituentMemory,
    ConstituentNet,
    ConstituentSquares,
    Shares,
    estimates_of,
)
from examples.paper.systems.descent import Course
from examples.paper.systems.trained import require_device
from scroll_tactile.clients.cli.terminal import progress_bar, say
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress

__all__ = ["HAND", "HELD_OUT", "PARTS", "Contactile", "contactile", "rows"]

HAND, HELD_OUT = "protocol 1 → 2", "protocol 1 → 1, held out"
PARTS = {"hand": HAND, "held-out": HELD_OUT}
"""Key, as on the command line → what is trained on and what is tested: all touches of the robot, and the hand's; or
four fifths of the robot's, and the fifth that is left."""

WHOLE = {"epochs": PAPER_EPOCHS, "biotac_epochs": PAPER_EPOCHS, "every": 1, "take": 1}
QUICK = {"epochs": 4, "biotac_epochs": 2, "every": 12, "take": 8}


@dataclass(frozen=True)
class Contactile:
    """The study of some rows on a set of fabrics; each row is trained and tested in two parts (`PARTS`).

    rows: keys of ROWS. weights: of a trained ResNet, for those in NEED_WEIGHTS. biotac: recordings of BioTac's
    materials, for those in NEED_BIOTAC. epochs: of the networks on fabrics, and biotac_epochs: on BioTac. device: of
    all networks but ours. seed: of all that is drawn. every: columns that the images of the paper's rows are averaged
    over. take: learn one of so many touches. folder: where finished cells are noted, so that a run resumes; or None.

    A constituent that all fabrics have, or none, is learned and not scored. Raises InputError for unknown rows, what a
    row needs and was not given, settings that cannot be, or no constituent that some fabrics have and others have not.
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
        if not self.scored:
            raise InputError("expected a constituent that some fabrics have and others have not; there is none")

    @cached_property
    def shares(self) -> Shares:
        """What the fabrics are made of."""
        return Shares(CONSTITUENTS, self.fabrics.compositions)

    @cached_property
    def scored(self) -> list[str]:
        """The constituents that some fabrics have, and others have not."""
        presence = self.shares.presence(list(self.fabrics.compositions))
        return [name for name, own in zip(self.shares.names, presence.T, strict=True) if 0 < own.mean() < 1]

    @property
    def plan(self) -> dict[str, Any]:
        """All that each figure depends on, beside the touches; rows can be added later, not weights."""
        made_of = json.dumps(self.fabrics.compositions, sort_keys=True).encode()
        options = {name: getattr(self, name) for name in ("epochs", "biotac_epochs", "device", "seed", "every", "take")}
        return {
            "run": "contactile",
            "dataset": self.fabrics.recordings.name,
            "fabrics": len(self.fabrics.compositions),
            "constituents": list(CONSTITUENTS),
            "compositions": hashlib.sha256(made_of).hexdigest()[:16],
            "weights": None if self.weights is None else weights_digest(self.weights),
            **options,
        }

    def run(self, parts: Sequence[str] = tuple(PARTS), progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each row in each part, as they are finished; those finished before are read back.

        Raises InputError for other parts or a folder of another run, and what the systems raise.
        """
        if not parts or set(parts) - set(PARTS):
            raise InputError(f"expected parts out of {', '.join(PARTS)}; came {', '.join(parts) or 'none'}")
        asked = [PARTS[part] for part in parts]
        for part in asked:
            self.split(part)  # what is refused is refused before anything is measured
        sets = [self.fabrics.recordings, *([] if self.biotac is None else [self.biotac])]
        cells = [Cell(part, 0, key) for key in self.rows for part in asked]
        yield from run_cells(self.folder, self.plan, sets, cells, self._measure, progress)

    def split(self, part: str) -> Split:
        """The touches of HAND or HELD_OUT."""
        whole, by_hand = self.fabrics.recordings, self.fabrics.protocol == 2
        if part == HAND:
            recordings = replace(whole, fold=np.where(by_hand, 0, 1))
        else:
            recordings = chosen(whole, np.flatnonzero(~by_hand).tolist())
        return split(recordings, 0, self.seed, every=self.take)

    @cached_property
    def _maker(self) -> RowMaker:
        file = None if self.folder is None else self.folder / "biotac.npz"
        tuning = None
        if self.biotac is not None and self.weights is not None:
            course = Course(epochs=self.biotac_epochs)
            tuning = Pretraining(self.biotac, self.weights, course, self.device, self.every, self.seed, file)
        return RowMaker(self.shares, self.weights, tuning, Course(epochs=self.epochs), self.device, self.every)

    @cached_property
    def _columns(self) -> list[int]:
        return [self.shares.names.index(name) for name in self.scored]

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        touches, system = self.split(cell.dataset), self._maker.make(cell.system, progress)
        system.fit(touches.streams, touches.materials, touches.validation, self.seed, progress)
        truth, masses = (of(touches.truth)[:, self._columns] for of in (self.shares.presence, self.shares.masses))
        described = system.estimate(touches.test_streams, progress)
        presence, share = described.presence[:, self._columns], described.share[:, self._columns]
        figures: Figures = {"learned": len(touches.streams), "validation": len(touches.validation)}
        figures |= score(self.scored, truth, presence, (masses, share))
        if isinstance(system, ConstituentMemory):
            figures |= self._otherwise(system, touches, truth, progress)
        if isinstance(system, ConstituentSquares):
            figures["chosen"] = system.chosen
        if isinstance(system, ConstituentNet):
            figures["epochs"] = [[item.loss, item.validation_loss, item.rate] for item in system.epochs]
        if cell.system in NEED_BIOTAC:
            figures["accuracy on BioTac"] = self._maker.accuracy
        return figures

    def _otherwise(
        self, system: ConstituentMemory, touches: Split, truth: npt.NDArray[np.float64], progress: Progress
    ) -> Figures:
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


def contactile(
    context: typer.Context,
    which: Annotated[str | None, typer.Option("--rows", help=f"Which rows, of {', '.join(ROWS)}.")] = None,
    parts: Annotated[str, typer.Option(help="What is tested: a hand's touches, a robot's held out.")] = "hand,held-out",
    simulated: Annotated[bool, typer.Option("--simulated", help="As all fabrics are: the paper's are not public.")] = (
        False
    ),
    size: Annotated[str, typer.Option(help="Fabrics, touches of each by robot, and by hand.")] = "32,40,10",
    weights: Weights = None,
    biotac: Annotated[
        Path | None, typer.Option(help="Folder with biotac_slide_20_50/, for the rows that begin there.")
    ] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="Of the networks on fabrics; the paper has 50.")] = None,
    biotac_epochs: Annotated[int | None, typer.Option(min=1, help="Of the network on BioTac.")] = None,
    every: Annotated[
        int | None, typer.Option(min=1, help="Average so many columns of the images that the paper's rows read.")
    ] = None,
    take: Annotated[int | None, typer.Option(min=1, help="Learn one of so many touches.")] = None,
    device: Device = "cpu",
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Learn fabrics as a robot touches them, and compose what they are made of when a hand does: the paper's Table III.

    50 epochs for each network: hours on a GPU, days without. --rows takes parts of it, --run adds them up.
    """
    keys = tuple(ROWS) if which is None else named("--rows", which, ROWS)
    for option, given, needing in (("--weights", weights, NEED_WEIGHTS), ("--biotac", biotac, NEED_BIOTAC)):
        if given is None and which is None:
            keys = leave_out(keys, needing, option)
        elif given is None and (without := [key for key in keys if key in needing]):
            raise InputError(f"{', '.join(without)} need {option}")
    sizes = numbers("--size", size, "three numbers")
    if len(sizes) != 3:
        raise InputError(f"expected --size as three whole numbers, such as 32,40,10; came {size!r}")
    given_settings = {"epochs": epochs, "biotac_epochs": biotac_epochs, "every": every, "take": take}
    settings = (QUICK if quick else WHOLE) | {
        name: value for name, value in given_settings.items() if value is not None
    }
    with progress_bar() as progress:
        progress("touching", 0, 1)
        fabrics = FabricScene(seed, sizes[0]).touched(*sizes[1:])
        needed = biotac is not None and any(key in NEED_BIOTAC for key in keys)
        touched = SETS["biotac-20"](biotac, seed) if needed and biotac is not None else None
        study = Contactile(fabrics, keys, weights, touched, device=device, seed=seed, folder=run, **settings)
        results = list(study.run(named("--parts", parts, PARTS), progress))
    found = rows(results)
    columns = {"row": "{./system}", "paper": "{?./paper|%}", "score": "{./score|%}", "all right": "{./exact|%}"}
    columns |= {"shares off by": "{?./share_error|%}", "calibration": "{?./calibration_error|.3f}"}
    columns |= {"always the more common": "{./always|%}"}
    for part in dict.fromkeys(part for row in found for part in row["parts"]):
        show(f"simulated fabrics, {part}", columns, [row | row["parts"][part] for row in found if part in row["parts"]])
    if any(key in EPOCHAL for key in keys):
        say(
            f"networks: {study.epochs} epochs (the paper has {PAPER_EPOCHS}), on {study.device}, images averaged over "
            f"{study.every} columns; trained on one touch of {study.take}"
        )
    say("[yellow]simulated:[/] the paper's figures are of real fabrics, and stand here to be compared in order only")
    made = study.plan | {"seconds": sum(figures["seconds"] for _, figures in results)}
    write(context, made | {"rows": found, "cells": {cell.key: figures for cell, figures in results}})
