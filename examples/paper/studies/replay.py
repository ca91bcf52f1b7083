"""`replay`: a recorded set learned in one pass, fold by fold, and tested on what was held out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.cells import Cell, Figures, learn, over_folds, require_folds, run_cells, silent
from examples.paper.runs.options import Data, Dataset, Folds, Json, Quick, Run, Seed, folds_of, read
from examples.paper.runs.results import show, write
from examples.paper.runs.study import sensors_of
from examples.paper.studies.schedules import SCHEDULES, arrange
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning.metrics import Answers, Labelled, calibration_error, evaluate
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.settings import Settings

__all__ = ["FIGURES", "PUBLISHED", "Replay", "novelty_area", "replay", "rotations", "summary"]

FIGURES = ("accuracy", "first", "half", "twice", "calibration_error", "false_alarms", "wrong_known", "novelty_auroc")
"""Of each fold: accuracy after the last material; from the first 0.3 s; of half streams after learning full ones;
of full streams after learning half ones; expected calibration error; the shares of known touches called unknown,
and of touches taken for another material and called known; AUROC of novelty with a fifth of the materials held out."""

PUBLISHED = {
    name: {"ridge on a frozen vision model": ridge, "ResNet fine-tuned offline": tuned}
    for name, ridge, tuned in (("BioTac-20", 0.938, 0.989), ("RoboSkin-20", 0.848, 0.960))
}
"""The paper's accuracies: ridge on its frozen vision model, and a pre-trained ResNet fine-tuned offline."""

_FIRST = 0.3  # seconds
_ROTATIONS = 5


