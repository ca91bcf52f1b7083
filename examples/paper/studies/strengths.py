"""`strengths`: systems that trained on clean touches, tested on touches that were made or recorded otherwise.

A study is a grid of strengths, systems, without augmentation and with it where they have any, and folds. A system
learns a fold once, for all of its studies; only "session" (folds of successive repetitions: tomorrow's touches) has
training touches of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer

from examples.paper.readers.labelled import Recordings, hold_out, thinned
from examples.paper.runs.cells import Cell, Figures, learn, over_folds, require_folds, run_cells, silent
from examples.paper.runs.options import (
    OF_TOUCHES,
    QUICK_EPOCHS,
    Data,
    Device,
    Epochs,
    Folds,
    InPrecision,
    Json,
    Plot,
    Quick,
    Run,
    Seed,
    Weights,
    folds_of,
    leave_out,
    named,
    read,
)
from examples.paper.runs.pictures import draw_into
from examples.paper.runs.results import show, write
from examples.paper.runs.study import (
    OwnEmbeddings,
    OwnSystems,
    choose_systems,
    columns_averaged,
    say_conditions,
    sensors_of,
    systems_of,
    weights_digest,
)
from examples.paper.studies.baselines import BASELINES, baseline
from examples.paper.studies.perturbations import dead, drift, length, noise, speed
from examples.paper.studies.strengths_picture import draw_robustness
from examples.paper.systems.catalogue import NEED_WEIGHTS, Catalogue
from examples.paper.systems.descent import Course
from examples.paper.systems.trained import require_device
from scroll_tactile.clients.cli.terminal import progress_bar, say
from scroll_tactile.clients.learning.metrics import Labelled, accuracy
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream

__all__ = ["NAMES", "PAPER", "PERTURBED", "SESSION", "Learned", "Make", "Strengths", "ours", "strengths", "summary"]

OURS = "ours"
IN_THE_PAPER = ("length", "speed", "noise")
"""The studies that the paper has a figure of."""
Rows = Sequence[Mapping[str, Any]]


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
        return Learned(learn(learner, train, progress))

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
        if SESSION in self.studies:
            self.recordings.blocked()
        require_channels(self.recordings, self.seed)

    @property
    def plan(self) -> dict[str, Any]:
        """What all figures depend on, in JSON's types; studies, folds and systems can be added to a run later."""
        return {"run": "strengths", "dataset": self.recordings.name, "seed": self.seed}

    def run(self, folds: Sequence[int], progress: Progress = silent) -> Iterator[dict[str, Any]]:
        """The records of each fold in turn, as they are finished; cells finished before are read back.

        A record holds study, strength, system, augmented, fold, accuracy (a share), tested (touches) and seconds.

        Raises InputError for a fold that is not there, a folder of another run, or one that holds what a system gave
        under other settings.
        """
        require_folds(self.recordings.fold, folds)
        records = [
            {"study": study, "strength": strength, "system": name, "augmented": augmented, "fold": fold}
            for fold in folds
            for name in self.systems
            for augmented in ((False,) if name in self.plain else self.augmented)
            for study, strength in self.strengths()
        ]
        about = {_cell(self.recordings.name, record): record for record in records}
        trained: dict[tuple[Any, ...], TestedSystem] = {}  # the last one, and for "session" another
        settings = {f"settings of {name}": self.settings.get(name) for name in self.systems}
        measure = partial(self._measure, about, trained)
        data, cells = [self.recordings], list(about)
        for cell, figures in run_cells(self.folder, self.plan, data, cells, measure, progress, settings):
            yield about[cell] | figures

    def strengths(self) -> list[tuple[str, float]]:
        """(study, strength) of all that is asked of a system in a fold."""
        sensor = self.recordings.sensor
        return [
            (study, strength)
            for study in self.studies
            for strength in ((0.0,) if study == SESSION else PERTURBED[study].of(sensor, quick=self.quick))
        ]

    def _measure(
        self, about: Mapping[Cell, dict[str, Any]], trained: dict[Any, TestedSystem], cell: Cell, progress: Progress
    ) -> Figures:
        record = about[cell]
        session = record["study"] == SESSION
        train, test = hold_out(
            self.recordings, (self.recordings.blocked() if session else self.recordings.fold) == cell.fold
        )
        known = cell.fold, record["system"], record["augmented"], session
        if known not in trained:
            trained.clear()
            trained[known] = self.systems[record["system"]](train, record["augmented"], progress)
        asked = test if session else self.perturbed(test, record["study"], record["strength"])
        predicted = trained[known].predict([stream for _, stream in asked])
        share = accuracy([material for material, _ in asked], list(predicted))
        return {"accuracy": share, "tested": len(asked)}

    def perturbed(self, test: Sequence[Labelled], study: str, strength: float) -> list[Labelled]:
        """Touches as a study has them."""
        perturb = PERTURBED[study].perturb
        return [(material, perturb(stream, strength, self.seed)) for material, stream in test]


def require_channels(recordings: Recordings, seed: int) -> None:
    """Raise InputError for a negative seed and for a camera's frames."""
    if seed < 0:
        raise InputError(f"expected a seed of 0 or more; came {seed}")
    if recordings.sensor.camera:
        raise InputError(
            f"expected touches of channels, which are cut, resampled and made noisy along time; "
            f"{recordings.name} is of camera {recordings.sensor.name!r}"
        )


def _cell(dataset: str, record: Mapping[str, Any]) -> Cell:
    how = "augmented" if record["augmented"] else "plain"
    return Cell(dataset, record["fold"], f"{record['study']} {record['strength']:g}, {record['system']}, {how}")


def summary(records: Rows) -> list[dict[str, Any]]:
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


