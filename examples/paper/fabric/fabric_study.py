"""What it is made of, on real data that stand in for the paper's fabrics, each named for what it is.

Letter-spike: Braille letters, whose six dots are constituents that are there or not; known letters in five folds, and
letters never touched, left out in groups. FabricSlide: fabrics trained on at one force or speed and tested at
another, the paper's change of protocol.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.paper.fabric.fabric_protocol import score, score_compositions
from examples.paper.readers.fabric_slide import CPM_RATIOS, Slides, ratios
from examples.paper.readers.labelled import Recordings
from examples.paper.readers.letter_spike import DOTS, GRID, dots_of, letter_folds
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import over_folds, require_folds
from examples.paper.studies.replay import Progress
from examples.paper.transfer.maps import Maps
from scroll_tactile import Embedding
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.pipelines.metrics import accuracy
from scroll_tactile.pipelines.runfile import RunFile

__all__ = ["FIGURES", "Letters", "SlideTransfer", "directions", "summary"]

FIGURES = ("score", "exact", "accuracy", "likeliest", "inferred", "always", "calibration_error")
"""Of each fold: mean score per constituent, exact matches, materials right; the score of saying the dots of the
likeliest letter (all right wherever the letter is), that where novelty is inferred, not given: the touches are of
letters never touched, and that of always saying what is more common among the letters learned; and expected calibration
error of the presences."""

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Letters:
    """Braille letters and their dots.

    recordings: of `letter_spike`, or any whose materials are its letters. groups: into which the letters are dealt, one
    of which is never touched; seed: deals them.
    cosines: features by which known letters are classified. Letters held out are composed by the maps alone (see
    `Maps`). folder: where finished parts are noted, so that an interrupted run resumes; or None.
    """

    recordings: Recordings
    groups: int = 9
    seed: int = 0
    cosines: int = 3000
    folder: Path | None = None

    @property
    def plan(self) -> dict[str, Any]:
        """All that the figures depend on, in JSON's types."""
        size = {"streams": len(self.recordings), "letters": len(set(self.recordings.materials))}
        settings = {"groups": self.groups, "seed": self.seed, "cosines": self.cosines}
        return {"run": "letters", "dataset": self.recordings.name} | size | settings

    def run(self, folds: Sequence[int], progress: Progress = lambda what, done, of: None) -> Iterator[dict[str, Any]]:
        """The figures of each of these folds of presses, then of each group of letters, as they are finished.

        Raises InputError for a fold that is not there, and what learning raises.
        """
        require_folds(self.recordings.fold, folds)
        notes = RunFile(None if self.folder is None else self.folder / "letters.json", self.plan)
        names = np.array(self.recordings.materials)
        parts: list[tuple[str, str, int, Mask]] = [
            ("known", f"fold {fold}", fold, self.recordings.fold == fold) for fold in folds
        ]
        groups = letter_folds(self.groups, self.seed)
        parts += [("never touched", " ".join(group), i, np.isin(names, group)) for i, group in enumerate(groups)]
        # With the embedding: whether the tested touches are of letters held out, which the caller knows.
        settings: dict[str, tuple[Embedding, float]] = {
            "known": (Cached(Maps(layout=GRID, parts=4, views=["as-felt", "corner"], cosines=self.cosines)), 0.0),
            "never touched": (Cached(Maps(layout=GRID, parts=1, views=["corner"])), 1.0),
        }
        for kind, title, i, tested in parts:
            name = f"{kind} {i}"
            if name not in notes.notes and tested.any():
                result = {"part": kind, "number": i, "tested on": title}
                notes.note(name, result | self._part(*settings[kind], tested, f"{kind}, {title}", progress))
            if name in notes.notes:
                yield notes.notes[name]

    def _part(
        self, embedding: Embedding, unfamiliar: float, tested: Mask, what: str, progress: Progress
    ) -> dict[str, Any]:
        begun = time.perf_counter()
        recordings = self.recordings
        learner = TactileLearner(sensor=recordings.sensor, embedding=embedding, exemplars=0)
        total = len(recordings)
        for done, i in enumerate(np.flatnonzero(~tested).tolist()):
            learner.observe(recordings.materials[i], recordings.streams[i])
            progress(what, done + 1, total)
        for letter in learner.materials:
            learner.describe(letter, dots_of(letter))
        test = np.flatnonzero(tested).tolist()
        predicted, inferred = [], []
        for done, i in enumerate(test):
            predicted.append(learner.compose(recordings.streams[i], unfamiliar=unfamiliar))
            inferred.append(learner.compose(recordings.streams[i]))
            progress(what, total - len(test) + done + 1, total)
        truth = [recordings.materials[i] for i in test]
        dots = [dots_of(letter) for letter in truth]
        figures = score_compositions(DOTS, dots, predicted)
        there = [[answer[dot] for dot in DOTS] for answer in dots]
        likeliest = [dots_of(answer.prediction.material or "space") for answer in predicted]
        often = np.mean([list(dots_of(recordings.materials[i]).values()) for i in np.flatnonzero(~tested)], axis=0)
        return {
            "learned": int((~tested).sum()),
            "accuracy": accuracy(truth, [answer.prediction.material for answer in predicted]),
            "unfamiliar": float(np.mean([answer.unfamiliar for answer in inferred])),
            **figures,
            "likeliest": score(DOTS, there, [[answer[dot] for dot in DOTS] for answer in likeliest])["score"],
            "always": score(DOTS, there, np.tile(often, (len(test), 1)))["score"],
            "inferred": score_compositions(DOTS, dots, inferred)["score"],
            "digest": learner.digest(),
            "seconds": time.perf_counter() - begun,
        }