@dataclass(frozen=True)
class Replay:
    """What to replay and how.

    recordings: the streams. schedule, seed: see `arrange`; the seed draws the order. readout: "lda" or "ridge".
    novelty: whether to measure the AUROC of novelty, which learns every fold five times more.
    folder: where finished folds are noted, so that an interrupted run resumes; or None.
    """

    recordings: Recordings
    schedule: str = "class-by-class"
    seed: int = 0
    readout: str = "lda"
    novelty: bool = False
    folder: Path | None = None

    @property
    def plan(self) -> dict[str, Any]:
        """All that the figures depend on, in JSON's types."""
        options = {name: getattr(self, name) for name in ("schedule", "seed", "readout", "novelty")}
        asked = {"false_alarms_asked": Settings().false_alarms}
        return {"run": "replay", "dataset": self.recordings.name, **asked, **options}

    def run(self, folds: Sequence[int], progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each fold in turn, as they are finished; those finished before are read back.

        Raises InputError for a fold that is not there or a folder of another run, and what learning raises.
        """
        require_folds(self.recordings.fold, folds)
        cells = [Cell(self.recordings.name, fold, "one pass") for fold in folds]
        yield from run_cells(self.folder, self.plan, [self.recordings], cells, self._measure, progress)

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        trained, test = hold_out(self.recordings, self.recordings.fold == cell.fold)
        train = [trained[i] for i in arrange(self.schedule, [name for name, _ in trained], self.seed)]
        learner = learn(self._learner(), train, progress)
        whole = evaluate(learner, test)
        answers = [*zip(whole.truth, whole.predictions, strict=True)]
        # The same touches learned in another order, all at random, as offline training has them.
        order = np.random.default_rng([self.seed, 1]).permutation(len(train))
        offline = learn(self._learner(), [train[i] for i in order], progress, "learning offline")
        halves = learn(self._learner(), _halved(train), progress, "learning halves")
        return {
            "fold": cell.fold,
            "learned": len(train),
            "tested": len(test),
            "accuracy": whole.accuracy,
            "first": evaluate(learner, test, seconds=_FIRST).accuracy,
            "half": evaluate(learner, _halved(test)).accuracy,
            "twice": evaluate(halves, test).accuracy,
            "calibration_error": _calibration_error(whole),
            "false_alarms": float(np.mean([prediction.known is False for prediction in whole.predictions])),
            "wrong_known": float(np.mean([one.known is not False and one.material != name for name, one in answers])),
            "novelty_auroc": self._novelty(train, test, progress) if self.novelty else None,
            "confusions": whole.confusions(),
            "equals_offline": offline.digest() == learner.digest(),
            "digest": learner.digest(),
        }

    def _learner(self) -> TactileLearner:
        readout: Any = self.readout
        return TactileLearner(sensor=self.recordings.sensor, readout=readout)

    def _novelty(self, train: Sequence[Labelled], test: Sequence[Labelled], progress: Progress) -> float:
        """Mean AUROC over five rotations, a fifth of the materials held out in each. Needs scikit-learn."""
        areas = []
        for rotation, out in enumerate(rotations([name for name, _ in train]), start=1):
            known = [touch for touch in train if touch[0] not in out]
            answers = evaluate(learn(self._learner(), known, progress, f"novelty {rotation}/{_ROTATIONS}"), test)
            novelty = [prediction.novelty for prediction in answers.predictions]
            areas.append(novelty_area(novelty, [name in out for name in answers.truth]))
        return float(np.mean(areas))


def _halved(touches: Sequence[Labelled]) -> list[Labelled]:
    return [(name, stream.first(stream.seconds / 2)) for name, stream in touches]


def rotations(materials: Iterable[str]) -> list[set[str]]:
    """Which materials are held out in each of five rotations: every fifth, by their numbers."""
    names = sorted(set(materials), key=_number)
    return [set(names[rotation::_ROTATIONS]) for rotation in range(_ROTATIONS)]


def novelty_area(novelty: Sequence[float], new: Sequence[bool]) -> float:
    """AUROC of N novelties, by whether each touch is of a new material. Needs scikit-learn."""
    from scipy.stats import rankdata
    from sklearn.metrics import roc_auc_score

    return float(roc_auc_score(new, rankdata(novelty)))  # ranks: a novelty may be infinite


def _number(name: str) -> tuple[int, str]:
    digits = "".join(filter(str.isdigit, name))
    return int(digits or 0), name


def _calibration_error(answers: Answers) -> float:
    right = [truth == predicted for truth, predicted in zip(answers.truth, answers.predicted, strict=True)]
    return calibration_error([prediction.probability for prediction in answers.predictions], right)


def summary(folds: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Mean and standard deviation over the folds, see `over_folds`, of each figure that all of them have."""
    means = {}
    for name in FIGURES:
        values = [fold[name] for fold in folds]
        if values and None not in values:
            means[name] = over_folds(values)
    return means


def replay(
    context: typer.Context,
    dataset: Dataset,
    data: Data,
    schedule: Annotated[str, typer.Option(help=f"The order of learning, {' or '.join(SCHEDULES)}.")] = SCHEDULES[0],
    seed: Seed = 0,
    folds: Folds = "all",
    readout: Annotated[str, typer.Option(help="How materials are classified: lda or ridge.")] = "lda",
    blocked: Annotated[
        bool, typer.Option("--blocked", help="Folds of successive repetitions (BioTac only): a harder test.")
    ] = False,
    novelty: Annotated[
        bool, typer.Option("--novelty", help="Also hold out 4 of 20 materials, five times over. Slower.")
    ] = False,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Learn a recorded set in one pass, fold by fold, and test it on what was held out.

    Nothing is revisited. Afterwards the same touches are learned in another order: the memory must be the same to
    the bit, so that learning one by one loses nothing against training on everything at once.
    """
    with progress_bar() as progress:
        progress("reading", 0, 1)
        (recordings,) = read("DATASET", dataset, data, seed, quick=quick).values()
        if blocked:
            recordings = replace(recordings, fold=recordings.blocked())
        task = Replay(recordings, schedule, seed, readout, novelty, folder=run)
        found = [figures for _, figures in task.run(folds_of(folds, recordings, quick=quick), progress)]
    means = summary(found)
    rows = [{"figure": name, "mean": means[name]} for name in FIGURES if name in means]
    published = PUBLISHED.get(recordings.name, {}).items()
    rows += [{"figure": f"published: {name}", "mean": {"mean": share, "sd": None}} for name, share in published]
    show(f"{recordings.name}, one pass", {"figure": "{./figure}", "%, folds' mean": "{./mean|±}"}, rows)
    columns = {"fold": "{./fold}", "right, %": "{./accuracy|%}", "tested": "{./tested}", "learned": "{./learned}"}
    show("folds", columns | {"equals offline": "{./equals_offline}", "digest": "{./digest}"}, found)
    write(context, task.plan | {"sensor": sensors_of([recordings])[recordings.name], "means": means, "folds": found})
