"""Whether one default holds: a learner told nothing but its sensor, trained on clean touches, on every kind of test.

A row is a way in which test touches differ; "session" and "novelty" are rows with learners of their own. Each cell, a
row of a fold of a side, is written down when it is finished, and an interrupted run resumes with the next.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.cells import over_folds, require_data, require_folds
from examples.paper.studies.default_learner import Answering, Answers, answers
from examples.paper.studies.perturbations import dead, drift, gaussian, noise, speed
from examples.paper.studies.replay import novelty_area, rotations
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.pipelines.classification import Labelled
from scroll_tactile.pipelines.metrics import accuracy, calibration_error
from scroll_tactile.pipelines.runfile import RunFile
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, validate
from scroll_tactile.simulation.scene import EVENT_SKIN, LIGHT_PAD, Response, Scene

__all__ = ["FIGURES", "NOVELTY", "NOW", "PERTURBED", "SESSION", "Robustness", "Series", "Simulated", "summary"]

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

Progress = Callable[[str, int, int], object]
Figures = dict[str, Any]


@dataclass(frozen=True)
class Fit:
    """What one learner learns, and on what it is tested: row → touches."""

    sensor: Sensor
    train: Sequence[Labelled]
    tests: Mapping[str, Sequence[Labelled]]


def _measure(
    notes: RunFile, side: str, answering: Answering, fit: Fit, place: object, progress: Progress
) -> dict[str, Figures]:
    """Row → figures of a fit's tests: read back where they are noted, else measured and noted one by one."""
    keys = {row: f"{side}/{row}/{place}" for row in fit.tests}
    left = {row: test for row, test in fit.tests.items() if keys[row] not in notes.notes}
    if left:
        train = [(material, stream.readings) for material, stream in fit.train]
        begun = time.perf_counter()
        touches = {row: [stream.readings for _, stream in test] for row, test in left.items()}
        for row, found in answering(fit.sensor, train, touches, progress):
            truth = [material for material, _ in left[row]]
            figures = _figures(truth, found, {material for material, _ in fit.train})
            notes.note(keys[row], figures | {"seconds": time.perf_counter() - begun})
            begun = time.perf_counter()
    return {row: notes.notes[key] for row, key in keys.items()}


def _below(progress: Progress, where: str) -> Progress:
    return lambda what, i, of: progress(f"{where}: {what}", i, of)


def _figures(truth: Sequence[str], found: Answers, learned: set[str]) -> Figures:
    new = [material not in learned for material in truth]
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

    sides: by name, whose default learner answers. seed: of what perturbations draw. quick: no other session, and no
    materials left out. folder: where finished cells are kept, or None; a changed project's figures belong into another.

    Raises InputError for a negative seed and for a camera's frames.
    """

    recordings: Recordings
    sides: Mapping[str, Answering] = field(default_factory=lambda: {NOW: answers})
    seed: int = 0
    folder: Path | None = None
    quick: bool = False

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError(f"expected a seed of 0 or more; came {self.seed}")
        if self.recordings.sensor.camera:
            raise InputError(
                f"expected touches of channels, which are cut, resampled and made noisy along time; "
                f"{self.recordings.name} is of camera {self.recordings.sensor.name!r}"
            )

    @property
    def plan(self) -> dict[str, Any]:
        """What all figures depend on, in JSON's types; folds and sides can be added to a run later."""
        size = {"streams": len(self.recordings), "materials": len(set(self.recordings.materials))}
        embedding = repr(TactileLearner(sensor=self.recordings.sensor).embedding)
        about = {"run": "robustness", "dataset": self.recordings.name, "embedding": embedding}
        return about | size | {"seed": self.seed}

    def run(
        self, folds: Sequence[int], progress: Progress = lambda what, done, of: None
    ) -> Iterator[list[dict[str, Any]]]:
        """The records of each fold in turn: side, row, fold, `tested`, and the figures of FIGURES that the row has.

        Raises InputError for a fold that is not there or a folder of another run.
        """
        require_folds(self.recordings.fold, folds)
        notes = RunFile(None if self.folder is None else self.folder / "robustness.json", self.plan)
        require_data(notes, self.recordings)
        for fold in folds:
            fits = self.fits(fold)
            yield [
                {"side": side, "row": row, "fold": fold} | figures
                for side, answering in self.sides.items()
                for row, figures in self._rows(notes, side, answering, fits, fold, progress).items()
            ]

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

    def _rows(
        self, notes: RunFile, side: str, answering: Answering, fits: Sequence[Fit], fold: int, progress: Progress
    ) -> dict[str, Figures]:
        rows: dict[str, Figures] = {}
        for i, fit in enumerate(fits):
            where = f"{self.recordings.name}, fold {fold}, {side}, learner {i + 1} of {len(fits)}"
            rows |= _measure(notes, side, answering, fit, fold, _below(progress, where))
        turned = [rows.pop(row) for row in list(rows) if row.startswith(NOVELTY)]
        if not turned:
            return rows
        area = float(np.mean([figures["novelty_auroc"] for figures in turned]))
        sums = {name: sum(figures.get(name, 0) for figures in turned) for name in ("tested", "seconds")}
        return rows | {NOVELTY: {"novelty_auroc": area} | sums}


