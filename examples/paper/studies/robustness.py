"""`robustness`: the default learner, told nothing but its sensor, trained on clean touches, on every kind of test.

A row is a way in which test touches differ; "session" and "novelty" are rows with learners of their own. Beside this
checkout's learner an older one's can answer the same touches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.cells import Cell, Figures, over_folds, require_folds, run_cells, silent
from examples.paper.runs.options import OF_TOUCHES, Data, Folds, Json, Quick, Run, Seed, folds_of, read
from examples.paper.runs.results import show, write
from examples.paper.runs.study import OwnSystems
from examples.paper.studies.default_learner import Answering, Answers, Checkout, answers
from examples.paper.studies.perturbations import dead, drift, gaussian, noise, speed
from examples.paper.studies.replay import novelty_area, rotations
from examples.paper.studies.strengths import require_channels
from examples.paper.systems.coming import answering, code_of, require_systems
from examples.paper.systems.own import is_own
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning.metrics import Labelled, accuracy, calibration_error
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, validate
from scroll_tactile.simulation.scene import EVENT_SKIN, LIGHT_PAD, Response, Scene

__all__ = [
    "FIGURES",
    "NOVELTY",
    "NOW",
    "PERTURBED",
    "SESSION",
    "Robustness",
    "Series",
    "Simulated",
    "others",
    "robustness",
    "summary",
]

PERTURBED: dict[str, Callable[[Stream, int], Stream]] = {
    "clean": lambda stream, seed: stream,
    "first": lambda stream, seed: stream.first(0.3),
    "half": lambda stream, seed: stream.first(stream.seconds / 2),
    "slow": lambda stream, seed: speed(stream, 0.5),
    "fast": lambda stream, seed: speed(stream, 2.0),
    "dead-fifth": lambda stream, seed: dead(stream, 0.2, seed),
    "dead-two-fifths": lambda stream, seed: dead(stream, 0.4, seed),
    "noise-half": lambda stream, seed: noise(stream, 0.5, seed),
    "noise-quarter": lambda stream, seed: noise(stream, 0.25, seed),
    "gaussian": lambda stream, seed: gaussian(stream, 0.5, seed),
    "drift": lambda stream, seed: drift(stream, 0.05, seed),
}
"""Row → how its test touches are made of clean ones."""

SESSION = "session"  # ten successive repetitions of fifty held out; nothing is perturbed
NOVELTY = "novelty"  # four of twenty materials never touched, five rotations; nothing is perturbed
NOW = "now"
FIGURES = ("accuracy", "calibration_error", "known", "wrong_known", "novelty_auroc")
"""Of a cell: shares of right answers, of touches called known, and of these that are taken for another material, of all
touches; expected calibration error; of novelty its AUROC."""

SIMULATED: dict[Response, Sensor] = {"events": EVENT_SKIN, "light": LIGHT_PAD}

RATE = 100.0  # readings a second of series that come without one


@dataclass(frozen=True)
class Fit:
    """What one learner learns, and on what it is tested: row → touches."""

    sensor: Sensor
    train: Sequence[Labelled]
    tests: Mapping[str, Sequence[Labelled]]


def _measure(fit: Fit, answering: Answering, progress: Progress) -> Figures:
    """Row → figures of a fit's tests."""
    train = [(material, stream.readings) for material, stream in fit.train]
    touches = {row: [stream.readings for _, stream in test] for row, test in fit.tests.items()}
    learned = {material for material, _ in fit.train}
    return {
        row: _figures([material for material, _ in fit.tests[row]], found, learned)
        for row, found in answering(fit.sensor, train, touches, progress)
    }


