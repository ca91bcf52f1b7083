"""`transfer sensors`: materials learned with one, and tested with another, after few touches of it or none.

Every way stands beside learning from these few touches alone, and all have the same draws of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import Cell, Figures, run_cells, silent
from examples.paper.runs.options import Data, Folds, Json, Quick, Run, Seed, folds_of, named, numbers, read
from examples.paper.runs.results import show, write
from examples.paper.runs.study import sensors_of
from examples.paper.studies.peers import touch_features
from examples.paper.transfer.aligning import Known, MapsAcross, OneReadout, SharesPrior
from examples.paper.transfer.few_touches import FewTouchLearner, candidate_maker, draw_touches, few_touches, points_of
from examples.paper.transfer.shared_features import Features, SharedFeatures
from scroll_tactile import Kernels
from scroll_tactile.clients.cli.terminal import percent, progress_bar, say
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.signals.stream import Stream

__all__ = ["ALONE", "COUNTS", "WAYS", "SensorTransfer", "rows", "sensors"]

COUNTS = (0, 1, 2, 5)
"""Touches of each material of the new sensor."""

ALONE = "alone"
WAYS = {
    ALONE: "the few touches alone (TactileLearner, kernels)",
    "spectra-alone": "the few touches alone, spectra",
    "as-they-are": "spectra as they are, the old sensor's readout",
    "standardised": "spectra, each standardised on its sensor",
    "resampled": "kernels of ten channels, each standardised on its sensor",
    "together": "spectra of both sensors' touches learned together",
    "scatter": "spectra: scatter of the old sensor, means of the new",
    "ridge-map": "kernels mapped to the old sensor's means by ridge regression",
    "procrustes": "kernels turned to the old sensor's means (Procrustes)",
    "prior": "means drawn together as the old sensor's lie",
    "prior-control": "… as if all lay apart alike",
}
"""Key → name, as in tables."""

_BLIND = ("as-they-are", "standardised", "resampled")  # ways that need no labelled touch of the new sensor
_IN_KERNELS = ("ridge-map", "procrustes", "prior", "prior-control")
LIKENESS = 0.3
"""Of "prior", set with one fold: 0.3, 0.6 and 0.9 gain −0.1, 0 and −0.4 points (± 0.1 to 0.2) with one touch of
RoboSkin, and 0.7, 1.0 and 0 (± 0.5) with one of BioTac, over 0, the control."""


@dataclass(frozen=True)
class SensorTransfer:
    """Two sensors that touched the same materials; each is learned with in turn, and the other tested.

    sets: two, of different sensors without a camera, with the same materials. ways: keys of WAYS.
    folds: tested, of the new sensor; counts: touches of each material of the new sensor, 0 or more; draws: of these.
    seed: of the draws. folder: where finished cells are noted, so that a killed run resumes; or None.

    What is not labelled of the new sensor's touches outside the fold serves "standardised" and "resampled": each
    feature's mean and spread. Raises InputError for what cannot be.
    """

    sets: tuple[Recordings, Recordings]
    ways: tuple[str, ...] = tuple(WAYS)
    folds: tuple[int, ...] = (0,)
    counts: tuple[int, ...] = COUNTS
    draws: int = 5
    seed: int = 0
    folder: Path | None = None

    def __post_init__(self) -> None:
        item, other = self.sets
        if item.sensor == other.sensor or set(item.materials) != set(other.materials):
            raise InputError(
                f"expected two sensors that touched the same materials; came {item.sensor.name!r} with "
                f"{len(set(item.materials))} and {other.sensor.name!r} with {len(set(other.materials))} materials, "
                f"{len(set(item.materials) & set(other.materials))} of them the same"
            )
        strange = [key for key in self.ways if key not in WAYS]
        if strange or not self.ways:
            raise InputError(f"expected ways out of {', '.join(WAYS)}; came {', '.join(strange) or 'none'}")
        if not self.folds or not self.counts or min(self.counts) < 0 or self.draws < 1 or self.seed < 0:
            raise InputError(
                "expected one fold or more, counts of 0 touches or more, 1 draw or more and a seed of 0 or more; came "
                f"folds {self.folds}, counts {self.counts}, draws {self.draws}, seed {self.seed}"
            )
        SharedFeatures((item.sensor, other.sensor))

    @property
    def plan(self) -> dict[str, Any]:
        """All that each figure depends on, beside the data; ways and folds can be added to a run later."""
        return {"run": "transfer sensors", "counts": self.counts, "draws": self.draws, "seed": self.seed}

    @property
    def chance(self) -> float:
        """The share that is right of answers given blindly."""
        return 1 / len(set(self.sets[0].materials))

    def cells(self) -> list[Cell]:
        """A direction's name, a fold of the new sensor and a way each; those in which something is asked."""
        return [
            Cell(name, fold, way)
            for name in self._directions
            for fold in self.folds
            for way in self.ways
            if self._counts_of(way)
        ]

    def run(self, progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each cell as it is finished; those finished before are read back.

        Raises InputError for a folder of another run or folds that are not there, and what learning raises.
        """
        for item in self.sets:
            for fold in self.folds:
                draw_touches(item, fold, self.seed, 0)  # what is refused is refused before anything is measured
        yield from run_cells(self.folder, self.plan, self.sets, self.cells(), self._measure, progress)

    def agreement(self) -> dict[str, dict[str, float]]:
        """How far the sensors agree on which materials feel alike: of spectra and kernels, all touches.

        correlation: over pairs of materials, of the cosines between their means where the scatter within is white;
        chance: its standard deviation where one sensor's materials are exchanged at random.
        """
        found = {}
        random = np.random.default_rng([self.seed, 1])
        pairs = np.triu_indices(len(set(self.sets[0].materials)), 1)
        for kind in ("spectra", "kernels"):
            ours, theirs = (self._known(item, kind, silent).likeness for item in self.sets)
            exchanged = [random.permutation(len(ours)) for _ in range(200)]
            by_chance = [_correlation(ours[np.ix_(order, order)][pairs], theirs[pairs]) for order in exchanged]
            found[kind] = {
                "correlation": _correlation(ours[pairs], theirs[pairs]),
                "chance": float(np.std(by_chance)),
            }
        return found

    @cached_property
    def _directions(self) -> dict[str, tuple[Recordings, Recordings]]:
        """Name → what is learned with, and what is tested with."""
        item, other = self.sets
        return {f"{old.name} → {new.name}": (old, new) for old, new in ((item, other), (other, item))}

    def _counts_of(self, way: str) -> list[int]:
        return [count for count in self.counts if (count == 0) == (way in _BLIND)]

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        old, new = self._directions[cell.dataset]
        make = self._maker(cell.system, old, new, cell.fold, progress)
        draws = 1 if cell.system in _BLIND else self.draws  # nothing is drawn without touches
        counts = self._counts_of(cell.system)
        return few_touches(new, cell.fold, make, counts, draws, self.seed, progress)

    def _maker(
        self, way: str, old: Recordings, new: Recordings, fold: int, progress: Progress
    ) -> Callable[[], FewTouchLearner]:
        """What makes new learners of a way."""
        if way == ALONE:
            return candidate_maker(new.sensor, self._kernels)
        kind = "resampled" if way == "resampled" else "kernels" if way in _IN_KERNELS else "spectra"
        features = self._features[kind]
        if way == "spectra-alone":
            return lambda: OneReadout(features, None)
        known = self._known(old, kind, progress)
        if way in ("ridge-map", "procrustes"):
            return lambda: MapsAcross(features, known, turned=way == "procrustes")
        if way in ("prior", "prior-control"):
            return lambda: SharesPrior(features, known, likeness=LIKENESS if way == "prior" else 0.0)
        if way in ("standardised", "resampled"):
            unlabelled = np.array([features(new.streams[i]) for i in np.flatnonzero(new.fold != fold)])
            return lambda: OneReadout(features, known, unlabelled=unlabelled)
        return lambda: OneReadout(features, known, as_it_is=way == "as-they-are", apart=way == "scatter")

    def _known(self, old: Recordings, kind: str, progress: Progress) -> Known:
        vectors = []
        for done, stream in enumerate(old.streams):
            vectors.append(self._features[kind](stream))
            progress(f"{kind} of {old.name}", done + 1, len(old))
        return Known(np.array(vectors), list(old.materials))

    @cached_property
    def _kernels(self) -> Cached:
        return Cached(Kernels())

    @cached_property
    def _features(self) -> dict[str, Features]:
        shared = SharedFeatures((self.sets[0].sensor, self.sets[1].sensor))
        made: dict[str, Features] = {
            "spectra": shared.spectra,
            "resampled": shared.resampled(Kernels()),
            "kernels": lambda stream: touch_features(self._kernels, [stream])[0],
        }
        return {name: _kept(features) for name, features in made.items()}


def _correlation(item: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> float:
    return float(np.corrcoef(item, other)[0, 1])


def _kept(features: Features) -> Features:
    """The same features, of each touch computed once."""
    found: dict[bytes, npt.NDArray[np.float64]] = {}

    def keep(stream: Stream) -> npt.NDArray[np.float64]:
        if stream.key not in found:
            found[stream.key] = features(stream)
        return found[stream.key]

    return keep


def rows(results: Sequence[tuple[Cell, Figures]]) -> list[dict[str, Any]]:
    """A row for each direction and way, with `points_of` it; gains are over the few touches alone."""
    return [
        {"direction": direction, "way": way, "name": WAYS[way], "points": points}
        for (direction, way), points in points_of(results, ALONE).items()
    ]


def sensors(
    context: typer.Context,
    data: Data,
    folds: Folds = "all",
    ways: Annotated[str, typer.Option(help=f"Which ways, of {', '.join(WAYS)}.")] = ",".join(WAYS),
    counts: Annotated[str, typer.Option(help="Touches of each material of the new sensor; 0: none.")] = "0,1,2,5",
    draws: Annotated[int, typer.Option(min=1, help="Of these touches.")] = 5,
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Learn twenty materials with BioTac and be tested with RoboSkin, and the reverse, after few touches or none."""
    with progress_bar() as progress:
        progress("reading", 0, 1)
        item, other = read("--data", "biotac-20,roboskin-20", data, seed, quick=quick).values()
        study = SensorTransfer(
            (item, other),
            ways=named("--ways", ways, WAYS),
            folds=tuple(folds_of(folds, item, quick=quick)),
            counts=tuple(sorted(set(numbers("--counts", counts)))),
            draws=1 if quick else draws,
            seed=seed,
            folder=run,
        )
        results = list(study.run(progress))
        progress("how far the sensors agree", 0, 1)
        agreement = study.agreement()
    found = rows(results)
    columns = {"way": "{./name}"} | {f"{count} touches": f"{{?./points/{count}|±}}" for count in study.counts}
    for direction in dict.fromkeys(row["direction"] for row in found):
        show(f"{direction}: right, %", columns, [row for row in found if row["direction"] == direction])
    text = ", ".join(f"{by['correlation']:+.2f} in {kind} ({by['chance']:.2f})" for kind, by in agreement.items())
    say(f"chance: {percent(study.chance)}. Materials alike to one sensor and to the other: {text} (by chance)")
    measured = {"folds": study.folds, "chance": study.chance, "agreement": agreement, "rows": found}
    cells = {cell.key: figures for cell, figures in results}
    write(context, study.plan | {"sensors": sensors_of(study.sets), **measured, "cells": cells})
