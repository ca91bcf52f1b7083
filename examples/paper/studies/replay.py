"""Replays of recorded sets: learned in one pass by a schedule, fold by fold, and tested on what was held out."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.cells import over_folds, require_folds
from examples.paper.studies.schedules import ScheduleName, arrange
from scroll_tactile import Kernels
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.pipelines.classification import Answers, Labelled, evaluate, observe_all
from scroll_tactile.pipelines.metrics import calibration_error
from scroll_tactile.pipelines.runfile import RunFile
from scroll_tactile.readouts.readout import ReadoutName
from scroll_tactile.settings import Settings

__all__ = ["FIGURES", "PUBLISHED", "Progress", "Replay", "novelty_area", "rotations", "subset", "summary"]

Progress = Callable[[str, int, int], object]
"""Receives (what is being done, steps done, steps in all)."""

FIGURES = ("accuracy", "first", "half", "twice", "calibration_error", "false_alarms", "wrong_known", "novelty_auroc")
"""Of each fold: accuracy after the last material; from the first 0.3 s; of half streams after learning full ones;
of full streams after learning half ones; expected calibration error; the shares of known touches called unknown,
and of touches taken for another material and called known; AUROC of novelty with a fifth of the materials held out."""

PUBLISHED = {"BioTac-20": (0.938, 0.989), "RoboSkin-20": (0.848, 0.960)}
"""The paper's accuracies: ridge on its frozen vision model, and a pre-trained ResNet fine-tuned offline."""

_FIRST = 0.3  # seconds
_ROTATIONS = 5


@dataclass(frozen=True)
class Replay:
    """What to replay and how.

    recordings: the streams. schedule, seed: see `arrange`; the seed draws the order. readout: "lda" or "ridge".
    blocked: folds of successive repetitions, instead of the published or drawn ones.
    novelty: whether to measure the AUROC of novelty, which learns every fold five times more.
    features: of the embedding.
    folder: where each fold's memory and finished figures are kept, so that an interrupted run resumes; or None.

    Raises DatasetError where there are no blocked folds.
    """

    recordings: Recordings
    schedule: ScheduleName = "class-by-class"
    seed: int = 0
    readout: ReadoutName = "lda"
    blocked: bool = False
    novelty: bool = False
    features: int = 1008
    folder: Path | None = None

    @property
    def plan(self) -> dict[str, Any]:
        """All that the figures depend on, in JSON's types."""
        options = ("schedule", "seed", "readout", "blocked", "novelty", "features")
        asked = {"false_alarms_asked": Settings().false_alarms}
        size = {"streams": len(self.recordings), "materials": len(set(self.recordings.materials))}
        return {"run": "replay", "dataset": self.recordings.name, **size, **asked} | {
            name: getattr(self, name) for name in options
        }

    def run(self, folds: Sequence[int], progress: Progress = lambda what, done, of: None) -> Iterator[dict[str, Any]]:
        """The figures of each fold in turn, as they are finished; those finished before are read back.

        Raises InputError for a fold that is not there or a folder of another run, and what learning raises.
        """
        places = self.recordings.blocked() if self.blocked else self.recordings.fold
        require_folds(places, folds)
        notes = RunFile(None if self.folder is None else self.folder / "replay.json", self.plan)
        for fold in folds:
            name = f"fold-{fold}"
            if "digest" not in notes.notes.get(name, {}):
                notes.note(name, _ReplayFold(self, fold, places == fold, progress).run())
            yield notes.notes[name]