def _figures(truth: Sequence[str], found: Answers, learned: set[str]) -> Figures:
    new = [material not in learned for material in truth]
    if "probability" not in found:  # a system of one's own: it says materials alone
        return {"tested": len(truth)} | ({} if any(new) else {"accuracy": accuracy(truth, found["material"])})
    if any(new):
        return {"novelty_auroc": novelty_area(found["novelty"], new), "tested": len(truth)}
    right = [true == guess for true, guess in zip(truth, found["material"], strict=True)]
    return {
        "accuracy": accuracy(truth, found["material"]),
        "calibration_error": calibration_error(found["probability"], right),
        "known": float(np.mean(found["known"])),
        "wrong_known": float(np.mean(np.logical_and(found["known"], np.logical_not(right)))),
        "tested": len(truth),
    }


@dataclass(frozen=True)
class Robustness:
    """All rows of a recorded set.

    sides: by name, whose default learner answers, or which system of one's own, by its key. seed: of what perturbations
    draw. quick: no other session, and no materials left out. folder: where finished cells are kept, or None; a changed
    project's figures belong into another.

    Raises InputError for a negative seed and for a camera's frames.
    """

    recordings: Recordings
    sides: Mapping[str, Answering] = field(default_factory=lambda: {NOW: answers})
    seed: int = 0
    folder: Path | None = None
    quick: bool = False

    def __post_init__(self) -> None:
        require_channels(self.recordings, self.seed)

    def run(self, folds: Sequence[int], progress: Progress = silent) -> Iterator[dict[str, Any]]:
        """A record of each side, fold and row, fold by fold: `tested`, and the figures of FIGURES that the row has.

        Raises InputError for a fold that is not there or a folder of another run.
        """
        require_folds(self.recordings.fold, folds)
        plan = {"run": "robustness", "dataset": self.recordings.name, "seed": self.seed}
        for fold in folds:
            fits = self.fits(fold)
            cells = {
                Cell(self.recordings.name, fold, f"{side}, learner {i}"): (side, fit)
                for side in self.sides
                for i, fit in enumerate(fits)
            }
            rows: dict[str, dict[str, Figures]] = {side: {} for side in self.sides}
            measure = partial(self._cell, cells)
            code = code_of([side for side in self.sides if is_own(side)])
            for cell, figures in run_cells(self.folder, plan, [self.recordings], [*cells], measure, progress, code):
                rows[cells[cell][0]] |= figures["rows"]
            for side, own in rows.items():
                for row, found in _with_novelty(own).items():
                    yield {"side": side, "row": row, "fold": fold} | found

    def _cell(self, cells: Mapping[Cell, tuple[str, Fit]], cell: Cell, progress: Progress) -> Figures:
        side, fit = cells[cell]
        return {"rows": _measure(fit, self.sides[side], progress)}

    def fits(self, fold: int) -> list[Fit]:
        """What is learned and tested in a fold: the perturbed rows, the session if its order is known, rotations."""
        recordings = self.recordings
        train, test = hold_out(recordings, recordings.fold == fold)
        tests = {
            row: [(material, perturb(stream, self.seed)) for material, stream in test]
            for row, perturb in PERTURBED.items()
        }
        fits = [Fit(recordings.sensor, train, tests)]
        if self.quick:
            return fits
        if recordings.ordered:
            earlier, later = hold_out(recordings, recordings.blocked() == fold)
            fits.append(Fit(recordings.sensor, earlier, {SESSION: later}))
        for rotation, out in enumerate(rotations(recordings.materials)):
            if out:
                known = [touch for touch in train if touch[0] not in out]
                fits.append(Fit(recordings.sensor, known, {f"{NOVELTY} {rotation}": test}))
        return fits


def _with_novelty(rows: Mapping[str, Figures]) -> dict[str, Figures]:
    """The rows of a fold, with the mean of all rotations for one row of novelty."""
    turned = [figures for row, figures in rows.items() if row.startswith(NOVELTY)]
    found = {row: figures for row, figures in rows.items() if not row.startswith(NOVELTY)}
    if turned and "novelty_auroc" in turned[0]:
        area = float(np.mean([figures["novelty_auroc"] for figures in turned]))
        found[NOVELTY] = {"novelty_auroc": area, "tested": sum(figures["tested"] for figures in turned)}
    return found


