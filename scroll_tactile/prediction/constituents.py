"""Heads for each constituent over the readouts of a model, fitted and tried on the pool's touches.

Each touch of the pool is scored by readouts of the folds that it is not in, and by heads that never felt its material:
so it is known how far heads, novelty and what a touch feels like are to be believed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.memory.descriptions import Target
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.attributes import GAMMAS, Curve, Solved, fit_curve, solve
from scroll_tactile.readouts.calibration import FEWEST, fit_weights
from scroll_tactile.readouts.leave_one_out import leave_one_out_scores
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.sample import WindowSums
from scroll_tactile.statistics.statistics import fold_of

__all__ = ["Bench", "Head", "Stage", "combined", "space_of"]

FloatArray = npt.NDArray[np.float64]

DEFAULT_GAMMA = 0.1  # where no touch could be held out
PRESENCE = Curve(6.0, -3.0)  # of a head whose targets are 0 and 1, before any touch was held out
NOVEL = Curve(1.0, -2.0)  # of a novelty in spreads, likewise


@dataclass(frozen=True)
class _Space:
    """The materials as a stage's readouts see them: names, and G of all its scales, weighted, shape (C, C)."""

    names: list[str]
    gram: FloatArray

    def places(self, known: Mapping[str, object]) -> npt.NDArray[np.intp]:
        """The places of the materials that are known."""
        return np.array([at for at, name in enumerate(self.names) if name in known], dtype=np.intp)


@dataclass(frozen=True)
class _Trial:
    """A touch of the pool, judged by the folds that it is not in: z of its stage, shape (C,), and its novelty.

    familiar: among all materials. unfamiliar: among all but its own.
    """

    fold: int
    material: str
    z: FloatArray
    familiar: float
    unfamiliar: float


@dataclass(frozen=True)
class Head:
    """places: of the materials that it knows. weights: (α, b). curve: from its value to a probability, for a presence.

    A share has no curve.
    """

    places: npt.NDArray[np.intp]
    weights: FloatArray
    curve: Curve | None

    def __call__(self, z: FloatArray) -> float:
        """What it says of a touch's z, shape (C,): from 0 to 1."""
        value = float(self.weights[:-1] @ z[self.places] + self.weights[-1])
        return min(max(value, 0.0), 1.0) if self.curve is None else float(self.curve(value))


@dataclass(frozen=True)
class Stage:
    """The heads of one stage: constituent → its head, or in words why there is none.

    sharpness: the power to which the probabilities of materials felt are to be taken.
    """

    novel: Curve
    sharpness: float
    presence: dict[str, Head | str]
    share: dict[str, Head | str]