class _ReplayFold:
    """One fold: what is learned, what is tested, and the figures that come of it."""

    def __init__(self, replay: Replay, number: int, tested: np.ndarray, progress: Progress) -> None:
        self.replay = replay
        self.number = number
        self.progress = progress
        recordings = replay.recordings
        trained, self.test = hold_out(recordings, tested)
        order = arrange(replay.schedule, [name for name, _ in trained], replay.seed)
        self.train = [trained[i] for i in order]

    def run(self) -> dict[str, Any]:
        begun = time.perf_counter()
        folder = self.replay.folder
        with self._learner(None if folder is None else folder / f"fold-{self.number}") as learner:
            done = count(1)
            observe_all(learner, self.train, lambda: self.progress("learning", next(done), len(self.train)))
            figures = self._figures(learner)
            digest = learner.digest()
        figures["twice"] = self._twice()
        figures["novelty_auroc"] = self._novelty() if self.replay.novelty else None
        return {
            "fold": self.number,
            "learned": len(self.train),
            "tested": len(self.test),
            "tested_of": dict(Counter(name for name, _ in self.test)),
            **{name: figures[name] for name in (*FIGURES, "confusions")},
            "equals_offline": self._offline() == digest,
            "digest": digest,
            "seconds": time.perf_counter() - begun,
        }

    def _learner(self, path: Path | None = None) -> TactileLearner:
        sensor, readout = self.replay.recordings.sensor, self.replay.readout
        embedding = Kernels(dimension=self.replay.features)
        if path is None:
            return TactileLearner(sensor=sensor, embedding=embedding, readout=readout)
        return TactileLearner.open(path, sensor=sensor, embedding=embedding, readout=readout)

    def _figures(self, learner: TactileLearner) -> dict[str, Any]:
        self.progress("testing", 0, 3)
        whole = evaluate(learner, self.test)
        self.progress("testing", 1, 3)
        first = evaluate(learner, self.test, seconds=_FIRST)
        self.progress("testing", 2, 3)
        half = evaluate(learner, [(name, stream.first(stream.seconds / 2)) for name, stream in self.test])
        self.progress("testing", 3, 3)
        answers = zip(whole.truth, whole.predictions, strict=True)
        return {
            "accuracy": whole.accuracy,
            "first": first.accuracy,
            "half": half.accuracy,
            "calibration_error": _calibration_error(whole),
            "false_alarms": float(np.mean([prediction.known is False for prediction in whole.predictions])),
            "wrong_known": float(np.mean([one.known is not False and one.material != name for name, one in answers])),
            "confusions": whole.confusions(),
        }

    def _twice(self) -> float:
        learner = self._learner()
        shorter = [(name, stream.first(stream.seconds / 2)) for name, stream in self.train]
        self._train(learner, shorter, "learning halves")
        return evaluate(learner, self.test).accuracy

    def _offline(self) -> str:
        """The digest of the same touches learned in another order, all at random: offline training's."""
        learner = self._learner()
        order = np.random.default_rng([self.replay.seed, 1]).permutation(len(self.train))
        self._train(learner, [self.train[i] for i in order], "learning offline")
        return learner.digest()

    def _novelty(self) -> float:
        """Mean AUROC over five rotations, a fifth of the materials held out in each. Needs scikit-learn."""
        areas = []
        for rotation, out in enumerate(rotations([name for name, _ in self.train])):
            learner = self._learner()
            train = [touch for touch in self.train if touch[0] not in out]
            self._train(learner, train, f"novelty {rotation + 1}/{_ROTATIONS}")
            answers = evaluate(learner, self.test)
            novelty = [prediction.novelty for prediction in answers.predictions]
            areas.append(novelty_area(novelty, [name in out for name in answers.truth]))
        return float(np.mean(areas))

    def _train(self, learner: TactileLearner, touches: Sequence[Labelled], what: str) -> None:
        for done, (name, stream) in enumerate(touches):
            learner.observe(name, stream)
            self.progress(what, done + 1, len(touches))


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


def subset(recordings: Recordings, materials: int) -> Recordings:
    """The recordings of the first few materials only.

    Raises InputError for fewer than two, or more than there are.
    """
    names = list(dict.fromkeys(recordings.materials))
    if not 2 <= materials <= len(names):
        raise InputError(f"expected 2 to {len(names)} materials; came {materials}")
    kept = [i for i, name in enumerate(recordings.materials) if name in set(names[:materials])]
    return Recordings(
        name=recordings.name,
        sensor=recordings.sensor,
        streams=[recordings.streams[i] for i in kept],
        materials=[recordings.materials[i] for i in kept],
        repetition=recordings.repetition[kept],
        fold=recordings.fold[kept],
        ordered=recordings.ordered,
    )