@dataclass(frozen=True)
class Series:
    """Sets of series of other kinds of sensors, each with its published split.

    file: an .npz with, for each set NAME, `NAME/readings` (ΣT, n), `/lengths`, `/label`, `/test` (N each) and `/range`
    (low, high). They come without a rate, so 100 Hz is taken, and as the usual duration the median training length.

    Raises InputError where the file cannot be read.
    """

    file: Path

    def fits(self) -> dict[str, list[Fit]]:
        """Name → what is learned and tested."""
        try:
            with np.load(self.file) as kept:
                arrays = {key: kept[key] for key in kept.files}
            names = list(dict.fromkeys(key.partition("/")[0] for key in arrays))
            return {name: [_fit(name, *(arrays[f"{name}/{part}"] for part in _PARTS))] for name in names}
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"expected sets of series in {self.file}; they cannot be read: {error!r}") from error


@dataclass(frozen=True)
class Simulated:
    """Two simulated sensors that nothing was tuned on: a skin of events, and a pad that is hardly pressed.

    seed: of the scene. Twelve touches of each of its twenty materials are learned, and ten others tested; for novelty
    every fourth material is never touched.
    """

    seed: int = 0
    learned: int = 12
    tested: int = 10

    def fits(self) -> dict[str, list[Fit]]:
        """Name → what is learned and tested: all materials, and all but every fourth."""
        return {name: self._fits(Scene(sensor, self.seed, response=name)) for name, sensor in SIMULATED.items()}

    def _fits(self, scene: Scene) -> list[Fit]:
        names, later = scene.materials, range(1000, 1000 + self.tested)
        train = [(name, scene.touch(name, i)) for i in range(self.learned) for name in names]
        test = [(name, scene.touch(name, i)) for i in later for name in names]
        known = [touch for touch in train if touch[0] not in names[::4]]
        return [Fit(scene.sensor, train, {"clean": test}), Fit(scene.sensor, known, {NOVELTY: test})]


def others(
    kind: str,
    fits: Mapping[str, Sequence[Fit]],
    sides: Mapping[str, Answering],
    folder: Path | None,
    progress: Progress = silent,
) -> Iterator[dict[str, Any]]:
    """The record of each side and set in turn: side, name, `tested`, and figures; a set's fits are of one row each.

    kind: of the sets, which the folder of the run is of.
    """
    cells = {Cell(name, 0, side): own for name, own in fits.items() for side in sides}

    def measure(cell: Cell, report: Progress) -> Figures:
        found: Figures = {}
        for fit in cells[cell]:
            for figures in _measure(fit, sides[cell.system], report).values():
                found = figures | found
        return found

    data = {f"touches of {name}": _digest(own) for name, own in fits.items()}
    for cell, figures in run_cells(folder, {"run": f"robustness {kind}"}, [], [*cells], measure, progress, data):
        yield {"side": cell.system, "name": cell.dataset} | figures


def _digest(fits: Sequence[Fit]) -> str:
    digest = blake2b(digest_size=8)
    for fit in fits:
        for material, stream in [*fit.train, *(touch for test in fit.tests.values() for touch in test)]:
            digest.update(stream.key + material.encode())
    return digest.hexdigest()


_PARTS = ("readings", "lengths", "label", "test", "range")


def _fit(name: str, readings: Any, lengths: Any, label: Any, test: Any, limits: Any) -> Fit:
    test = test.astype(bool)
    sensor = Sensor(
        name=name,
        channels=readings.shape[1],
        rate=RATE,
        low=float(limits[0]),
        high=float(limits[1]),
        unit="",
        duration=float(np.median(lengths[~test])) / RATE,
    )
    streams = [validate(part, sensor) for part in np.split(readings, np.cumsum(lengths)[:-1])]
    touches = list(zip(map(str, label.tolist()), streams, test.tolist(), strict=True))
    train = [(material, stream) for material, stream, out in touches if not out]
    return Fit(sensor, train, {"clean": [(material, stream) for material, stream, out in touches if out]})