def directions(slides: Slides) -> dict[str, tuple[Mask, Mask]]:
    """What is trained on and what is tested, by name: masks of shape (N,).

    Slow is up to 50 mm/s and fast from 100 on, which parts the six speeds; low is a force of up to 150 and high of 210
    or more, with 180 on neither side.
    """
    speed = np.abs(slides.speed)
    slow, fast = speed <= 50, speed >= 100
    low, high = slides.force <= 150, slides.force >= 210
    return {
        "slow → fast": (slow, fast),
        "fast → slow": (fast, slow),
        "low → high force": (low, high),
        "high → low force": (high, low),
    }


@dataclass(frozen=True)
class SlideTransfer:
    """Fabrics trained on at one force or speed and tested at another.

    slides: of `fabric_slide`. parts: of a slide, whose mean ratios are the features. folder: as for `Letters`.
    """

    slides: Slides
    parts: int = 12
    folder: Path | None = None

    @property
    def plan(self) -> dict[str, Any]:
        """All that the figures depend on, in JSON's types."""
        recordings = self.slides.recordings
        size = {"streams": len(recordings), "fabrics": sorted(set(recordings.materials))}
        return {"run": "slide", "dataset": recordings.name, "parts": self.parts} | size

    def run(self, progress: Progress = lambda what, done, of: None) -> Iterator[dict[str, Any]]:
        """The figures of each direction, then of five folds of all slides, as they are finished."""
        notes = RunFile(None if self.folder is None else self.folder / "slide.json", self.plan)
        recordings = self.slides.recordings
        streams = [ratios(stream) for stream in recordings.streams]
        embedding = Cached(Maps(layout=(CPM_RATIOS.channels,), parts=self.parts))
        splits = directions(self.slides)
        splits |= {f"fold {fold}": (recordings.fold != fold, recordings.fold == fold) for fold in range(5)}
        for name, (trained, tested) in splits.items():
            if name not in notes.notes:
                if not trained.any() or not tested.any():
                    raise InputError(f"expected slides on both sides of {name}; there are none on one")
                notes.note(name, {"part": name} | self._part(embedding, streams, trained, tested, name, progress))
            yield notes.notes[name]

    def _part(
        self, embedding: Embedding, streams: Sequence[Any], trained: Mask, tested: Mask, what: str, progress: Progress
    ) -> dict[str, Any]:
        begun = time.perf_counter()
        names = self.slides.recordings.materials
        learner = TactileLearner(sensor=CPM_RATIOS, embedding=embedding, exemplars=0)
        train, test = np.flatnonzero(trained).tolist(), np.flatnonzero(tested).tolist()
        for done, i in enumerate(train):
            learner.observe(names[i], streams[i])
            progress(what, done + 1, len(train))
        predicted = [learner.predict(streams[i]) for i in test]
        truth = [names[i] for i in test]
        right = [answer == prediction.material for answer, prediction in zip(truth, predicted, strict=True)]
        return {
            "learned": len(train),
            "tested": len(test),
            "accuracy": float(np.mean(right)),
            "of each": {
                name: float(np.mean([hit for hit, answer in zip(right, truth, strict=True) if answer == name]))
                for name in sorted(set(truth))
            },
            "unknown": float(np.mean([answer.known is False for answer in predicted])),
            "digest": learner.digest(),
            "seconds": time.perf_counter() - begun,
        }


def summary(results: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    """Of each kind of part: mean over its touches, and standard deviation over its folds or groups, of each figure."""
    means: dict[str, dict[str, dict[str, float]]] = {}
    for kind in dict.fromkeys(result["part"] for result in results):
        those = [result for result in results if result["part"] == kind]
        weights = [result["tested"] for result in those]
        for name in FIGURES:
            values = [result[name] for result in those if result.get(name) is not None]
            if len(values) == len(those):
                means.setdefault(kind, {})[name] = over_folds([float(value) for value in values], weights)
    return means
