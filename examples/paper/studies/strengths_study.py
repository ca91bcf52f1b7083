"""Strengths: systems that trained on clean touches, tested on touches that were made or recorded otherwise.

A study is a grid of strengths, systems, without augmentation and with it where they have any, and folds. A system
learns a fold once, for all of its studies; only "session" (folds of successive repetitions: tomorrow's touches) has
training touches of its own. Each cell is written down when it is finished, and an interrupted run resumes with the
next.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.cells import over_folds, require_data, require_folds
from examples.paper.studies.perturbations import dead, drift, length, noise, speed
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.pipelines.classification import Labelled, observe_all
from scroll_tactile.pipelines.metrics import accuracy
from scroll_tactile.pipelines.runfile import RunFile
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream

__all__ = ["NAMES", "PAPER", "PERTURBED", "SESSION", "Learned", "Make", "Strengths", "TestedSystem", "ours", "summary"]


@dataclass(frozen=True)
class Perturbation:
    """A way in which test touches differ, and how strongly.

    perturb: makes a stream of a stream, a strength and a seed. strengths: those of a full study. quick: of a quick one.
    """

    perturb: Callable[[Stream, float, int], Stream]
    strengths: tuple[float, ...]
    quick: tuple[float, ...]

    def of(self, sensor: Sensor, *, quick: bool = False) -> tuple[float, ...]:
        """The strengths for a sensor: of lengths those below the usual one, and then it."""
        chosen = self.quick if quick else self.strengths
        if self.perturb is not length:
            return chosen
        return (*(seconds for seconds in chosen if seconds < sensor.duration), sensor.duration)


PERTURBED = {
    "length": Perturbation(length, (0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 2.0), (0.3,)),
    "speed": Perturbation(speed, (0.25, 0.5, 0.71, 1.0, 1.41, 2.0, 4.0), (0.5, 1.0, 2.0)),
    "noise": Perturbation(noise, (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0), (0.0, 0.5)),
    "dead": Perturbation(dead, (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5), (0.0, 0.2)),
    "drift": Perturbation(drift, (0.0, 0.01, 0.02, 0.05, 0.1, 0.2), (0.0, 0.05)),
}
"""Study → how its test touches differ."""

SESSION = "session"  # folds of successive repetitions; nothing is perturbed
NAMES = (*PERTURBED, SESSION)
"""The names of the studies."""

PAPER = {("noise", 0.5): {"RoboSkin-20": 0.80, "BioTac-50": 0.73}}
"""(study, strength) → data set → the paper's accuracy, of its pre-trained network with its augmentation. It has BioTac
with fifty materials, which are not ours to compare with, and of length and speed curves without numbers."""

Progress = Callable[[str, int, int], object]


class TestedSystem(Protocol):
    """Whatever names the materials of touches."""

    def predict(self, streams: Sequence[Stream]) -> Sequence[str | None]:
        """The material of each of N streams."""
        ...


Make = Callable[[Sequence[Labelled], bool, Progress], TestedSystem]
"""Makes a system that has learned these touches, with its augmentation (True) or without; reports how far it is."""


class Learned:
    """A learner as a system: the material of the most probable answer, known or not."""

    def __init__(self, learner: TactileLearner) -> None:
        self.learner = learner

    def predict(self, streams: Sequence[Stream]) -> list[str | None]:
        """The material of each of N streams."""
        return [self.learner.predict(stream).material for stream in streams]


def ours(sensor: Sensor) -> tuple[Make, dict[str, Any]]:
    """The default learner of a sensor, and what it depends on; it has no augmentation."""

    def make(train: Sequence[Labelled], augmented: bool, progress: Progress) -> TestedSystem:
        learner = TactileLearner(sensor=sensor, exemplars=0)
        done = count()
        observe_all(learner, train, lambda: progress("learning", next(done) + 1, len(train)))
        return Learned(learner)

    return make, {"embedding": repr(TactileLearner(sensor=sensor).embedding)}


@dataclass(frozen=True)
class Strengths:
    """What to study.

    recordings: the touches. systems: by name, what makes and trains each. settings: by name, all that a system's
    answers depend on beside its name, in JSON's types, so that what other settings gave is not mixed in.
    studies: out of NAMES. augmented: with augmentation (True), without, or both. plain: the systems that have none.
    seed: of what perturbations draw. quick: fewer strengths. folder: where finished cells are kept, or None.

    Raises InputError for studies that there are not and for a camera's frames, and DatasetError for "session" where the
    order of recording is not known.
    """

    recordings: Recordings
    systems: Mapping[str, Make]
    settings: Mapping[str, Any] = field(default_factory=dict)
    studies: Sequence[str] = NAMES
    augmented: Sequence[bool] = (False, True)
    plain: Sequence[str] = ()
    seed: int = 0
    quick: bool = False
    folder: Path | None = None

    def __post_init__(self) -> None:
        strange = [name for name in self.studies if name not in NAMES]
        if strange or not self.studies:
            raise InputError(f"expected studies out of {', '.join(NAMES)}; came {strange or 'none'}")
        if self.seed < 0:
            raise InputError(f"expected a seed of 0 or more; came {self.seed}")
        if SESSION in self.studies:
            self.recordings.blocked()
        if self.recordings.sensor.camera:
            raise InputError(
                f"expected touches of channels, which are cut, resampled and made noisy along time; "
                f"{self.recordings.name} is of camera {self.recordings.sensor.name!r}"
            )

    @property
    def plan(self) -> dict[str, Any]:
        """What all figures depend on, in JSON's types; studies, folds and systems can be added to a run later."""
        size = {"streams": len(self.recordings), "materials": len(set(self.recordings.materials))}
        return {"run": "strengths", "dataset": self.recordings.name, **size, "seed": self.seed}

    def run(
        self, folds: Sequence[int], progress: Progress = lambda what, done, of: None
    ) -> Iterator[list[dict[str, Any]]]:
        """The records of each fold in turn, as they are finished; cells finished before are read back.

        A record holds study, strength, system, augmented, fold, accuracy (a share), tested (touches) and seconds.

        Raises InputError for a fold that is not there, a folder of another run, or one that holds what a system gave
        under other settings.
        """
        require_folds(self.recordings.fold, folds)
        notes = RunFile(None if self.folder is None else self.folder / "strengths.json", self.plan)
        require_data(notes, self.recordings)
        for name in self.systems:
            self._require_settings(notes, name)
        for fold in folds:
            cells = self.cells(fold)
            yield [
                record
                for system in self.systems
                for augmented in ((False,) if system in self.plain else self.augmented)
                for record in self._records(system, augmented, cells, notes, progress)
            ]

    def cells(self, fold: int) -> list[tuple[str, float, int]]:
        """(study, strength, fold) of all that is asked of a system in a fold."""
        sensor = self.recordings.sensor
        return [
            (study, strength, fold)
            for study in self.studies
            for strength in ((0.0,) if study == SESSION else PERTURBED[study].of(sensor, quick=self.quick))
        ]

    def _require_settings(self, notes: RunFile, name: str) -> None:
        given = json.loads(json.dumps(self.settings.get(name)))
        kept = notes.notes.setdefault(f"settings of {name}", given)
        if kept != given:
            raise InputError(
                f"the run in {notes.path} was begun with other settings of {name}: {kept} there, {given} here. Ask for "
                "the same, or take another folder"
            )

    def _records(
        self,
        name: str,
        augmented: bool,
        cells: Sequence[tuple[str, float, int]],
        notes: RunFile,
        progress: Progress,
    ) -> Iterator[dict[str, Any]]:
        systems: dict[bool, TestedSystem] = {}  # by whether it has learned for "session"
        what = f"{name}{', augmented' if augmented else ''}"
        for done, (study, strength, fold) in enumerate(cells):
            where = f"fold {fold}: {what}: {study} {strength:g}"
            progress(where, done, len(cells))
            key = f"{study}/{strength:g}/{name}/{'augmented' if augmented else 'plain'}/{fold}"
            if key not in notes.notes:
                begun = time.perf_counter()
                session = study == SESSION
                train, test = self._split(fold, session)
                if session not in systems:

                    def report(step: str, i: int, of: int, where: str = where) -> None:
                        progress(f"{where}: {step}", i, of)

                    systems[session] = self.systems[name](train, augmented, report)
                asked = test if session else self._perturbed(test, study, strength)
                predicted = systems[session].predict([stream for _, stream in asked])
                share = accuracy([material for material, _ in asked], list(predicted))
                seconds = time.perf_counter() - begun  # of the first strength the training's, too
                notes.note(key, {"accuracy": share, "tested": len(asked), "seconds": seconds})
            about = {"study": study, "strength": strength, "system": name, "augmented": augmented, "fold": fold}
            yield about | notes.notes[key]

    def _perturbed(self, test: Sequence[Labelled], study: str, strength: float) -> list[Labelled]:
        perturb = PERTURBED[study].perturb
        return [(material, perturb(stream, strength, self.seed)) for material, stream in test]

    def _split(self, fold: int, session: bool) -> tuple[list[Labelled], list[Labelled]]:
        places: npt.NDArray[np.int64] = self.recordings.blocked() if session else self.recordings.fold
        return hold_out(self.recordings, places == fold)


def summary(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Mean, standard deviation and all folds' shares of each (study, strength, system, augmented), in their order."""
    groups: dict[tuple[Any, ...], list[float]] = {}
    for record in records:
        cell = tuple(record[name] for name in ("study", "strength", "system", "augmented"))
        groups.setdefault(cell, []).append(record["accuracy"])
    rows = []
    for (study, strength, system, augmented), values in groups.items():
        about = {"study": study, "strength": strength, "system": system, "augmented": augmented}
        rows.append(about | over_folds(values) | {"by_fold": values})
    return rows