def strengths(
    context: typer.Context,
    study: Annotated[
        str, typer.Argument(help=f"How test touches differ: {', '.join(NAMES)}; paper: the first three; or all.")
    ],
    data: Data,
    sets: Annotated[
        str, typer.Option(help=f"Which data sets, of {', '.join(OF_TOUCHES)}; a picture for each, of each study.")
    ] = "biotac-20,roboskin-20",
    systems: Annotated[str, typer.Option(help=f"Which systems, of {OURS}, {', '.join(BASELINES)}; or all.")] = OURS,
    own_systems: OwnSystems = None,
    own_embeddings: OwnEmbeddings = None,
    weights: Weights = None,
    folds: Folds = "all",
    every: Annotated[int, typer.Option(min=1, help="Learn and test one of so many touches.")] = 1,
    seed: Seed = 0,
    epochs: Epochs = None,
    device: Device = "cpu",
    precision: InPrecision = "float32",
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
) -> None:
    """Train on clean touches, test on shorter, faster, noisier ones; ours as it is, others with augmentation, too.

    A system learns a fold once, with one setting, for all studies; only another recording session has folds of its own.
    """
    require_device(device)
    keys = _choose(systems, (OURS, *BASELINES), weights, own_systems, own_embeddings)
    passes = epochs or (QUICK_EPOCHS if quick else 100)
    course = Course.in_proportion(passes, precision)
    needed = {} if weights is None else {"weights": weights_digest(weights)}
    means: list[dict[str, Any]] = []
    plans: dict[str, Any] = {}
    seconds = 0.0
    with progress_bar() as progress:
        progress("reading", 0, 1)
        found = read("--sets", sets, data, seed, quick=quick)
        for recordings in (thinned(item, every) for item in found.values()):
            columns = columns_averaged(recordings.sensor) if quick else 1
            catalogue = Catalogue(weights, course, device, columns, seed, channels=recordings.sensor.channels)
            made = {key: ours(recordings.sensor) if key == OURS else baseline(key, catalogue, seed) for key in keys}
            settings = {key: given | (needed if key in NEED_WEIGHTS else {}) for key, (_, given) in made.items()}
            makes = {key: make for key, (make, _) in made.items()}
            asked, folder = _studies(study, recordings), None if run is None else run / recordings.name
            task = Strengths(recordings, makes, settings, asked, plain=(OURS,), seed=seed, quick=quick, folder=folder)
            records = list(task.run(folds_of(folds, recordings, quick=quick), progress))
            plans[recordings.name] = {**task.plan, "settings": settings}
            seconds += sum(record["seconds"] for record in records)
            means += [{"dataset": recordings.name} | row for row in summary(records)]
    _show(means)
    say_conditions(keys, passes, device, precision, quick=quick)
    about = {"systems": systems_of(keys), "seconds": seconds, "sensors": sensors_of([*found.values()])}
    write(context, about | {"sets": plans, "means": means})
    _draw(plot, means)


def _choose(
    systems: str,
    choices: Sequence[str],
    weights: str | None,
    own_systems: Sequence[str] | None,
    own_embeddings: Sequence[str] | None,
) -> tuple[str, ...]:
    """The systems of --systems, and one's own; of "all" those that can be made, and a word on the others.

    Raises InputError for systems that there are not, and those that need weights which are not given.
    """
    if systems == "all" and weights is None:
        keys = leave_out(choices, NEED_WEIGHTS, "--weights")
    else:
        asked = ",".join(choices) if systems == "all" else systems
        keys = choose_systems(asked, choices, weights, own_systems, own_embeddings)
    if weights is None and (lacking := [key for key in keys if key in NEED_WEIGHTS]):
        raise InputError(f"{', '.join(lacking)} need the weights of a trained ResNet: give --weights")
    return keys


def _studies(study: str, recordings: Recordings) -> list[str]:
    if study == "paper":
        return list(IN_THE_PAPER)
    if study != "all":
        return list(named("STUDY", study, (*NAMES, "paper", "all")))
    if not recordings.ordered:
        say(f"[yellow]not measured:[/] {SESSION}: {recordings.name} is published without its order of recording")
    return [name for name in NAMES if name != SESSION or recordings.ordered]


def _show(means: Rows) -> None:
    """A table for each set: a row for each strength, with the paper's figure where it has one."""
    for dataset in dict.fromkeys(row["dataset"] for row in means):
        table: dict[tuple[str, float], dict[str, Any]] = {}
        columns = {"study": "{./study}", "strength": "{./strength|g}"}
        for row in (row for row in means if row["dataset"] == dataset):
            name = f"{row['system']}, augmented" if row["augmented"] else row["system"]
            columns[name] = f"{{?./{name}|±}}"
            at = table.setdefault((row["study"], row["strength"]), {"study": row["study"], "strength": row["strength"]})
            at |= {name: row, "paper": PAPER.get((row["study"], row["strength"]), {}).get(dataset)}
        show(f"{dataset}, trained on clean touches, % right", columns | {"paper": "{?./paper|%}"}, table.values())


def _draw(plot: Path | None, means: Rows) -> None:
    """A picture of each study of each set, as the paper has: lines of two sensors in one cannot be distinguished."""
    pictures = dict.fromkeys((row["dataset"], row["study"]) for row in means)
    several = [len(set(names)) > 1 for names in zip(*pictures, strict=True)]
    for name, study in pictures if plot is not None else ():
        words = [word for word, tell in zip((name.lower(), study), several, strict=True) if tell]
        rows = [row for row in means if (row["dataset"], row["study"]) == (name, study)]
        file = None if plot is None else plot.with_stem("-".join([plot.stem, *words]))
        draw_into(file, partial(draw_robustness, rows=rows, title=f"{name}, trained on clean touches"))