class Bench:
    """One stage, where heads are fitted and tried."""

    def __init__(self, model: Model, memory: Memory, stage: int) -> None:
        self.model = model
        self.memory = memory
        self.stage = stage
        self.space = space_of(model, stage)
        self.folds: dict[int, _Space] = {}
        self.trials = [trial for one in memory.pool if (trial := self._trial(*one)) is not None]
        self._solved: dict[tuple[int | None, float, bytes], Solved] = {}

    def _trial(self, material: str, key: bytes, touch: WindowSums) -> _Trial | None:
        model, fold = self.model, fold_of(key)
        means = touch.means(self.stage)
        scales = model.stages[self.stage]
        if means is None or any(fold not in model.selections[scale].held_out for scale in scales):
            return None
        if fold not in self.folds:
            self.folds[fold] = space_of(model, self.stage, fold)
        names = self.folds[fold].names
        if material not in names or len(names) < 2:
            return None
        readouts = {scale: model.selections[scale].held_out[fold] for scale in scales}
        z = {scale: readout.project(mean) for (scale, (_, readout)), mean in zip(readouts.items(), means, strict=True)}
        novelty = [
            [
                float(readout.novelty(z[scale], _others(model, scale, known, out)))
                for scale, (known, readout) in readouts.items()
            ]
            for out in (None, material)
        ]
        familiar, unfamiliar = model.calibrations[self.stage].novelty(np.array(novelty))
        return _Trial(fold, material, combined(model, self.stage, names, z, fold), float(familiar), float(unfamiliar))

    def fit(self, targets: Mapping[str, Target]) -> Stage:
        """The heads of all constituents, and how novelty is to be read."""
        values = [trial.familiar for trial in self.trials] + [trial.unfamiliar for trial in self.trials]
        truth = [0.0] * len(self.trials) + [1.0] * len(self.trials)
        return Stage(
            fit_curve(values, truth, NOVEL),
            self._sharpness(),
            {name: self._head(dict(target.presence), curved=True) for name, target in targets.items()},
            {name: self._head(target.share, curved=False) for name, target in targets.items()},
        )

    def _sharpness(self) -> float:
        """By touches taken out of the readouts that answer, one by one; 1 where that cannot be done.

        The probabilities are read by readouts of two thirds of the touches, which are wrong more often, and so say too
        little. A touch can be taken out where it is one row of the statistics: several windows of a touch are no sum
        that the pool holds.
        """
        statistics, scales = self.memory.statistics, self.model.stages[self.stage]
        selections = [self.model.selections[scale] for scale in scales]
        touches = sum(statistics.materials.values())
        single = all(int(statistics.totals(scale)[0].sum()) <= touches for scale in scales)
        if self.model.kind != "lda" or not single:
            return 1.0
        names = self.space.names
        often = [
            dict(zip(one.names, statistics.totals(scale)[0], strict=True))
            for scale, one in zip(scales, selections, strict=True)
        ]
        read = [
            (material, touch.windows(self.stage), touch.means(self.stage)) for material, _, touch in self.memory.pool
        ]
        felt = [
            (material, means)
            for material, windows, means in read
            if means is not None
            and set(windows) == {1}
            and material in names
            and all(one[material] > 1 for one in often)
        ]
        if len(felt) < FEWEST or len(names) < 2:
            return 1.0
        logits = np.zeros((len(felt), len(names)))
        weights = self.model.calibrations[self.stage].weights
        for at, (scale, one, weight) in enumerate(zip(scales, selections, weights, strict=True)):
            rows = np.stack([means[at] for _, means in felt])
            scores = leave_one_out_scores(
                statistics, scale, one.readout, rows, [one.places[material] for material, _ in felt]
            )
            logits += weight * scores[:, [one.places[name] for name in names]]
        targets = [names.index(material) for material, _ in felt]
        return float(fit_weights([row[None] for row in logits], targets, np.ones(1))[0])

    def _head(self, known: Mapping[str, float], *, curved: bool) -> Head | str:
        places = self.space.places(known)
        values = np.array([known[self.space.names[at]] for at in places], dtype=np.float64)
        if len(places) < 2:
            some = (
                "1 material of which it is known was"
                if len(places) == 1
                else f"{len(places)} of which it is known were"
            )
            return f"{some} felt for long enough; a head takes two or more"
        if np.ptp(values) == 0:
            who = "every" if values[0] else "no"
            return f"{who} material of which it is known and that was felt has it" + (
                "" if curved else f", each with a share of {values[0]:g}"
            )
        tried = {gamma: self._tried(known, gamma) for gamma in GAMMAS}
        lost = {gamma: float(np.square(said - true).sum()) for gamma, (said, true) in tried.items() if len(said)}
        # Ties go to the larger γ, the tamer head.
        gamma = min(sorted(lost, reverse=True), key=lost.__getitem__) if lost else DEFAULT_GAMMA
        weights = self._solve(None, gamma, places).head(values)
        # A half stays a half. Leaving a material out makes what it has rarer among the others, and where presence
        # begins, fitted on few such heads, came out on the wrong side: letters never touched 72 % right in place of 75.
        return Head(places, weights, fit_curve(*tried[gamma], PRESENCE, turning=False) if curved else None)

    def _tried(self, known: Mapping[str, float], gamma: float) -> tuple[FloatArray, FloatArray]:
        """What heads that never felt a held-out touch's material say of it, and what is true."""
        said, true = [], []
        for fold, space in self.folds.items():
            places = space.places(known)
            if len(places) < 3:
                continue
            values = np.array([known[space.names[at]] for at in places], dtype=np.float64)
            solved = self._solve(fold, gamma, places)
            head = solved.head(values)
            heads = {
                space.names[at]: solved.without(head, place)
                for place, at in enumerate(places)
                if np.ptp(np.delete(values, place)) > 0  # what is left is no task otherwise
            }
            for trial in self.trials:
                if trial.fold == fold and trial.material in heads:
                    left = heads[trial.material]
                    said.append(float(left[:-1] @ trial.z[places] + left[-1]))
                    true.append(float(known[trial.material]))
        return np.array(said), np.array(true)

    def _solve(self, fold: int | None, gamma: float, places: npt.NDArray[np.intp]) -> Solved:
        key = fold, gamma, places.tobytes()
        if key not in self._solved:
            gram = (self.space if fold is None else self.folds[fold]).gram
            self._solved[key] = solve(gram[np.ix_(places, places)], gamma)
        return self._solved[key]


def _readout(model: Model, scale: Scale, fold: int | None) -> tuple[list[str], Readout]:
    """The materials of a scale's readout, and the readout: of all that was felt, or of all but a fold."""
    selection = model.selections[scale]
    if fold is None:
        return selection.names, selection.readout
    known, readout = selection.held_out[fold]
    return [selection.names[at] for at in known], readout


def space_of(model: Model, stage: int, fold: int | None = None) -> _Space:
    """The materials as the readouts of a stage see them: of all that was felt, or of all but a fold."""
    readouts = [_readout(model, scale, fold) for scale in model.stages[stage]]
    names = sorted(set.intersection(*(set(known) for known, _ in readouts)))
    gram = np.zeros((len(names), len(names)))
    for weight, (known, readout) in zip(_weights(model, stage), readouts, strict=True):
        places = [known.index(name) for name in names]
        gram += weight * readout.gram[np.ix_(places, places)]
    return _Space(names, gram)


def combined(
    model: Model, stage: int, names: Sequence[str], z: Mapping[Scale, FloatArray], fold: int | None = None
) -> FloatArray:
    """z of a stage, shape (C,), of the z that its scales' readouts give, in the order of the names."""
    total = np.zeros(len(names))
    for weight, scale in zip(_weights(model, stage), model.stages[stage], strict=True):
        places = {name: at for at, name in enumerate(_readout(model, scale, fold)[0])}
        total += weight * z[scale][[places[name] for name in names]]
    return total


def _weights(model: Model, stage: int) -> FloatArray:
    """How far each scale of a stage is believed, summing to one; equally, where the calibration believes none."""
    weights = model.calibrations[stage].weights
    total = float(weights.sum())
    return weights / total if total > 0 else np.full(len(weights), 1 / len(weights))


def _others(model: Model, scale: Scale, known: npt.NDArray[np.intp], out: str | None) -> npt.NDArray[np.intp]:
    names = model.selections[scale].names
    return np.array([place for place, at in enumerate(known) if names[at] != out], dtype=np.intp)
