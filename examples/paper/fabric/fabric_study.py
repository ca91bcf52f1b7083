"""What it is made of, on real data that stand in for the paper's fabrics, each named for what it is.

Letter-spike: Braille letters, whose six dots are constituents that are there or not; known letters in five folds, and
letters never touched, left out in groups. FabricSlide: fabrics learned at one force or speed and asked about at
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

from examples.paper.runs.cached import Cached
from examples.paper.studies.replay import Progress
from scroll_tactile import Embedding, Maps
from scroll_tactile.datasets import Recordings
from scroll_tactile.datasets.fabric_slide import CPM_RATIOS, Slides, ratios
from scroll_tactile.datasets.letter_spike import DOTS, GRID, dots_of, letter_folds
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.pipelines.fabric import score, score_compositions
from scroll_tactile.pipelines.metrics import accuracy, mean_and_spread
from scroll_tactile.pipelines.runfile import RunFile

__all__ = ["FIGURES", "Letters", "SlideTransfer", "directions", "summary"]

FIGURES = ("score", "exact", "accuracy", "likeliest", "inferred", "always", "calibration_error")
"""Of each fold: mean score per constituent, exact matches, materials told; the score of saying the dots of the
likeliest letter (all right wherever the letter is), that where it is not said beforehand whether the touches are of
letters never touched, and that of always saying what is more common among the letters learned; and expected calibration
error of the presences."""

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Letters:
    """Braille letters and their dots.

    recordings: of `letter_spike`, or any whose materials are its letters. groups: into which the letters are dealt, one
    of which is never touched; seed: deals them.
    cosines: features that tell known letters apart. Letters never touched are told by the maps alone (see `Maps`).
    folder: where finished parts are noted, so that an interrupted run goes on; or None.
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
        there = sorted(set(self.recordings.fold.tolist()))
        if not folds or set(folds) - set(there):
            raise InputError(f"expected folds out of {there}; came {list(folds)}")
        notes = RunFile(None if self.folder is None else self.folder / "letters.json", self.plan)
        names = np.array(self.recordings.materials)
        parts: list[tuple[str, str, int, Mask]] = [
            ("known", f"fold {fold}", fold, self.recordings.fold == fold) for fold in folds
        ]
        groups = letter_folds(self.groups, self.seed)
        parts += [("never touched", " ".join(group), at, np.isin(names, group)) for at, group in enumerate(groups)]
        # With the embedding: whether the touches asked about are of letters never touched, which whoever asks knows.
        settings: dict[str, tuple[Embedding, float]] = {
            "known": (Cached(Maps(layout=GRID, parts=4, views=["as-felt", "corner"], cosines=self.cosines)), 0.0),
            "never touched": (Cached(Maps(layout=GRID, parts=1, views=["corner"])), 1.0),
        }
        for kind, title, at, tested in parts:
            name = f"{kind} {at}"
            if name not in notes.notes and tested.any():
                result = {"part": kind, "number": at, "tested on": title}
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
        for done, at in enumerate(np.flatnonzero(~tested).tolist()):
            learner.observe(recordings.materials[at], recordings.streams[at])
            progress(what, done + 1, total)
        for letter in learner.materials:
            learner.describe(letter, dots_of(letter))
        exam = np.flatnonzero(tested).tolist()
        said, untold = [], []
        for done, at in enumerate(exam):
            said.append(learner.compose(recordings.streams[at], unfamiliar=unfamiliar))
            untold.append(learner.compose(recordings.streams[at]))
            progress(what, total - len(exam) + done + 1, total)
        truth = [recordings.materials[at] for at in exam]
        dots = [dots_of(letter) for letter in truth]
        figures = score_compositions(DOTS, dots, said)
        there = [[one[dot] for dot in DOTS] for one in dots]
        likeliest = [dots_of(one.prediction.material or "space") for one in said]
        often = np.mean([list(dots_of(recordings.materials[at]).values()) for at in np.flatnonzero(~tested)], axis=0)
        return {
            "learned": int((~tested).sum()),
            "accuracy": accuracy(truth, [one.prediction.material for one in said]),
            "unfamiliar": float(np.mean([one.unfamiliar for one in untold])),
            **figures,
            "likeliest": score(DOTS, there, [[one[dot] for dot in DOTS] for one in likeliest])["score"],
            "always": score(DOTS, there, np.tile(often, (len(exam), 1)))["score"],
            "inferred": score_compositions(DOTS, dots, untold)["score"],
            "digest": learner.digest(),
            "seconds": time.perf_counter() - begun,
        }


def directions(slides: Slides) -> dict[str, tuple[Mask, Mask]]:
    """What is learned from and what is asked about, by name: masks of shape (N,).

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
    """Fabrics learned at one force or speed and asked about at another.

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
        for name, (taught, tested) in splits.items():
            if name not in notes.notes:
                if not taught.any() or not tested.any():
                    raise InputError(f"expected slides on both sides of {name}; there are none on one")
                notes.note(name, {"part": name} | self._part(embedding, streams, taught, tested, name, progress))
            yield notes.notes[name]

    def _part(
        self, embedding: Embedding, streams: Sequence[Any], taught: Mask, tested: Mask, what: str, progress: Progress
    ) -> dict[str, Any]:
        begun = time.perf_counter()
        names = self.slides.recordings.materials
        learner = TactileLearner(sensor=CPM_RATIOS, embedding=embedding, exemplars=0)
        lessons, exam = np.flatnonzero(taught).tolist(), np.flatnonzero(tested).tolist()
        for done, at in enumerate(lessons):
            learner.observe(names[at], streams[at])
            progress(what, done + 1, len(lessons))
        said = [learner.predict(streams[at]) for at in exam]
        truth = [names[at] for at in exam]
        right = [one == prediction.material for one, prediction in zip(truth, said, strict=True)]
        return {
            "learned": len(lessons),
            "tested": len(exam),
            "accuracy": float(np.mean(right)),
            "of each": {
                name: float(np.mean([hit for hit, one in zip(right, truth, strict=True) if one == name]))
                for name in sorted(set(truth))
            },
            "unknown": float(np.mean([not one.known for one in said])),
            "digest": learner.digest(),
            "seconds": time.perf_counter() - begun,
        }


def summary(results: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Of each kind of part: mean over its touches, and standard deviation over its folds or groups, of each figure."""
    means: dict[str, dict[str, dict[str, float]]] = {}
    for kind in dict.fromkeys(result["part"] for result in results):
        those = [result for result in results if result["part"] == kind]
        weights = [result["tested"] for result in those]
        for name in FIGURES:
            values = [result.get(name) for result in those]
            if None not in values:
                mean = float(np.average(np.array(values, dtype=np.float64), weights=weights))
                _, spread = mean_and_spread([float(value) for value in values if value is not None])
                means.setdefault(kind, {})[name] = {"mean": mean, "sd": spread}
    return means