@dataclass(frozen=True)
class Series:
    """Sets of series of other kinds of sensors, each with its published split.

    file: an .npz with, for each set NAME, `NAME/readings` (ΣT, n), `/lengths`, `/label`, `/test` (N each) and `/range`
    (low, high). They come without a rate, so 100 Hz is taken, and as the usual duration the median training length.

    Raises InputError where the file cannot be read.
    """

    file: Path
    sides: Mapping[str, Answering] = field(default_factory=lambda: {NOW: answers})
    folder: Path | None = None

    def fits(self) -> dict[str, Fit]:
        """Name → what is learned and tested."""
        try:
            with np.load(self.file) as kept:
                arrays = {key: kept[key] for key in kept.files}
            names = list(dict.fromkeys(key.partition("/")[0] for key in arrays))
            return {name: _fit(name, *(arrays[f"{name}/{part}"] for part in _PARTS)) for name in names}
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"expected sets of series in {self.file}; they cannot be read: {error!r}") from error

    def run(self, progress: Progress = lambda what, done, of: None) -> Iterator[dict[str, Any]]:
        """The record of each side and set in turn: side, name, `tested`, and figures.

        Raises InputError for a folder of another run.
        """
        fits = {name: [fit] for name, fit in self.fits().items()}
        yield from _each(fits, self.sides, self.folder, {"run": "robustness, series"}, progress)


@dataclass(frozen=True)
class Simulated:
    """Two simulated sensors that nothing was tuned on: a skin of events, and a pad that is hardly pressed.

    seed: of the scene. Twelve touches of each of its twenty materials are learned, and ten others tested; for novelty
    every fourth material is never touched.
    """

    seed: int = 0
    sides: Mapping[str, Answering] = field(default_factory=lambda: {NOW: answers})
    folder: Path | None = None
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

    def run(self, progress: Progress = lambda what, done, of: None) -> Iterator[dict[str, Any]]:
        """The record of each side and sensor in turn, as of `Series`, with the AUROC of novelty."""
        plan = {"run": "robustness, simulated", "seed": self.seed, "touches": [self.learned, self.tested]}
        yield from _each(self.fits(), self.sides, self.folder, plan, progress)


def _each(
    fits: Mapping[str, Sequence[Fit]],
    sides: Mapping[str, Answering],
    folder: Path | None,
    plan: dict[str, Any],
    progress: Progress,
) -> Iterator[dict[str, Any]]:
    """The record of each side and set in turn; a set's fits are of one row each."""
    notes = RunFile(None if folder is None else folder / "robustness.json", plan)
    for name, own in fits.items():
        for side, answering in sides.items():
            found: dict[str, Any] = {"side": side, "name": name}
            for fit in own:
                rows = _measure(notes, side, answering, fit, name, _below(progress, f"{name}, {side}"))
                for figures in rows.values():
                    found = figures | found
            yield found


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
