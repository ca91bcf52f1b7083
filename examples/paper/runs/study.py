"""What the studies of the paper's systems share: what is measured on what, where it is noted, and their commands."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import typer

from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cells import Cell, Figures, Split, run_cells, silent, split
from examples.paper.runs.options import leave_out, named
from examples.paper.runs.results import write
from examples.paper.systems.catalogue import (
    CONTROLS,
    EPOCHAL,
    NEED_WEIGHTS,
    SYSTEMS,
    Catalogue,
    lacking,
    library_of,
    name_of,
    require_libraries,
)
from examples.paper.systems.descent import Course
from examples.paper.systems.own import code_digest, is_own, require_own
from examples.paper.systems.system_protocol import System
from examples.paper.systems.trained import require_device
from scroll_tactile.clients.cli.terminal import say
from scroll_tactile.embeddings.weights import PUBLISHED
from scroll_tactile.errors import InputError, WeightsError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.sensors import Sensor

__all__ = [
    "NOT_OF_FRAMES",
    "OwnEmbeddings",
    "OwnSystems",
    "SystemStudy",
    "Systems",
    "choose_systems",
    "close",
    "columns_averaged",
    "say_conditions",
    "sensors_of",
    "systems_of",
    "weights_digest",
]

Systems = Annotated[str | None, typer.Option(help=f"Which systems, of {', '.join(SYSTEMS)}.")]
OwnSystems = Annotated[
    list[str] | None, typer.Option("--system", help="One's own, as module:factory, see examples/own_system.py; again.")
]
OwnEmbeddings = Annotated[
    list[str] | None, typer.Option("--embedding", help="Ours on an embedding of one's own, as module:factory; again.")
]

_OF_STREAMS = ("svm", "svm-spikes", "conv-lstm", "snn", "kernels+vision-ridge", "kernels+vision-lda", "conv1d-lda")
NOT_OF_FRAMES = (*_OF_STREAMS, *CONTROLS)
"""What is not run on a camera's frames: systems of streams, for which the paper has no figure there, ours of two
embeddings, for `Frames` with a network is one, and the controls."""

QUICK_COLUMNS = 50  # about, of the residual networks' images in a quick run


@dataclass(frozen=True)
class SystemStudy:
    """A study: what is to be measured; a subclass has a name, and measures a cell.

    sets: of different names. systems: keys of SYSTEMS. weights: of a trained ResNet, for those in NEED_WEIGHTS.
    epochs: of the networks. device: of all networks but ours. seed: of all that is drawn.
    precision: of the residual networks' training, see `Course`.
    quick: let residual networks read about 50 columns an image: for a look, on sets that `thinned` made small.
    folder: where finished cells are noted, so that a killed run resumes; or None.

    Raises InputError for unknown systems, sets of one name, a device that is not there, or weights that are needed and
    not given, and MissingLibraryError for a system whose library is not installed.
    """

    sets: Sequence[Recordings]
    systems: tuple[str, ...]
    weights: str | None = None
    epochs: int = 100
    device: str = "cpu"
    seed: int = 0
    quick: bool = False
    folder: Path | None = None
    precision: str = "float32"

    name = "study"

    def __post_init__(self) -> None:
        strange = [key for key in self.systems if key not in SYSTEMS and not is_own(key)]
        if strange or not self.systems:
            raise InputError(
                f"expected systems out of {', '.join(SYSTEMS)}, or module:factory; came {', '.join(strange) or 'none'}"
            )
        for key in filter(is_own, self.systems):
            require_own(key)
        require_libraries(self.systems)
        needing = [key for key in self.systems if key in NEED_WEIGHTS and self.weights is None]
        if needing:
            raise InputError(f"{', '.join(needing)} need the weights of a trained ResNet: give a file or resnet18")
        if len({item.name for item in self.sets}) < len(self.sets) or not self.sets:
            raise InputError(f"expected data sets of different names; came {[item.name for item in self.sets]}")
        _ = self.course  # is refused where it cannot be
        require_device(self.device)
        if self.seed < 0:
            raise InputError(f"expected a seed of 0 or more; came {self.seed}")

    @property
    def course(self) -> Course:
        """How the networks are trained: as the paper's are, as far as the epochs reach."""
        return Course(epochs=self.epochs, precision=self.precision)

    @property
    def plan(self) -> dict[str, Any]:
        """All that each figure depends on, beside the data; sets, systems and folds can be added, not weights."""
        options = {name: getattr(self, name) for name in ("epochs", "device", "seed", "quick", "precision")}
        return {"run": self.name, **options, "weights": None if self.weights is None else weights_digest(self.weights)}

    def cells(self, folds: Mapping[str, Sequence[int]]) -> list[Cell]:
        """The cells of these folds of each set, by name; set by set and system by system."""
        return [
            Cell(item.name, fold, key)
            for item in self.sets
            for key in self.systems
            for fold in folds[item.name]
            if not (item.sensor.camera and key in NOT_OF_FRAMES)
        ]

    def run(self, folds: Mapping[str, Sequence[int]], progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each cell as it is finished; those finished before are read back.

        Raises InputError for a folder of another run or folds that are not there, and what the systems raise.
        """
        for item in self.sets:
            for fold in folds[item.name]:
                split(item, fold, self.seed)  # what is refused is refused before anything is measured
        code = {f"the file of {key}": code_digest(key) for key in filter(is_own, self.systems)}
        yield from run_cells(self.folder, self.plan, self.sets, self.cells(folds), self._measure, progress, code)

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        raise NotImplementedError

    def _split(self, cell: Cell) -> Split:
        return split(self._by_name[cell.dataset], cell.fold, self.seed)

    def _system(self, cell: Cell) -> System:
        return self._catalogues[self._by_name[cell.dataset].sensor.name].make(cell.system)

    @cached_property
    def _by_name(self) -> dict[str, Recordings]:
        return {item.name: item for item in self.sets}

    @cached_property
    def _catalogues(self) -> dict[str, Catalogue]:
        # One for all sets of a sensor: other folds of the same touches need not be embedded again.
        return {item.sensor.name: self._catalogue(item) for item in self.sets}

    def _catalogue(self, recordings: Recordings) -> Catalogue:
        every = columns_averaged(recordings.sensor) if self.quick else 1
        sensor = recordings.sensor
        made = self.weights, self.course, self.device, every, self.seed
        return Catalogue(*made, channels=sensor.channels, camera=sensor.camera)


def columns_averaged(sensor: Sensor) -> int:
    """How many columns of a sensor's images are averaged in a quick run, so that about QUICK_COLUMNS are left."""
    columns = sensor.shape[1] if sensor.camera else sensor.readings
    return max(1, round(columns / QUICK_COLUMNS))


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


def choose_systems(
    asked: str | None,
    usual: Sequence[str],
    weights: str | None,
    own_systems: Sequence[str] | None,
    own_embeddings: Sequence[str] | None,
) -> tuple[str, ...]:
    """The systems of --systems, and one's own; without either all that can be made, and a word on the others.

    One's own may stand among --systems, too. Raises InputError for systems that there are not.
    """
    parts = [] if asked is None else [part.strip() for part in asked.split(",")]
    own = [*filter(is_own, parts), *(own_systems or ()), *(f"{spelled}-lda" for spelled in own_embeddings or ())]
    others = [part for part in parts if not is_own(part)]
    keys = (*(named("--systems", ",".join(others), usual) if others else ()), *own)
    for key in own:
        require_own(key)
    if keys:
        return tuple(dict.fromkeys(keys))
    able = leave_out(usual, lacking(usual), "their libraries (pip install -e '.[bench,spiking]')")
    return able if weights is not None else leave_out(able, NEED_WEIGHTS, "--weights")


def say_conditions(keys: Sequence[str], epochs: int, device: str, precision: str, *, quick: bool) -> None:
    """What the figures have to be read with."""
    if any(key in EPOCHAL for key in keys):
        short = "" if epochs >= 100 else " where the paper has 100"
        say(f"networks: {epochs} epochs{short}, on {device}, ResNets in {precision}; a tenth learned is the validation")
    if quick:
        say(
            "[yellow]quick:[/] every fifth touch, in training and test; ResNets' images averaged to about 50 columns: "
            "for a look, not for a report"
        )


def systems_of(keys: Sequence[str]) -> dict[str, dict[str, str]]:
    """Key → name and library of each system; the libraries' versions stand in what `circumstances` notes."""
    return {key: {"name": name_of(key), "library": library_of(key)} for key in keys}


def sensors_of(sets: Sequence[Recordings]) -> dict[str, Any]:
    """Set → its sensor, as results keep it."""
    return {recordings.name: recordings.sensor.model_dump(mode="json") for recordings in sets}


def close(
    context: typer.Context, study: SystemStudy, results: Sequence[tuple[Cell, Figures]], found: Mapping[str, Any]
) -> None:
    """Say what figures have to be read with, and folds of unequal size, and write the result."""
    say_conditions(study.systems, study.epochs, study.device, study.precision, quick=study.quick)
    for recordings in study.sets:
        sizes = {cell.fold: figures["tested"] for cell, figures in results if cell.dataset == recordings.name}
        if len(set(sizes.values())) > 1:
            listed = ", ".join(map(str, sizes.values()))
            say(f"{recordings.name}: folds of unequal size, {listed}: every touch counts the same")
    about = study.plan | {"systems": systems_of(study.systems), "seconds": sum(f["seconds"] for _, f in results)}
    cells = {cell.key: figures for cell, figures in results}
    write(context, about | {"sensors": sensors_of(study.sets), **found, "cells": cells})