def summary(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    """Side → row → figure → mean, standard deviation over folds and their number, in the records' order."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for side, row in dict.fromkeys((record["side"], record["row"]) for record in records):
        own = [record for record in records if (record["side"], record["row"]) == (side, row)]
        for figure in FIGURES:
            if figure in own[0]:
                means = found.setdefault(side, {}).setdefault(row, {})
                means[figure] = over_folds([record[figure] for record in own])
    return found


def robustness(
    context: typer.Context,
    data: Data,
    sets: Annotated[str, typer.Option("--set", "--sets", help=f"Which data sets, of {', '.join(OF_TOUCHES)}.")] = (
        "biotac-20,roboskin-20,roboskin-20-unmixed"
    ),
    folds: Folds = "all",
    series: Annotated[
        Path | None, typer.Option(help="An .npz of series of other sensors: also measure these, split as published.")
    ] = None,
    before: Annotated[
        Path | None, typer.Option(help="An older checkout of the project, whose default learner is measured beside.")
    ] = None,
    own_systems: OwnSystems = None,
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Train the default learner on clean touches, nothing told to it, and test it on all that can befall a touch.

    Figures of a run's folder are read back: a changed project needs another.
    """
    sides: dict[str, Answering] = {NOW: answers}
    if before is not None:
        sides["before"] = Checkout(before)
    sides |= {key: answering(key, seed) for key in require_systems(own_systems)}
    if series is not None and not series.is_file():
        raise InputError(f"expected sets of series in {series}; there is no such file")
    found: dict[str, dict[str, Any]] = {side: {} for side in sides}
    tested: dict[str, str] = {}
    records: list[dict[str, Any]] = []
    with progress_bar() as progress:
        progress("reading", 0, 1)
        for name, recordings in read("--set", sets, data, seed, quick=quick).items():
            chosen = folds_of(folds, recordings, quick=quick)
            task = Robustness(recordings, sides, seed, None if run is None else run / recordings.name, quick)
            own = list(task.run(chosen, progress))
            for side, rows in summary(own).items():
                found[side][name] = rows
            tested[name] = ", ".join(map(str, chosen))
            records += [{"dataset": name} | record for record in own]
        of_others = {} if series is None else {"series": Series(series).fits()}
        of_others |= {} if quick else {"simulated": Simulated(seed).fits()}
        for kind, fits in of_others.items():
            for record in others(kind, fits, sides, None if run is None else run / kind, progress):
                rows = found[record["side"]].setdefault(kind, {})
                rows[record["name"]] = {figure: record[figure] for figure in FIGURES if figure in record}
                records.append(record)
    for side in sides if series is not None else ():
        shares = [row["accuracy"] for row in found[side]["series"].values()]
        found[side]["series"]["mean"] = {"accuracy": float(np.mean(shares))}
    _show(found)
    write(context, {"folds": tested} | found | {"records": records})


def _show(found: Mapping[str, Mapping[str, Any]]) -> None:
    """A table of each set: a row for each kind of test touches, the sides beside each other."""
    figures = {"right": "accuracy", "ECE": "calibration_error", "known": "known", "AUROC": "novelty_auroc"}
    for name, rows in found[NOW].items():
        single = name in ("series", "simulated")
        columns = {"test touches": "{./row}"}
        for side in found:
            for head, figure in figures.items():
                step = ".3f" if single else "±3"
                columns[head if side == NOW else f"{head}, {side}"] = f"{{?./{side}/{figure}|{step}}}"
        of = {row: {side: found[side].get(name, {}).get(row, {}) for side in found} for row in rows}
        show(name, columns, [{"row": row} | sides for row, sides in of.items()])
